"""What diagnose found becomes rows."""

import csv
import json
from pathlib import Path

import pytest

from tools.studies import diagnose_table


def test_a_row_for_each_parameter_and_one_for_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    number = {"value": 0.90481234, "unit": "kg", "low": 0.9, "high": 0.91}
    effects = {"a": [{"name": "payload", "at": ["puck"], "parameters": {"mass": number}}], "b": []}
    for name, said in effects.items():
        (tmp_path / name / "diagnosis").mkdir(parents=True)
        (tmp_path / name / "summary.json").write_text(json.dumps({"gap": "ice", "seed": 0, "real_rollouts": 20}))
        report = {"verdict": "effect" if said else "none", "effects": said, "seconds": 12.5}
        (tmp_path / name / "diagnosis" / "report.json").write_text(json.dumps(report))
    monkeypatch.setattr("sys.argv", ["table", *(str(tmp_path / x) for x in ("t.csv", "a", "b"))])
    diagnose_table.main()
    first, second = csv.DictReader((tmp_path / "t.csv").open())
    assert (first["effect"], first["at"], first["value"], first["high"]) == ("payload", "puck", "0.9048", "0.91")
    assert (second["verdict"], second["effect"], second["rollouts"]) == ("none", "", "20")
