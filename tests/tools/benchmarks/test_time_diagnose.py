"""The timing tool writes a row for each length of data and each part of the library."""

import csv
from pathlib import Path

import pytest

from tools.benchmarks import time_diagnose


def test_rows_and_ratios(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_diagnose, "PARTS", (2,))
    case = tmp_path / "case"
    case.mkdir()
    (case / "model.xml").write_text(time_diagnose.PENDULUM)
    time_diagnose.record(case, 4.0)
    monkeypatch.setattr("sys.argv", ["time_diagnose", "--quick", "--case", str(case), "--out", str(tmp_path / "t.csv")])
    time_diagnose.main()
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert [r["what"] for r in rows] == ["data", "candidates", "1 joints"]
    assert all(r["said"] == "effect viscous_friction" for r in rows)
    assert [r["per"] for r in rows] == ["1.0", "1.0", ""] and float(rows[2]["seconds_of_data"]) == 4.0
    assert all(float(r["wall_s"]) > 0 for r in rows)
