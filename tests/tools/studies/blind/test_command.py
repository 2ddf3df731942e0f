"""The command generates, runs a solver and scores; a made-up solver stands in for diagnose."""

import json
import shutil
import sys
import types
from pathlib import Path

import pytest

from tools.studies import blind_benchmark
from tools.studies.blind import cases, pack
from tools.studies.blind import draw as drawing


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """A stand-in for mpc_sgft.diagnose that always answers `none`; the list of what it was asked."""
    asked: list[Path] = []

    class Report:
        def as_dict(self) -> dict:
            return {"verdict": "none", "effects": [], "candidates": [], "ties": []}

    def diagnose(model: Path, data: list[Path], **options: object) -> Report:
        assert set(options) >= {"out", "effects", "signals", "window", "held_out", "uncertain", "seed", "max_effects"}
        asked.append(Path(model))
        if len(asked) == 1:
            raise RuntimeError("first one breaks")
        return Report()

    fake = types.ModuleType("mpc_sgft.diagnose")
    fake.diagnose = diagnose  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "mpc_sgft.diagnose", fake)
    return asked


def test_generate_run_score_and_resume(
    tmp_path: Path, solver: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def few(seed: int, count: int, least_none: int = 0) -> list[drawing.Case]:
        return [c for c in drawing.draw(seed, 300) if c.plant == "slide" and c.group == "none"][:count]

    monkeypatch.setattr(blind_benchmark, "draw", few)
    kept = tmp_path / "reports.jsonl.gz"
    how = ["--jobs", "1", "--no-baselines", "--pack", str(kept)]
    line = ["--seed", "4", "--cases", "2", "--out", str(tmp_path / "b"), *how]
    assert blind_benchmark.main(line) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "b/labels.sha256").read_text().strip() in printed
    assert len(solver) == 2
    said = [json.loads(p.read_text())["verdict"] for p in sorted((tmp_path / "b/reports").glob("*/blind.json"))]
    assert said == ["error", "none"] and "no effect: false alarms" in printed
    assert not list((tmp_path / "b").rglob("*.part"))
    for name in ("scores.csv", "scores_cases.csv", "scores_confusion.png", "scores_power.png"):
        assert (tmp_path / "b" / name).stat().st_size > 0
    assert blind_benchmark.main(line) == 0
    assert len(solver) == 2  # nothing is run twice
    kept.unlink()
    assert blind_benchmark.main([*line, "--only", "pack"]) == 0 and kept.is_file()
    shutil.rmtree(tmp_path / "b")
    assert blind_benchmark.main(line) == 0 and len(solver) == 2  # nor anywhere else
    assert "2 reports taken over" in capsys.readouterr().out
    assert blind_benchmark.main(["--seed", "5", "--cases", "2", "--out", str(tmp_path / "c"), *how]) == 2
    assert "holds reports on cases of seed 4" in capsys.readouterr().err and len(solver) == 2


def test_packed_reports_count_for_cases_of_the_same_label(tmp_path: Path) -> None:
    def labelled(name: str, second: float) -> Path:
        """A folder with the labels of two cases."""
        out = tmp_path / name
        out.mkdir()
        cases.seal(out, {"seed": 4, "cases": {"case_0000": {"size": 1.0}, "case_0001": {"size": second}}})
        return out

    here, there = labelled("here", 2.0), labelled("there", 2.0001)
    for name in ("case_0000", "case_0001"):
        (here / "reports" / name).mkdir(parents=True)
        (here / "reports" / name / "blind.json").write_text('{"verdict": "none"}')
    assert pack.pack(here, tmp_path / "kept") == 2
    assert pack.unpack(tmp_path / "kept", there) == (1, 1)
    assert [p.parent.name for p in there.rglob("blind.json")] == ["case_0000"]
    assert pack.unpack(tmp_path / "kept", labelled("elsewhere", 2.00001)) == (2, 0)  # alike to five digits


def test_errors_are_one_line_and_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert blind_benchmark.main(["--seed", "4", "--out", str(tmp_path), "--only", "score"]) == 2
    assert "run with --only generate first" in capsys.readouterr().err
    assert blind_benchmark.main(["--seed", "4", "--out", str(tmp_path), "--only", "pack"]) == 2
    assert "run with --only generate first" in capsys.readouterr().err


def test_cases_do_not_depend_on_the_number_of_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def few(seed: int, count: int, least_none: int = 0) -> list[drawing.Case]:
        short = [c for c in drawing.draw(seed, 300) if c.group == "none" and c.seconds == 2.0]
        return [next(c for c in short if c.plant == plant) for plant in ("pendulum", "slide")]

    monkeypatch.setattr(blind_benchmark, "draw", few)
    first, second = (blind_benchmark.generate(tmp_path / str(n), 4, 2, 0, jobs=n) for n in (1, 2))
    assert first == second
