"""Which of the fitted sets is the answer, on a problem made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.effect_table import INCLUDES
from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.fitting.fit import fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import NOISE, Setup
from mpc_sgft.diagnose.fitting.residual_model import ResidualModel
from mpc_sgft.diagnose.verdict.naming import find_ties, gains
from mpc_sgft.diagnose.verdict.relevance import certain, errors_by_signal, what_matters
from mpc_sgft.diagnose.verdict.tolerance import Tolerance
from mpc_sgft.diagnose.verdict.uncertainty import intervals
from mpc_sgft.diagnose.verdict.verdict import reach_verdict
from tests.mpc_sgft.diagnose.lines import Lines, Points, motion, term


def test_a_gain_is_worth_a_name_from_a_twentieth_of_the_error_on() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none)
    base, rng = judge_fit(setup, setup.baseline), np.random.default_rng(0)
    scatter = np.abs(0.001 * rng.normal(size=24))

    def better(before: float, gain: float) -> bool:
        small, large = (base._replace(errors=x + scatter) for x in (before, before - gain - scatter))
        return gains(setup, small, large, rng)

    assert not better(0.7, 0.03) and better(0.7, 0.04)
    assert not better(4.0, 0.18) and better(4.0, 0.22)


@pytest.mark.parametrize(("mass", "kind"), [(1.0, "effect"), (0.9, "not_identifiable")])
def test_a_tie_that_needs_another_mass_loses_against_one_that_finds_it_as_given(mass: float, kind: str) -> None:
    problem, fitted, none, one = Lines(), np.arange(18), np.zeros(1), np.ones(1)
    c = problem.columns
    c["nominal"] = 100 * c["h"]
    c["b"] = c["a"] + 0.05 * c["nominal"]
    problem.y = mass * c["nominal"] + 3 * c["a"] + np.random.default_rng(3).normal(size=problem.y.shape)
    nominal = replace(term("nominal"), neutral=one, low=0.7 * one, high=1.3 * one, size=0.15 * one)
    base = fit(problem, [nominal], [one], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    named = [judge_fit(setup, fit(problem, [nominal, term(x)], [one, one], fitted)) for x in "ba"]
    verdict = reach_verdict(setup, [judge_fit(setup, base), *named], None, np.random.default_rng(0), motion(problem))
    assert verdict.kind == kind and sorted({*verdict.best.names, *(n for e, _ in verdict.ties for n in e.names)}) == (
        ["a"] if kind == "effect" else ["a", "b"]
    )


def test_what_is_repaired_with_traces_holds_the_name_that_a_convention_prefers() -> None:
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    c, one = problem.columns, np.ones(1)
    c |= {"gravity_tilt": c["b"], "actuator_offset": c["b"]}
    problem.y = 6 * c["b"] + 0.3 * c["c"] + rng.normal(size=problem.y.shape)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, squared=np.expm1)
    names = (["gravity_tilt"], ["actuator_offset"], ["gravity_tilt", "c"])
    sets = [judge_fit(setup, fit(problem, [term(n) for n in x], [one] * len(x), fitted)) for x in names]
    sets[0] = sets[0]._replace(errors=sets[0].errors - 1e-3)
    verdict = reach_verdict(setup, [judge_fit(setup, setup.baseline), *sets], None, rng, motion(problem, 0.1))
    assert (verdict.best.names, verdict.there.names) == (["actuator_offset"], ["gravity_tilt", "c"])
    assert verdict.whole.names == ["actuator_offset", "c"]
    assert verdict.whole.values[0] == pytest.approx(6, abs=0.2)


@pytest.mark.parametrize(
    ("before", "after", "kind"), [(60.0, 8.0, "unknown"), (60.0, 6.0, "effect"), (6.0, 1.9, "effect")]
)
def test_names_that_leave_much_of_an_error_are_no_answer(before: float, after: float, kind: str) -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none)
    scatter = 0.01 * np.random.default_rng(0).normal(size=24)
    base = judge_fit(setup, setup.baseline)._replace(errors=np.log1p(before) + scatter)
    named = judge_fit(setup, fit(problem, [term("a")], [np.ones(1)], fitted))._replace(errors=np.log1p(after) + scatter)
    verdict = reach_verdict(setup, [base, named], None, np.random.default_rng(0), motion(problem))
    assert verdict.kind == kind
    assert verdict.probability[frozenset({"b"})] == 0, "a set that is only fitted to tell shares has won nothing"


@pytest.mark.parametrize(
    ("left", "flexible", "kind", "words"),
    [
        (1.1, None, "none", "within noise"),
        (6.0, None, "none", "no name explains the error"),
        (6.0, 5.9, "none", "no name and no flexible model explains the error"),
        (6.0, 2.0, "unknown", "a flexible residual model explains"),
    ],
)
def test_an_error_is_unknown_if_a_flexible_model_explains_it(
    left: float, flexible: float | None, kind: str, words: str
) -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none)
    errors = np.log1p(left) + 0.01 * np.random.default_rng(0).normal(size=24)
    base = judge_fit(setup, setup.baseline)._replace(errors=errors)
    model = None if flexible is None else ResidualModel(errors + np.log1p(flexible) - np.log1p(left))
    verdict = reach_verdict(setup, [base], model, np.random.default_rng(0), motion(problem))
    assert verdict.kind == kind and words in verdict.reason
    assert not verdict.best.effects


@pytest.mark.parametrize(("limit", "kind"), [(0.5, "unknown"), (1.1, "effect"), (4.0, "none")])
def test_what_is_left_within_the_tolerance_is_no_unknown(limit: float, kind: str) -> None:
    """Half of the error has a name; the rest is as large, and no name's."""
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    rest = 3 * rng.normal(size=problem.y.shape)
    problem.y = 6 * problem.columns["b"] + rest
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, squared=np.expm1)
    named = judge_fit(setup, fit(problem, [term("b")], [np.ones(1)], fitted))
    allowed = motion(problem, limit * float(np.sqrt((rest**2).mean() - 1)) / float(problem.y.std()), asked=True)
    verdict = reach_verdict(setup, [judge_fit(setup, setup.baseline), named], None, rng, allowed)
    assert verdict.kind == kind, verdict.reason
    assert [t.term.effect for t in verdict.traces] == (["b"] if kind == "none" else [])


