"""Policies trained in simulation alone, measured where the study says, each once."""

import csv
from pathlib import Path

from tools.studies import zero_shot


def test_a_row_a_method_gap_and_seed_and_none_is_measured_twice(tmp_path: Path, capsys) -> None:
    table, folder = tmp_path / "found.csv", ["--runs", str(tmp_path / "runs")]
    words = [str(table), "--gaps", "mild", *folder, "--set", "+experiment=debug", "transitions=640", "--methods", "dr"]
    assert zero_shot.main(words) == 0
    rows = list(csv.DictReader(table.open()))
    assert [(r["method"], r["gap"], r["seed"], r["transitions"]) for r in rows] == [("dr", "mild", "", "")]
    assert float(rows[0]["low"]) > 0.9 and rows[0]["episodes"] == "100"  # the shipped policy is good at it
    words += ["asymmetric_ac", "--seeds", "4"]
    assert zero_shot.main(words) == 0
    first, second = csv.DictReader(table.open())
    assert first == rows[0] and (second["method"], second["seed"], second["transitions"]) == (
        "asymmetric_ac",
        "4",
        "640",
    )
    assert float(second["high"]) < 0.5, "it has learned nothing yet"
    before = table.read_text()
    capsys.readouterr()
    assert zero_shot.main(words) == 0
    assert table.read_text() == before and not capsys.readouterr().out
    assert zero_shot.main([str(table), "--gaps", "nowhere", "--methods", "dr", *folder]) == 1
    assert "nowhere" in capsys.readouterr().err
