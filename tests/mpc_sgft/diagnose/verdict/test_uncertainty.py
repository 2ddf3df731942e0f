"""How wide intervals are, on a problem made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.verdict.uncertainty import compared, indistinct, intervals, sure_intervals
from tests.mpc_sgft.diagnose.lines import Lines, Points, motion, term

EVEN = np.ones(24)


def rms(x: Array) -> float:
    return float(np.sqrt((x**2).mean()))


def lines(names: str, problem: Lines, seed: int = 1) -> tuple[Setup, Hypothesis]:
    """A set of lines of weight one each, fitted to their sum with noise."""
    fitted, none = np.arange(18), np.zeros(1)
    problem.y = sum(problem.columns[n] for n in names) + np.random.default_rng(seed).normal(size=problem.y.shape)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    return setup, judge_fit(setup, fit(problem, [term(n) for n in names], [np.ones(1)] * len(names), fitted))


def test_a_parameter_goes_as_far_as_the_tolerance_lets_it() -> None:
    problem = Lines()
    setup, one = lines("a", problem)
    tolerance = motion(problem, 0.02, asked=True)
    by_hand = float(tolerance.limits[0]) / rms(problem.columns["a"])
    assert indistinct(one.fit, tolerance, EVEN) == pytest.approx(by_hand, rel=1e-6)
    (low,), (high,) = sure_intervals(setup, one, tolerance, EVEN)[0]
    (least,), (most,) = intervals(one)[0]
    assert high - low == pytest.approx(2 * np.hypot((most - least) / 2, by_hand), rel=1e-6)


def test_parameters_that_make_up_for_each_other_go_further() -> None:
    """b = a + 0.2 h: weights that move against each other change predictions by 0.2 h alone, about."""
    problem = Lines()
    c = problem.columns
    c["b"] = c["a"] + 0.2 * c["h"]
    (_, both), tolerance = lines("ab", problem), motion(problem, 0.02, asked=True)
    least = min(rms(c["a"] * x - c["b"]) for x in np.linspace(0.5, 1.5, 2001))  # for a change of b by one
    reach = indistinct(both.fit, tolerance, EVEN)
    assert reach[1] == pytest.approx(float(tolerance.limits[0]) / least, rel=0.1)
    assert reach[1] > 3 * float(tolerance.limits[0]) / rms(c["b"])


def test_what_nobody_tolerates_widens_nothing() -> None:
    problem = Lines()
    setup, one = lines("a", problem)
    assert sure_intervals(setup, one, motion(problem, 0.02, asked=False), EVEN) == intervals(one)
    unseen = replace(motion(problem, 0.02, asked=True), limits=np.array([np.inf]))
    (low,), (high,) = sure_intervals(setup, one, unseen, EVEN)[0]
    assert (low, high) == (one.terms[0].low, one.terms[0].high)  # any error will do, and so will any value


class Rugged(Lines):
    """A wave over the parameter of `a`, too short for the truth to matter and steep enough to mislead derivatives."""

    pattern = (0.3, 0.1)

    def residuals(self, terms: Sequence[Term], points: Points, pick: np.ndarray) -> np.ndarray:
        phase = np.arange(self.y.size).reshape(self.y.shape)
        waves = [2 * np.sin(20 * values[0][0] + phase) if values else 0 * phase for values in points]
        return super().residuals(terms, points, pick) + np.stack([x[pick] for x in waves])


def test_where_residuals_are_rugged_derivatives_do_not_decide() -> None:
    """Of twenty data sets, intervals by derivatives hold the truth in few, those by comparison in most."""
    held: dict[str, list[bool]] = {"derivatives": [], "comparison": []}
    for seed in range(20):
        problem = Rugged()
        setup, one = lines("a", problem, seed)
        for name, found in (("derivatives", intervals(one)), ("comparison", compared(setup, one))):
            (low,), (high,) = found[0]
            assert low <= one.values[0][0] <= high
            held[name].append(bool(low <= 1 <= high))
        assert sure_intervals(setup, one, motion(problem), EVEN) == compared(setup, one)
    assert sum(held["derivatives"]) <= 5 and sum(held["comparison"]) >= 16, held


def test_where_they_are_smooth_both_say_about_the_same() -> None:
    setup, one = lines("a", Lines())
    (low,), (high,) = intervals(one)[0]
    (least,), (most,) = compared(setup, one)[0]
    assert least < 1 < most and 0.7 * (high - low) < most - least < 3 * (high - low)
