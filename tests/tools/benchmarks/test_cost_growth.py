"""What more costs: a row for each number, in proportion to the first one measured beside it."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tools.benchmarks import cost_growth


def test_more_costs_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost_growth, "keep_freed_memory", lambda: False)  # this process is not ours to change
    monkeypatch.setattr(cost_growth, "VARIED", {"num_candidates": [128, 4096], "horizon": [1, 16]})
    out = tmp_path / "cost.csv"
    assert cost_growth.main(["--parts", "plan", "--repeats", "3", "--out", str(out)]) == 0
    with out.open(newline="") as file:
        ratio = {(row["what"], row["value"]): float(row["ratio"]) for row in csv.DictReader(file)}
    assert ratio["num_candidates", "4096"] > 2 * ratio["num_candidates", "128"]
    assert ratio["horizon", "16"] > 2 * ratio["horizon", "1"]
