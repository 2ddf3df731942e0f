"""The timing tool writes a row for each length of data and each part of the library."""

import csv
from pathlib import Path

import pytest

from tools.benchmarks import time_diagnose


def test_rows_and_ratios(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_diagnose, "PARTS", (2,))
    monkeypatch.setattr("sys.argv", ["time_diagnose", "--quick", "--out", str(tmp_path / "t.csv")])
    time_diagnose.main()
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert [r["what"] for r in rows] == ["data", "candidates"]
    assert all(r["said"] == "effect viscous_friction" and float(r["per"]) == 1.0 for r in rows)
    assert all(float(r["wall_s"]) > 0 for r in rows)
