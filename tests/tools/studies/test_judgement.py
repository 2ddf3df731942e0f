"""Each threshold is there, is put out of the way and back, and the rows count what changed without it."""

import importlib
from pathlib import Path

import pytest

from mpc_sgft.diagnose import run as runs
from tools.studies import judgement
from tools.studies.judgement import THRESHOLDS, Threshold, idle, rows, search_once


@pytest.mark.parametrize("threshold", THRESHOLDS, ids=lambda t: t.name)
def test_a_threshold_is_idle_for_a_while(threshold: Threshold) -> None:
    modules = [importlib.import_module(f"mpc_sgft.diagnose.{m}") for m in threshold.modules]
    before = [getattr(m, threshold.name) for m in modules]
    with pytest.raises(RuntimeError), idle(threshold.name):
        assert all(getattr(m, threshold.name) == threshold.idle for m in modules) and threshold.idle not in before
        raise RuntimeError
    assert [getattr(m, threshold.name) for m in modules] == before


def test_thresholds_are_idle_together() -> None:
    judge, uncertainty = (
        importlib.import_module(f"mpc_sgft.diagnose.{m}") for m in ("fitting.judge", "verdict.uncertainty")
    )
    before = judge.MIN_SHARE, judge.TIE_ODDS, uncertainty.WIDER
    with idle("MIN_SHARE+WIDER"):
        assert (judge.MIN_SHARE, judge.TIE_ODDS, uncertainty.WIDER) == (0.0, before[1], 1.0)
    assert (judge.MIN_SHARE, judge.TIE_ODDS, uncertainty.WIDER) == before


def test_a_threshold_that_is_none_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        judgement.main(["cases", "--without", "MIN_SHARE+MIN_LUCK"])
    assert "MIN_LUCK is no threshold; there are MIN_SHARE" in capsys.readouterr().err


def test_a_case_is_searched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[str] = []

    def search(which: str) -> tuple[str, list[str]]:
        searched.append(which)
        return f"setup {which}", [which]

    def run() -> list[object]:
        first = runs.search("first")  # pyright: ignore
        first[1].append("judged")  # pyright: ignore
        return [first, runs.search("second")]  # pyright: ignore

    monkeypatch.setattr(runs, "search", search)
    monkeypatch.setattr(runs, "run", run)
    with search_once():
        once, again = runs.run(), runs.run()  # pyright: ignore
    assert once == again == [("setup first", ["first", "judged"]), ("setup second", ["second"])]
    assert searched == ["first", "second"] and runs.search is search and runs.run is run


def test_a_problem_that_the_search_leaves_is_that_of_each_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def run() -> bool:
        first = object()
        return runs.search(first)[0] is first  # pyright: ignore

    monkeypatch.setattr(runs, "search", lambda setup: (setup, []))
    monkeypatch.setattr(runs, "run", run)
    with search_once():
        assert runs.run() and runs.run()  # pyright: ignore


def test_rows_count_right_answers_and_changed_ones() -> None:
    def label(group: str, *names: str) -> dict:
        effects = [{"name": n, "at": ["j"], "multiple": 3.0, "parameters": {}} for n in names]
        return {"group": group, "kind": "", "effects": effects, "equivalents": [], "alike": []}

    def said(verdict: str, *names: str) -> dict:
        return {
            "verdict": verdict,
            "effects": [{"name": n, "at": ["j"], "parameters": {}} for n in names],
            "candidates": [],
            "ties": [],
        }

    right = {"a": said("effect", "payload"), "b": said("none")}
    wrong = {"a": said("effect", "payload", "armature"), "b": said("effect", "payload")}
    found = {c: {"": right[c]} | {t.name: right[c] for t in THRESHOLDS} for c in right}
    found["a"]["MATTERS"], found["b"]["MATTERS"] = wrong["a"], wrong["b"]
    table = {r["without"]: r for r in rows(found, {"a": label("single", "payload"), "b": label("none")})}
    assert (table["nothing"]["single_exact"], table["nothing"]["false_alarms"]) == (1.0, 0.0)
    assert [table["MATTERS"][k] for k in ("single_exact", "false_alarms", "changed")] == [0, 1, 2]
    assert all(r["changed"] == 0 for name, r in table.items() if name != "MATTERS")


def test_a_folder_without_cases_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert judgement.main([str(tmp_path)]) == 2
    assert "holds no cases yet" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
