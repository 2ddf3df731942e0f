"""Updates are timed as they are and compiled."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tools.benchmarks import time_compile


def test_a_row_says_what_compiling_costs_and_brings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_compile, "keep_freed_memory", lambda: False)  # this process is not ours to change
    monkeypatch.setattr(time_compile, "REPEATS", 1)
    monkeypatch.setattr(time_compile, "BACKEND", "eager")  # traced, and run as it is: no C++ compiler, no minutes
    out = tmp_path / "c.csv"
    assert time_compile.main(["--sizes", "small", "--precisions", "float32", "--out", str(out)]) == 0
    (row,) = csv.DictReader(out.open())
    assert float(row["plain_ms"]) > 0 and float(row["compiled_ms"]) > 0 and float(row["compile_s"]) > 0.1
    assert float(row["to_plain"]) == pytest.approx(float(row["compiled_ms"]) / float(row["plain_ms"]), abs=0.02)
