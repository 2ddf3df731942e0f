"""The command makes cases of a ground, runs a solver and scores; a made-up solver stands in for diagnose."""

import csv
import sys
import types
from pathlib import Path

import pytest

from tools.studies import foreign_benchmark
from tools.studies.foreign import draw as drawing
from tools.studies.foreign import grounds


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """A stand-in for mpc_sgft.diagnose that always answers `none`; the list of what it was told."""
    told: list[dict] = []

    class Report:
        def as_dict(self) -> dict:
            return {"verdict": "none", "effects": [], "candidates": [], "ties": [], "traces": []}

    def diagnose(model: Path, data: list[Path], **options: object) -> Report:
        told.append(options)
        return Report()

    fake = types.ModuleType("mpc_sgft.diagnose")
    fake.diagnose = diagnose  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "mpc_sgft.diagnose", fake)
    return told


def test_generate_run_score_and_resume(
    tmp_path: Path, solver: list[dict], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw = drawing.draw

    def few(seed: int, count: int, scenes: dict, mix: object) -> list[drawing.Case]:
        calm = [c for c in draw(seed, 60, {"slide": 1.0}, grounds.MIX) if c.group == "none"]
        return [c._replace(seconds=(1.5,), dt=0.005) for c in calm[:count]]

    monkeypatch.setattr(grounds.draw, "draw", few)
    target = tmp_path / "results/foreign.csv"
    line = ["--seed", "4", "--cases", "2", "--ground", "scipy", "--out", str(tmp_path / "f"), "--jobs", "1"]
    assert foreign_benchmark.main([*line, "--csv", str(target)]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "f/scipy/labels.sha256").read_text().strip() in printed
    assert [options["tolerance"] for options in solver] == [grounds.TOLERANCE] * 2
    with target.open(newline="") as file:
        rows = {r["score"]: r for r in csv.DictReader(file)}
    alarms = rows["nothing that matters: false alarms"]
    assert (alarms["ground"], alarms["value"], alarms["of"], alarms["seed"]) == ("scipy", "0.0", "2", "4")
    with target.with_name("foreign_cases.csv").open(newline="") as file:
        assert [r["verdict"] for r in csv.DictReader(file)] == ["none", "none"]
    assert foreign_benchmark.main(line) == 0 and len(solver) == 2  # nothing is run twice
    assert foreign_benchmark.main([*line[:1], "5", *line[2:]]) == 2
    assert "holds 2 cases of seed 4" in capsys.readouterr().err


def test_errors_are_one_line_and_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["--seed", "4", "--ground", "scipy", "--out", str(tmp_path), "--only", "score"]
    assert foreign_benchmark.main(line) == 2
    assert "run with --only generate first" in capsys.readouterr().err
