"""Scores of methods from curves: by hand, and as the library has them."""

import csv
from pathlib import Path

import numpy as np
import pytest

from tools.studies import benchmark
from tools.studies.study import COLUMNS

pytest.importorskip("rliable", reason="needs rliable")


DONE = {"gap": "a", "wall_seconds": 1.0, "updates": 5, "frozen_sha256": "0" * 64, "evaluation_episodes": 2}
DONE |= {"curve": {"0": 0.0, "10": 0.5}}


def curve(path: Path, runs: dict[tuple[str, str, int], dict[int, float]]) -> Path:
    """A CSV as tools.studies.study writes it: (gap, method, seed) -> rollouts -> success."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        for (gap, method, seed), success in runs.items():
            for count, share in success.items():
                row = {"gap": gap, "method": method, "seed": seed, "rollouts": count, "success": share}
                table.writerow({**row, "updates": 100, "seconds": 7.5})
    return path


@pytest.fixture
def curves(tmp_path) -> Path:
    runs = {}
    for seed in range(4):
        for gap in ("a", "b"):
            runs[gap, "good", seed] = {0: 0.0, 10: 0.9 + 0.02 * seed, 20: 1.0}
            runs[gap, "bad", seed] = {0: 0.0, 10: [0.0, 0.1, 0.3, 0.8][seed], 20: 0.5}
        runs["a", "new", seed] = {0: 0.0, 10: 0.9 + 0.02 * seed}
    return curve(tmp_path / "curves.csv", runs)


def test_a_run_is_one_row_with_what_it_cost(curves) -> None:
    rows = benchmark.summaries(benchmark.read_curves([curves]), 20)
    assert len(rows) == 16, "new was not measured after twenty"
    first = rows[0]
    assert (first["before"], first["after"], first["rollouts_to_90"]) == (0.0, 1.0, 10)
    assert first["area"] == pytest.approx((4.5 + 9.5) / 20) and first["seconds"] == "7.5"
    assert "seconds" not in benchmark.summaries(benchmark.read_curves([curves]), 10)[0], "of the whole run alone"


def test_the_interquartile_mean_is_that_of_the_middle_half(curves) -> None:
    scores = benchmark.scored(benchmark.summaries(benchmark.read_curves([curves]), 10), 10)
    by = {(s["gap"], s["method"]): s for s in scores}
    assert by["a", "bad"]["iqm"] == pytest.approx(0.2) and by["a", "bad"]["median"] == pytest.approx(0.2)
    assert by["all", "bad"]["runs"] == 8 and ("all", "new") not in by, "new has no run in b"
    assert all(s["low"] <= s["iqm"] <= s["high"] for s in scores)


def test_intervals_are_the_same_each_time_and_leave_the_generator_alone() -> None:
    scores = {"a": np.random.default_rng(0).random((5, 4))}
    np.random.seed(7)
    untouched = np.random.random()
    np.random.seed(7)
    first = benchmark.estimates(scores, lambda x: np.array([x.mean()]))
    assert np.random.random() == untouched
    assert benchmark.estimates(scores, lambda x: np.array([x.mean()])) == first
    assert first["a"][1] < first["a"][0] < first["a"][2]


def test_what_was_measured_before_is_not_run_again(curves, tmp_path, monkeypatch) -> None:
    ran = []

    def finished(command: str, folder: Path, words: list[str], launcher: str | None) -> dict:
        ran.append(words)
        return DONE | {key: value for key, value in (word.split("=") for word in words)}

    monkeypatch.setattr(benchmark.study, "finished", finished)
    monkeypatch.setattr(benchmark.study, "first_mean", lambda *_: None)
    words = ["benchmark", str(tmp_path / "out"), "--gaps", "a", "--methods", "good", "new", "--seeds", "3", "4"]
    monkeypatch.setattr("sys.argv", [*words, "--with", str(curves), "--at", "10", "--jobs", "1"])
    benchmark.main()
    assert [word[1:3] for word in ran] == [["method=good", "seed=4"], ["method=new", "seed=4"]]
    with (tmp_path / "out" / "runs.csv").open() as file:
        rows = {(row["method"], row["seed"]): row for row in csv.DictReader(file)}
    assert set(rows) == {(m, s) for m in ("good", "new") for s in "34"}
    assert rows["good", "3"]["after"] == "0.96" and rows["good", "4"]["after"] == "0.5"


def test_curves_to_take_in_are_never_written_over(curves, tmp_path, monkeypatch, capsys) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    kept = folder / "curves.csv"
    kept.write_text(before := curves.read_text())
    words = ["benchmark", str(folder), "--gaps", "a", "--methods", "good", "--seeds", "3", "--at", "10", "--with"]
    monkeypatch.setattr("sys.argv", [*words, str(kept)])
    with pytest.raises(SystemExit):
        benchmark.main()
    assert "Move it" in capsys.readouterr().err and kept.read_text() == before
    kept.unlink()
    monkeypatch.setattr("sys.argv", [*words, str(curves)])  # all of it is known: there is nothing to run
    benchmark.main()
    assert not kept.exists() and (folder / "runs.csv").is_file()


def test_who_is_probably_better(curves) -> None:
    found = benchmark.better(benchmark.summaries(benchmark.read_curves([curves]), 10), 10)
    by = {(f["method"], f["over"]): f for f in found}
    assert by["good", "bad"]["probability"] == 1.0 and by["bad", "good"]["probability"] == 0.0
    assert by["good", "new"]["probability"] == 0.5, "ties count half"
    assert by["good", "new"]["gaps"] == "a" and by["good", "bad"]["gaps"] == "a b"


def test_a_run_given_twice_is_refused(curves) -> None:
    with pytest.raises(ValueError, match="is there twice"):
        benchmark.read_curves([curves, curves])


def test_a_file_that_is_no_curve_is_refused_in_a_line(tmp_path, monkeypatch) -> None:
    (tmp_path / "other.csv").write_text("gap,seed\na,0\n")
    words = ["benchmark", str(tmp_path), "--gaps", "a", "--score-only", "--with"]
    for name, says in (("other.csv", "has no column method"), ("nowhere.csv", "No such file")):
        monkeypatch.setattr("sys.argv", [*words, str(tmp_path / name)])
        with pytest.raises(SystemExit, match=says):
            benchmark.main()


def test_it_scores_what_was_measured_before_and_says_if_there_is_nothing(curves, tmp_path, monkeypatch) -> None:
    words = ["benchmark", str(tmp_path / "out"), "--gaps", "a", "b", "--methods", "good", "bad", "--score-only"]
    words += ["--seeds", "0", "1", "2", "3"]
    monkeypatch.setattr("sys.argv", [*words, "--with", str(curves), "--at", "10", "20"])
    benchmark.main()
    with (tmp_path / "out" / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 32 and {row["method"] for row in rows} == {"good", "bad"}
    monkeypatch.setattr("sys.argv", [*words, "--with", str(curves), "--at", "30"])
    with pytest.raises(SystemExit, match=r"after \[30\] rollouts"):
        benchmark.main()
