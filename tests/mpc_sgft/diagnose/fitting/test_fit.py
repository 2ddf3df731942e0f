"""The fit and the comparison on numbers made by hand: a straight line over windows, one of which is wild."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit, by_parts, fit, left_out_errors
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import Setup, leave_out_blocks
from mpc_sgft.diagnose.simulation.plant import Change
from mpc_sgft.diagnose.verdict.naming import distinct, log_odds

SLOPE = Term(
    effect="slope",
    at=(),
    names=("a",),
    units=("1",),
    neutral=np.zeros(1),
    low=np.full(1, -10.0),
    high=np.full(1, 10.0),
    size=np.ones(1),
    starts=(np.full(1, 0.1),),
    build=lambda x: Change(),
)


class Line:
    """r = a x - y with y = 2 x and unit noise, 20 windows of 40 points; in the last one y is 50 higher."""

    blocks, step, pattern = 40, 1e-2, ()

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.x = rng.normal(0, 3, (20, 40))
        self.y = 2.0 * self.x + rng.normal(size=self.x.shape)
        self.y[-1] += 50.0 + 20.0 * self.x[-1]

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        return np.stack([(p[0][0] if p else 0.0) * self.x[pick] - self.y[pick] for p in points])


def test_a_wild_window_does_not_pull_the_fit() -> None:
    line, every = Line(), np.arange(20)
    f = fit(line, [SLOPE], [SLOPE.starts[0]], every)
    least_squares = float((line.x * line.y).sum() / (line.x**2).sum())
    assert abs(f.values[0][0] - 2.0) < 0.05 < 0.5 < abs(least_squares - 2.0)
    errors = left_out_errors(f, every[:, None] // 3)
    assert errors[:-1].max() < 2.5 and errors[-1] > 1000  # and it is judged as it is


def test_a_fit_hops_to_the_deepest_of_minima_a_tick_apart() -> None:
    class Ticks(Line):  # r is what |a - 4.05| and a ripple of period 1 make; minima at 0.05, 1.05, …
        def residuals(self, terms, points, pick):
            a = np.array([p[0][0] for p in points]) - 4.05
            return np.broadcast_to(
                (np.abs(a) + 3 * np.sin(np.pi * a) ** 2)[:, None, None], (len(points), len(pick), 40)
            )

    start, every = [np.array([1.0])], np.arange(20)
    assert abs(fit(Ticks(), [SLOPE], start, every).values[0][0] - 1.05) < 0.2
    assert abs(fit(Ticks(), [replace(SLOPE, hops=(1.0,))], start, every).values[0][0] - 4.05) < 0.01


def test_a_gain_in_a_few_windows_is_credible_and_one_in_a_single_window_is_not() -> None:
    rng = np.random.default_rng(0)
    before, few, one = np.ones(40), np.ones(40), np.ones(40)
    few[:8], one[0] = 0.0, -7.0
    assert judge.credible(before, few, rng) and not judge.credible(before, one, rng)
    assert not judge.credible(before, before - 0.01, rng)  # real, and too small for a name


def test_a_gain_in_all_parts_of_one_window_is_credible_only_where_one_will_do() -> None:
    rng = np.random.default_rng(0)
    before, one, two, part = np.ones((4, 24))
    one[:6], two[3:9], part[0] = 0.0, 0.0, -11.0  # windows of six parts
    assert judge.credible(before, two, rng, parts=6) and not judge.credible(before, one, rng, parts=6)
    assert judge.credible(before, one, rng, parts=6, one_window=True)
    assert not judge.credible(before, part, rng, parts=6, one_window=True)


@pytest.mark.parametrize(("odd", "trusted"), [(0.0, True), (9.0, False)])
def test_one_of_few_windows_shows_an_effect_if_it_foretells_its_parts_but_for_noise(odd: float, trusted: bool) -> None:
    line, fitted, none = Line(), np.arange(3), np.zeros(1)
    line.x[[0, 1, 3]] = 0.0  # the third alone shows the slope
    line.y[[0, 1, 3]] = np.random.default_rng(1).normal(size=(3, 40))
    line.y[2] += odd * np.sin(np.arange(40))
    f = fit(line, [SLOPE], [SLOPE.starts[0]], fitted)
    base = fit(line, [], [], fitted)
    setup = Setup(line, fitted, np.array([3]), leave_out_blocks(3), base, none, none, np.log1p, parts=8)
    judged = judge_fit(setup, f)
    assert setup.one_window(judged.errors) == trusted
    assert (judged.errors[16:24].max() < 1.5) == trusted


def test_what_the_rest_of_the_data_do_not_determine_is_not_foretold() -> None:
    line, fitted, none = Line(), np.arange(8), np.zeros(1)
    line.x[1:9] *= 1e-3  # the first window alone shows the slope
    line.y[1:9] = np.random.default_rng(1).normal(size=(8, 40))
    f, base = fit(line, [SLOPE], [SLOPE.starts[0]], fitted), fit(line, [], [], fitted)
    setup = Setup(line, fitted, np.array([8]), leave_out_blocks(8), base, none, none, np.log1p)
    assert np.log1p(left_out_errors(f, leave_out_blocks(8)[:, None]))[0] > 2 * judge_fit(setup, base).errors[0]
    assert judge_fit(setup, f).errors[0] == judge_fit(setup, base).errors[0]


def test_of_several_effects_each_must_be_credibly_away_from_none() -> None:
    line, every, none = Line(), np.arange(19), np.zeros(1)
    base, rng = fit(line, [], [], every), np.random.default_rng(5)
    setup = Setup(line, every, np.array([19]), leave_out_blocks(19), base, none, none, np.log1p)

    def second(x: np.ndarray) -> Hypothesis:
        """The slope, and an effect with these derivatives [19, 40] that is found to be 1."""
        f = fit(line, [SLOPE], [np.full(1, 2.0)], every)
        both = (*f.terms, replace(SLOPE, effect="other"))
        return judge_fit(setup, Fit(both, (*f.values, np.ones(1)), f.r, np.concatenate([f.J, x[..., None]], 2)))

    assert distinct(second(rng.normal(size=(19, 40)))) and not distinct(second(0.01 * rng.normal(size=(19, 40))))


def test_parts_by_hand() -> None:
    squares = np.array([[1.0, 3.0, 5.0, 7.0, 9.0], [0.0, 0.0, 1.0, 1.0, 1.0]])
    np.testing.assert_allclose(by_parts(squares, 2), [2.0, 7.0, 0.0, 1.0])
    np.testing.assert_allclose(by_parts(squares, 1), squares.mean(1))


def test_where_noise_alone_is_left_a_rival_is_ruled_out_by_its_odds() -> None:
    line, every, none = Line(), np.arange(19), np.zeros(1)
    base, rng = fit(line, [], [], every), np.random.default_rng(0)
    setup = Setup(line, every, np.array([18]), leave_out_blocks(19), base, none, none, np.log1p)
    best, rival = (judge_fit(setup, fit(line, [SLOPE], [np.full(1, a)], every, 0)) for a in (2.0, 2.05))
    apart = ((2.05 * line.x - line.y) ** 2 - (2.0 * line.x - line.y) ** 2)[[*range(19), 18]].sum() / 2
    assert log_odds(setup, best, rival) == pytest.approx(apart)
    even, one = np.zeros(24), np.where(np.arange(24) == 0, 0.6, 0.0)
    assert not judge.ruled_out(one, even, rng) and not judge.ruled_out(one, even, rng, log_odds=np.log(19))
    assert judge.ruled_out(one, even, rng, log_odds=np.log(21))
    assert judge.ruled_out(even + 0.02, even, rng) and not judge.ruled_out(even + 0.02, even, rng, log_odds=np.log(19))


def test_where_noise_alone_is_left_great_odds_need_no_confidence() -> None:
    rng, after = np.random.default_rng(0), np.full(24, 0.5)
    before = after + np.where(np.arange(24) % 2, 0.6, -0.4)  # 0.1 on average, and less in every other part
    assert not judge.credible(before, after, rng) and not judge.credible(before, after, rng, log_odds=np.log(999))
    assert judge.credible(before, after, rng, log_odds=np.log(1001))
    assert not judge.credible(after + 0.01, after, rng, log_odds=np.log(1001))


class Rugged(Line):
    """r = (a - 2) x with a ripple on it, whose derivative is thirty times as large."""

    pattern = (1.0, 0.3, 0.1, 0.03)

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        slopes = np.array([p[0][0] for p in points])[:, None, None]
        return (slopes - 2.0) * self.x[pick] + 0.1 * np.sin(300 * slopes + 10 * self.x[pick])


def test_a_pattern_search_goes_on_where_derivatives_mislead() -> None:
    found = fit(Rugged(), [SLOPE], [np.zeros(1)], np.arange(20))
    assert abs(found.values[0][0] - 2.0) < 0.05
    rugged = Rugged()
    rugged.pattern = ()
    assert abs(fit(rugged, [SLOPE], [np.zeros(1)], np.arange(20)).values[0][0] - 2.0) > 0.1
