"""Verdicts on the paper's claims, from curves made by hand."""

import pytest

from tools.studies import paper_figures
from tools.studies.paper_figures import (
    CONFIRMED,
    IN_THE_MEAN,
    NOT,
    OPEN,
    PUSH,
    TASKS,
    drawn,
    falls_first,
    poor,
    reaches,
)


def curves(method: str = "sgft", **success: dict[int, list[float]]) -> dict:
    return {gap: {method: points} for gap, points in success.items()}


def test_what_was_not_run_is_not_tested() -> None:
    assert poor({})[1] == falls_first({})[1] == reaches(("turned",), 1.0, 200)({})[1] == OPEN
    assert reaches(("turned", "skate"), 1.0, 200)(curves(turned={0: [0.0], 10: [1.0]}))[1] == OPEN


def test_a_goal_is_reached_by_the_median_within_the_rollouts_of_the_claim() -> None:
    found = curves(turned={0: [0.0] * 3, 10: [0.5, 1.0, 1.0], 300: [0.0] * 3})
    said, verdict = reaches(("turned",), 1.0, 200)(found)
    assert verdict == CONFIRMED and said == "turned 100 % after 10"
    assert reaches(("turned",), 1.0, 400)(found)[1] == NOT


def test_zero_shot_is_poor_if_it_is_so_everywhere() -> None:
    gaps = dict.fromkeys((*PUSH, *TASKS), {0: [0.1, 0.2, 0.3]})
    assert poor(curves(**gaps))[1] == CONFIRMED
    assert poor(curves(**gaps | {"skate": {0: [0.6]}}))[1] == NOT


@pytest.mark.parametrize("least, expected", [(0.2, CONFIRMED), (0.48, NOT)])
def test_a_baseline_falls_first_if_it_falls_where_zero_shot_did_something(least: float, expected: str) -> None:
    found = curves("tdmpc2", skate={0: [0.5], 10: [least], 20: [0.9]}, turned={0: [0.0], 10: [0.0]})
    assert falls_first(found)[1] == expected


def test_sgft_must_beat_every_baseline_of_the_paper(monkeypatch) -> None:
    def rows(names, low: str = "0.6") -> list[dict[str, str]]:
        shared = {"method": "sgft", "rollouts": "10", "gaps": "turned", "probability": "0.9", "low": low, "high": "1"}
        return [{**shared, "over": name} for name in names]

    def verdict(found) -> str:
        monkeypatch.setattr(paper_figures, "rows_of", lambda _: found)
        return paper_figures.faster({})[1]

    monkeypatch.setattr(paper_figures, "existing", lambda *_: ["there"])
    every = paper_figures.BASELINES
    assert verdict(rows([*every, "sgft_sac"])) == IN_THE_MEAN
    assert verdict(rows(every[1:])) == OPEN, "one was not run"
    assert verdict([*rows(every[1:]), *rows(every[:1], low="0.5")]) == NOT


def test_the_horizon_matters_if_returns_differ_more_with_the_peg(monkeypatch) -> None:
    def verdict(**ends: tuple[float, float]) -> str:
        found = {gap: {f"H={i}": {0: [9.0], 10: [end]} for i, end in enumerate(both)} for gap, both in ends.items()}
        monkeypatch.setattr(paper_figures, "values", lambda *_: found)
        return paper_figures.horizon_matters({})[1]

    assert verdict(sluggish=(0.0, 1.0)) == OPEN
    assert verdict(rope_real=(10.0, 40.0), walker_real=(90.0, 100.0)) == CONFIRMED
    assert verdict(rope_real=(38.0, 40.0), walker_real=(90.0, 100.0)) == NOT


def test_there_is_a_panel_for_each_gap() -> None:
    found = curves(a={0: [0.0, 0.1]}, b={0: [0.0]}, c={0: [0.0]}, d={0: [0.0]}, e={0: [0.0]})
    figure = drawn(found, list(found), "success")
    assert [axis.get_title().split(",")[0] for axis in figure.axes if axis.axison] == list(found)
    assert figure.axes[0].get_title() == "a, seeds: 2"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["sgft"]
    assert len(drawn(found, ["a"], "success").axes) == 1
