"""Critics as one product are the same critics, and both ways are timed."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.layers import Ensemble, mlp
from tools.benchmarks import time_ensemble


def test_one_product_gives_the_numbers_of_the_loop() -> None:
    loop = Ensemble([mlp([7, 16, 16, 5]) for _ in range(3)])
    for parameter in loop.parameters():
        torch.nn.init.normal_(parameter)  # biases and norms too
    x = torch.randn(11, 7)
    assert_close(time_ensemble.Batched(loop)(x), loop(x), rtol=1e-4, atol=1e-4)


def test_a_row_for_every_size_and_number_of_members(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_ensemble, "keep_freed_memory", lambda: False)  # this process is not ours to change
    monkeypatch.setattr(time_ensemble, "REPEATS", 1)
    out = tmp_path / "e.csv"
    assert time_ensemble.main(["--sizes", "small", "--members", "2", "3", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [row["members"] for row in rows] == ["2", "3"]
    assert all(float(row["loop_ms"]) > 0 and float(row["batched_ms"]) > 0 for row in rows)
