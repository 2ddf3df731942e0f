"""The benchmark of a GPU runs on a processor too, and says so where there is no GPU."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from tools.benchmarks import gpu_bench


def test_it_writes_a_row_for_everything(tmp_path: Path) -> None:
    out = tmp_path / "bench.csv"
    words = ["--device", "cpu", "--sizes", "small", "--envs", "2", "--physics", "mujoco", "--repeats", "1"]
    assert gpu_bench.main([*words, "--out", str(out)]) == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["what"], row["precision"]) for row in rows] == [
        ("plan", "float32"), ("update", "float32"), ("plan", "bfloat16"), ("update", "bfloat16"),
        ("environment steps", "float64"),
    ]  # fmt: skip
    assert all(float(row["median_ms"]) > 0 and row["device"] for row in rows)
    assert float(rows[-1]["per_second"]) == pytest.approx(80e3 / float(rows[-1]["median_ms"]), rel=0.1)


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="2"):
        gpu_bench.main([])
    assert "--device cpu" in capsys.readouterr().err