@pytest.mark.parametrize(
    ("limit", "asked", "kind"), [(0.5, True, "unknown"), (4.0, True, "none"), (0.5, False, "none")]
)
def test_an_error_beyond_the_tolerance_that_no_name_explains_is_unknown(limit: float, asked: bool, kind: str) -> None:
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    problem.y = 3 * rng.normal(size=problem.y.shape)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, squared=np.expm1)
    wrong = judge_fit(setup, fit(problem, [term("b")], [np.ones(1)], fitted))
    allowed = motion(problem, limit, asked)
    verdict = reach_verdict(setup, [judge_fit(setup, setup.baseline), wrong], None, rng, allowed)
    assert verdict.kind == kind, verdict.reason


@pytest.mark.parametrize(("most", "kind"), [(0.6, "none"), (1.3, "effect")])
def test_an_error_that_is_faint_in_every_window_needs_no_name(most: float, kind: str) -> None:
    """An effect that lowers it credibly is a trace, unless some window misses by more."""
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    problem.y = 0.2 * problem.columns["a"]
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    scatter = 0.01 * np.abs(np.random.default_rng(0).normal(size=24))
    worst = scatter + np.where(np.arange(24) == 3, most - 0.5, 0.0)
    base = judge_fit(setup, setup.baseline)._replace(errors=0.5 + worst)
    named = judge_fit(setup, fit(problem, [term("a")], [np.ones(1)], fitted))._replace(errors=0.02 + scatter)
    rng = np.random.default_rng(0)
    verdict = reach_verdict(replace(setup, faint=NOISE), [base, named], None, rng, motion(problem))
    assert verdict.kind == kind, verdict.reason
    assert ([*verdict.best.names], [t.term.effect for t in verdict.traces]) == (
        ([], ["a"]) if kind == "none" else (["a"], [])
    )
    assert reach_verdict(setup, [base, named], None, rng, motion(problem)).kind == "effect"


