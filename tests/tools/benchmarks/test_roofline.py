"""The floor counts what operations move and compute, by hand and as the time planner counts it."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from tools.benchmarks import roofline


def test_traffic_by_hand() -> None:
    a, b, w = torch.randn(3, 4), torch.randn(3, 4), torch.randn(4, 5)
    assert roofline.traffic(lambda: a + b) == 3 * 12 * 4  # two are read, one is written
    assert roofline.traffic(lambda: a @ w) == 0  # a product
    assert roofline.traffic(lambda: a.view(12)[2:]) == 0  # a view
    assert roofline.traffic(lambda: a.bfloat16()) == 12 * 4 + 12 * 2
    with torch.inference_mode():
        assert roofline.traffic(lambda: torch.cat([a, b])) == 2 * 24 * 4


def test_a_row_for_a_plan_and_an_update(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roofline, "keep_freed_memory", lambda: False)  # this process is not ours to change
    out = tmp_path / "r.csv"
    assert roofline.main(["--sizes", "small", "--precisions", "float32", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert {row["what"] for row in rows} == {"plan", "update"}
    for row in rows:
        assert float(row["gflop"]) > 0 and float(row["gbyte"]) > 0
        assert 0 < float(row["products_share"]) < 1 and 0.02 < float(row["share"]) < 1.2
        whole = float(row["gflop"]) / float(row["peak_gflops"]) + float(row["gbyte"]) / float(row["peak_gbyte"])
        assert float(row["floor_ms"]) == pytest.approx(1e3 * whole, rel=0.05)
