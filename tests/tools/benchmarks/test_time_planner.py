"""The timing tool counts arithmetic right and writes what it measured."""

import csv
from pathlib import Path

import pytest
import torch

from tools.benchmarks import time_planner
from tools.benchmarks.time_planner import flop, main


def test_the_arithmetic_of_a_call_by_hand() -> None:
    x, w = torch.randn(3, 4), torch.randn(4, 5, requires_grad=True)
    assert flop(lambda: x @ w) == 2 * 3 * 4 * 5
    assert flop(lambda: (x @ w).sum().backward()) == 2 * 2 * 3 * 4 * 5  # x has no slope
    with torch.inference_mode():
        assert flop(lambda: torch.nn.functional.linear(x, w.detach().T)) == 2 * 3 * 4 * 5


def test_measures_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_planner, "keep_freed_memory", lambda: False)  # this process is not ours to change
    out = tmp_path / "deeper" / "t.csv"
    assert main(["--quick", "--sizes", "small", "--threads", "1", "--precisions", "float32", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [(row["what"], row["horizon"], row["decay"], row["rows"]) for row in rows] == [
        ("plan", "3", "1.0", "1"), ("update", "3", "", "256"),
        ("plan", "4", "1.0", "1"), ("plan", "4", "1.25", "1"), ("update", "4", "", "256"),
    ]  # fmt: skip
    assert float(rows[3]["gflop"]) < 0.75 * float(rows[2]["gflop"])
    for row in rows:
        assert 0 < float(row["share_of_peak"]) < 1.5 and float(row["median_ms"]) > 0
        assert row["cpu"] and row["cores"] and row["torch"] == torch.__version__ and row["malloc"] == "default"
    assert "upstream" in capsys.readouterr().out