@pytest.mark.parametrize(
    ("within", "kind", "words"),
    [(8, "effect", "a"), (2, "unknown", "a leaves more than noise and contacts make in 6 of 24 windows")],
)
def test_a_name_must_explain_the_windows_in_which_a_deployment_errs(within: int, kind: str, words: str) -> None:
    """Eight windows of 24 are missed, by four times what noise and contacts make; the others hide that in a mean."""
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    problem.y = 0.2 * problem.columns["a"]
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, faint=NOISE)
    hit, brought = np.arange(24) % 3 == 0, np.arange(24) < 3 * within
    low, scatter = 0.03 - 0.02 * hit, 0.005 * np.random.default_rng(0).normal(size=24)
    base = judge_fit(setup, setup.baseline)._replace(errors=0.2 + scatter + np.where(hit, np.log1p(4.0) - 0.2, 0.0))
    a = judge_fit(setup, fit(problem, [term("a")], [np.ones(1)], fitted))
    a = a._replace(errors=np.where(hit & ~brought, np.log1p(3.8), low + np.abs(scatter)))
    verdict = reach_verdict(setup, [base, a], None, np.random.default_rng(0), motion(problem))
    assert verdict.kind == kind and words in verdict.reason, verdict.reason
    alone = reach_verdict(setup, [base], None, np.random.default_rng(0), motion(problem))
    assert alone.kind == "unknown" and "in 8 of 24 windows, which no name explains" in alone.reason
    rare = base._replace(errors=np.where(np.arange(24) < 6, base.errors, 0.2))  # two windows: contacts, once in a while
    assert reach_verdict(setup, [rare], None, np.random.default_rng(0), motion(problem)).kind == "none"


def test_a_rival_that_is_worse_with_the_traces_in_it_does_not_tie() -> None:
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(0)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)

    def judged(names: str, error: float) -> Hypothesis:
        h = judge_fit(setup, fit(problem, [term(n) for n in names], [np.ones(1)] * len(names), fitted))
        return h._replace(errors=error + 0.01 * np.random.default_rng(len(names)).normal(size=24))

    best, rival, there, worse = judged("a", 1.3), judged("b", 1.25), judged("ac", 0.9), judged("bc", 1.1)
    alike = worse._replace(errors=there.errors, fitted=there.fitted)
    assert find_ties(setup, best, best, [best, rival, there, worse], rng) == [rival]
    assert find_ties(setup, best, there, [best, rival, there], rng) == [rival], "nobody has looked"
    assert find_ties(setup, best, there, [best, rival, there, worse], rng) == []
    assert find_ties(setup, best, there, [best, rival, there, alike], rng) == [rival]


@pytest.mark.parametrize(("rest", "kind"), [(1.0, "effect"), (3.0, "unknown")])
def test_what_traces_explain_is_no_unknown(rest: float, kind: str) -> None:
    """Beside a name that matters, a trace and the rest: both together are beyond the tolerance."""
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    c, noise = problem.columns, rng.normal(size=problem.y.shape)
    problem.y = 6 * c["b"] + 2.0 * c["c"] + rest * rng.normal(size=problem.y.shape) + noise
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, squared=np.expm1)
    sets = [judge_fit(setup, fit(problem, [term(n) for n in x], [np.ones(1)] * len(x), fitted)) for x in ("b", "bc")]
    allowed = motion(problem, 2.15 / float(problem.y.std()), asked=True)
    assert not allowed.allows(sets[0].fit)
    verdict = reach_verdict(setup, [judge_fit(setup, setup.baseline), *sets], None, rng, allowed)
    assert (verdict.kind, verdict.best.names, [t.term.effect for t in verdict.traces]) == (kind, ["b"], ["c"])


@pytest.mark.parametrize(
    ("limit", "asked", "kind"), [(0.3, True, "effect"), (1.0, True, "not_identifiable"), (1.0, False, "effect")]
)
def test_sets_that_foretell_the_same_for_the_user_tie(limit: float, asked: bool, kind: str) -> None:
    """What no set holds is as large as that by which they differ, and decides for the wrong one."""
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    c, noise = problem.columns, 0.1 * rng.normal(size=problem.y.shape)
    c["b"] = c["a"] + 0.05 * c["h"]
    problem.y = 6 * c["a"] + 0.3 * c["h"] + noise
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    sets = [judge_fit(setup, fit(problem, [term(n)], [np.ones(1)], fitted)) for n in "ab"]
    allowed = replace(motion(problem, limit / float(problem.y.std()), asked), noise=0.1 * np.ones(1))
    verdict = reach_verdict(setup, [judge_fit(setup, setup.baseline), *sets], None, rng, allowed)
    assert (verdict.kind, verdict.best.names) == (kind, ["b"])


def test_an_effect_must_matter_for_certain() -> None:
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    c = problem.columns
    problem.y = 3 * c["a"] + 0.2 * c["b"] + rng.normal(size=problem.y.shape)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    both = judge_fit(setup, fit(problem, [term("a"), term("b")], [np.ones(1)] * 2, fitted))
    (low,), (high,) = intervals(both)[1]
    value = both.values[1][0]
    assert low < 0.2 < high and certain(both, 1) == pytest.approx(low / value)
    assert certain(both._replace(fit=both.fit._replace(values=(both.values[0], -both.values[1]))), 1) == pytest.approx(
        low / value
    )
    assert certain(both._replace(fit=both.fit._replace(values=(both.values[0], 0.01 * both.values[1]))), 1) < 1e-6


class TwoParts(Lines):
    """The effect "rich" does `a` as its first parameter says, and `b` as its second."""

    def __init__(self) -> None:
        super().__init__()
        self.columns["rich"] = self.columns["a"]

    def residuals(self, terms: Sequence[Term], points: Points, pick: np.ndarray) -> np.ndarray:
        more = [sum(v[1] * self.columns["b"] for v in values if len(v) > 1) for values in points]
        return super().residuals(terms, points, pick) + np.stack([np.broadcast_to(x, self.y.shape)[pick] for x in more])


def test_a_simpler_effect_is_tried_where_traces_hid_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was fitted beside a trace only; once that is gone, the richer one must still make way."""
    monkeypatch.setitem(INCLUDES, "rich", {"a": {"p": "a"}})
    problem, fitted, none, rng = TwoParts(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    c, two = problem.columns, np.ones(2)
    problem.y = 10 * c["a"] + 0.3 * c["b"] + 0.3 * c["h"] + rng.normal(size=problem.y.shape)
    rich = replace(
        term("rich"), names=("p", "q"), units=("1", "1"), neutral=0 * two, low=-50 * two, high=50 * two, size=two
    )
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    base = judge_fit(setup, setup.baseline)
    sets = [
        judge_fit(setup, fit(problem, [t, term("h")], [0.5 * np.ones(len(t.size)), np.ones(1)], fitted))
        for t in (rich, term("a"))
    ]
    best, traces = what_matters(setup, sets[0], [base, *sets], rng, motion(problem, 0.2))
    assert (best.names, [t.term.effect for t in traces]) == (["a"], ["h"])
    assert best.values[0] == pytest.approx(10, abs=0.1)


@pytest.mark.parametrize(
    ("asked", "limits", "kind"),
    [(True, [0.1] * 4, "unknown"), (True, [0.1] * 3 + [np.inf], "effect"), (False, [0.1] * 4, "effect")],
)
def test_one_signal_of_four_that_nothing_explains_is_unknown_where_it_was_said_how_well_it_must_be_foretold(
    asked: bool, limits: list[float], kind: str
) -> None:
    """Three quarters of the points are noise once b is named, in the others 1.7 times the noise is left."""
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(5)
    problem.blocks = 10
    last = np.arange(40) % 4 == 3
    problem.y = np.where(last, 1.7, 4 * problem.columns["b"]) + rng.normal(size=problem.y.shape)
    problem.columns["b"] = np.where(last, 0.0, problem.columns["b"])
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    setup = replace(setup, squared=np.expm1)
    sets = [judge_fit(setup, setup.baseline), judge_fit(setup, fit(problem, [term("b")], [np.ones(1)], fitted))]
    assert errors_by_signal(setup, sets[1], np.ones(24)) == pytest.approx([1, 1, 1, 3.89], rel=0.15)
    line = motion(problem, asked=asked)
    tolerance = Tolerance(
        np.array(limits),
        lambda fits: line.predict(fits).reshape(len(fits), 24, 10, 4),
        problem.y.reshape(24, 10, 4),
        0.9 * np.ones(4),
        asked,
    )
    assert not tolerance.allows(sets[1].fit)
    assert reach_verdict(setup, sets, None, rng, tolerance).kind == kind
