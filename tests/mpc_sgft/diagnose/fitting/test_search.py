"""The search over sets, on a problem made by hand: residuals are linear in each effect's parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.candidates.library import Term, as_gap, candidates, settings, simplify
from mpc_sgft.diagnose.fitting import screening as screening
from mpc_sgft.diagnose.fitting import search as searching
from mpc_sgft.diagnose.fitting.fit import Fit, fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, holds, judge_fit
from mpc_sgft.diagnose.fitting.prepare import NOISE, Setup
from mpc_sgft.diagnose.fitting.residual_model import ResidualModel
from mpc_sgft.diagnose.fitting.screening import Effort
from mpc_sgft.diagnose.fitting.search import no_worse, search, swaps
from mpc_sgft.diagnose.simulation.plant import Change, Plant
from mpc_sgft.diagnose.verdict.naming import find_ties, gains, intervals
from mpc_sgft.diagnose.verdict.relevance import certain
from mpc_sgft.diagnose.verdict.tolerance import Tolerance
from mpc_sgft.diagnose.verdict.verdict import reach_verdict

Points = Sequence[Sequence[np.ndarray]]
PENDULUM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.4" mass="1"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def term(name: str) -> Term:
    one = np.ones(1)
    return Term(name, (), ("a",), ("1",), 0 * one, -50 * one, 50 * one, one, (0.5 * one,), lambda x: Change())


class Lines:
    """r = y - sum of a_i x_i over the effects; y is the difference of two columns that are nearly the same."""

    blocks, step, pattern = 40, 1e-2, ()

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        shared = rng.normal(size=(24, 40))
        self.columns = {name: rng.normal(size=shared.shape) for name in "abcdefgh"}
        self.columns |= {name: shared + 0.1 * rng.normal(size=shared.shape) for name in "xy"}
        self.y = 30 * (self.columns["x"] - self.columns["y"]) + rng.normal(size=shared.shape)
        self.columns["a"] += 0.1 * self.y  # looks best alone

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        def one(values: Sequence[np.ndarray]) -> np.ndarray:
            return sum((v[0] * self.columns[t.effect] for t, v in zip(terms, values, strict=True)), -self.y)[pick]

        return np.stack([one(p) for p in points])


def motion(problem: Lines, limit: float = 0.01, asked: bool = False) -> Tolerance:
    """Of a share of the motion, which is y."""
    everything = np.arange(len(problem.y))

    def predict(fits: Sequence[Fit]) -> np.ndarray:
        return np.stack([(problem.residuals(f.terms, [f.values], everything)[0] + problem.y)[..., None] for f in fits])

    limits = np.array([limit * problem.y.std()])
    return Tolerance(limits, predict, problem.y[..., None], np.ones(1), asked)


class Arm(Lines):
    """Sixty effects, of which three are there; counts how many windows were simulated."""

    def __init__(self) -> None:
        rng = np.random.default_rng(2)
        self.columns = {f"e{i}": rng.normal(size=(24, 40)) for i in range(60)}
        self.y = sum(size * self.columns[f"e{i}"] for i, size in ((7, 3.0), (23, 1.0), (41, 0.5)))
        self.y = self.y + 0.3 * rng.normal(size=(24, 40))
        self.simulated = 0

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        self.simulated += len(points) * len(pick)
        return super().residuals(terms, points, pick)


def test_of_many_effects_the_right_ones_are_found_with_fewer_simulations() -> None:
    spent = {}
    for most in (60, 8):
        problem, fitted, none = Arm(), np.arange(18), np.zeros(1)
        base = fit(problem, [], [], fitted)
        setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
        terms = [term(f"e{i}") for i in range(60)]
        _, hypotheses = search(setup, terms, 3, np.random.default_rng(0), effort=Effort(most=most))
        spent[most] = problem.simulated
        assert set(min(hypotheses, key=lambda e: e.error).names) == {"e7", "e23", "e41"}
    assert spent[8] < 0.7 * spent[60], spent


def found(pairs: int) -> list[set[str]]:
    problem, fitted = Lines(), np.arange(18)
    base = fit(problem, [], [], fitted)
    none = np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, NOISE)
    terms = [term(name) for name in "abcdefghxy"]
    effort = Effort(beam=(1,), full=(1, 1, 1), pairs=pairs)
    _, hypotheses = search(setup, terms, 2, np.random.default_rng(0), effort=effort)
    return [set(e.names) for e in hypotheses if e.error < NOISE + 0.1]


def test_two_effects_that_nearly_cancel_are_found_together() -> None:
    assert found(pairs=4) == [{"x", "y"}]


def test_a_small_second_effect_is_found_where_the_first_leaves_less_than_the_noise_that_was_foretold() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    c = problem.columns
    problem.y = 3 * c["a"] + 0.4 * c["b"] + 0.8 * np.random.default_rng(3).normal(size=problem.y.shape)
    base, rng = fit(problem, [], [], fitted), np.random.default_rng(0)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, NOISE)
    _, hypotheses = search(setup, [term(name) for name in "abcdefgh"], 2, rng)
    assert next(e.error for e in hypotheses if e.names == ["a"]) < setup.quiet
    verdict = reach_verdict(setup, hypotheses, None, rng, motion(problem))
    assert (verdict.kind, sorted(verdict.best.names)) == ("effect", ["a", "b"])
    assert max(e.effects for e in search(setup, [term(x) for x in "abcdefgh"], 3, rng)[1]) == 2  # nor a third


def test_further_effects_are_sought_in_the_problem_as_the_first_sees_it() -> None:
    """Far from the first effect, the problem errs so that another would take that away."""
    fitted, none, rng = np.arange(18), np.zeros(1), np.random.default_rng(0)
    far, near = Lines(), Lines()
    near.y = 30 * near.columns["b"] + rng.normal(size=near.y.shape)
    far.y = near.y + 3 * far.columns["c"]
    far.columns |= {"a": near.columns["a"]}
    setups = [
        Setup(p, fitted, np.arange(18, 24), fitted // 3, fit(p, [], [], fitted), none, none, np.log1p, NOISE + 0.05)
        for p in (far, near)
    ]
    asked: list[list[str]] = []

    def nearer(f: Fit) -> Setup[Lines]:
        asked.append([t.effect for t in f.terms])
        return setups[1]

    terms = [term(name) for name in "bcdefgh"]
    assert searched(setups[0], terms, rng) == [["b", "c"]]
    setup, hypotheses = search(setups[0], terms, 2, rng, nearer=nearer)
    assert setup is setups[1] and asked == [["b"]] and not hypotheses[0].effects
    assert reach_verdict(setup, hypotheses, None, rng, motion(setup.problem)).best.names == ["b"]


def searched(setup: Setup[Lines], terms: Sequence[Term], rng: np.random.Generator) -> list[list[str]]:
    setup, hypotheses = search(setup, terms, 2, rng)
    return [sorted(reach_verdict(setup, hypotheses, None, rng, motion(setup.problem)).best.names)]


def test_what_gains_no_more_than_chance_gets_no_full_fit_where_noise_alone_is_left() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    problem.y = np.random.default_rng(3).normal(size=problem.y.shape)
    base = fit(problem, [], [], fitted)
    for quiet, counts in ((NOISE + 0.05, (1, 2)), (0.0, (5,))):
        setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, quiet)
        _, hypotheses = search(setup, [term(name) for name in "bcdefgh"], 1, np.random.default_rng(0))
        assert sum(e.effects for e in hypotheses) in counts


@pytest.mark.parametrize("exchange", [0, 2])
def test_an_effect_that_stood_in_for_two_makes_way_for_them(exchange: int) -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    c = problem.columns
    c["a"] = c["b"] + c["c"] + 0.6 * c["d"]
    problem.y = 30 * (c["b"] + c["c"]) + np.random.default_rng(3).normal(size=problem.y.shape)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, NOISE)
    terms = [term(name) for name in "abcefgh"]
    effort = Effort(beam=(1,), full=(1, 1, 1), pairs=0, exchange=exchange)
    _, hypotheses = search(setup, terms, 2, np.random.default_rng(0), effort=effort)
    assert [set(e.names) for e in hypotheses if e.error < NOISE + 0.1] == [{"b", "c"}] * bool(exchange)


def test_a_delay_is_exchanged_for_a_lag_but_not_where_there_is_one() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    terms = [term("actuator_delay"), term("actuator_lag")]
    problem.columns |= {"actuator_delay": problem.columns["x"], "actuator_lag": problem.columns["y"]}
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    alone, both = (judge_fit(setup, fit(problem, t, [none] * len(t), fitted)) for t in (terms[:1], terms))
    assert [e.names for e in swaps(setup, {alone.key: alone}, terms, Effort()).values()] == [["actuator_lag"]]
    assert not swaps(setup, {both.key: both}, terms, Effort())


def test_a_simpler_effect_and_the_usual_name_of_a_term_are_tried_in_place_of_what_is_there() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    terms = [term("viscous_friction"), term("actuator_offset"), term("gravity_tilt")]
    problem.columns |= dict.fromkeys(("viscous_friction", "asymmetric_friction"), problem.columns["x"])
    problem.columns |= dict.fromkeys(("actuator_offset", "gravity_tilt"), problem.columns["y"])
    both = np.ones(2)
    rich = replace(
        term("asymmetric_friction"), names=("forward", "backward"), neutral=0 * both, low=-50 * both, high=50 * both,
        size=both, starts=(both,),
    )  # fmt: skip
    simple = replace(terms[0], names=("coefficient",))
    assert simplify(rich, np.array([2.0, 4.0]), simple).tolist() == [3.0]
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)
    start = judge_fit(setup, fit(problem, [rich, terms[2]], [both, none], fitted, 0))
    found = swaps(setup, {start.key: start}, [simple, *terms[1:]], Effort()).values()
    names = [e.names for e in found]
    assert names == [["viscous_friction", "gravity_tilt"], ["asymmetric_friction", "actuator_offset"]]
    assert all(e.error < NOISE + 0.1 for e in found if e.names[0] == "viscous_friction")
    assert holds(start, next(iter(found))) and not holds(next(iter(found)), start) and not holds(start, start)


def test_where_noise_alone_is_left_one_more_effect_must_gain_more_than_the_only_one() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    setup = Setup(
        problem,
        fitted,
        np.arange(18, 24),
        fitted // 3,
        fit(problem, [], [], fitted),
        none,
        none,
        quiet=NOISE + 0.1,
    )
    base, rng = judge_fit(setup, setup.baseline), np.random.default_rng(0)
    scatter = np.abs(0.01 * rng.normal(size=24))

    def better(before: float, gain: float, effects: int = 0) -> bool:
        small, large = (base._replace(errors=x + scatter) for x in (before, before - gain - scatter))
        return gains(setup, small._replace(effects=effects), large, rng)

    assert not better(0.65, 0.005) and better(0.65, 0.03)
    assert not better(0.65, 0.03, effects=1) and better(0.65, 0.1, effects=1)
    assert not better(0.95, 0.03) and better(0.95, 0.045)


def test_a_richer_effect_in_place_of_what_it_includes_need_gain_less_than_a_further_one() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none)
    base, rng = judge_fit(setup, setup.baseline)._replace(effects=1), np.random.default_rng(0)
    scatter = np.abs(0.01 * rng.normal(size=24))

    def better(name: str, gain: float) -> bool:
        small, large = (base._replace(fit=base.fit._replace(terms=(term(t),))) for t in ("coulomb_friction", name))
        errors = 0.65 + scatter, 0.65 - gain - scatter
        return gains(setup, small._replace(errors=errors[0]), large._replace(errors=errors[1]), rng)

    assert better("stribeck_friction", 0.02) and not better("stribeck_friction", -0.01)
    assert not better("deadband", 0.02) and better("deadband", 0.1)


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
    model = None if flexible is None else ResidualModel(errors + np.log1p(flexible) - np.log1p(left), np.zeros(1), 1.0)
    verdict = reach_verdict(setup, [base], model, np.random.default_rng(0), motion(problem))
    assert verdict.kind == kind and words in verdict.reason
    assert not verdict.best.effects


def test_a_typical_size_is_no_larger_than_what_is_allowed() -> None:
    plant = Plant(mujoco.MjSpec.from_string(PENDULUM))
    still = {("joint", "hinge"): TypicalSizes(force=1.0, speed=1e-6)}  # drag is counted in force / speed^2
    (drag,) = candidates(plant, still, ["quadratic_drag"])
    assert drag.size[0] == drag.high[0] - drag.low[0] == 1e5


def test_a_set_never_fits_worse_than_one_within_it() -> None:
    """A fit that stopped at once where it began, far off, starts again from the best of what it holds."""
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    x, y = term("x"), term("y")
    small = [judge_fit(setup, fit(problem, [t], [np.ones(1)], fitted)) for t in (x, y)]
    stuck = judge_fit(setup, fit(problem, [y, x], [40 * np.ones(1)] * 2, fitted, 0))
    found = {e.key: e for e in (judge_fit(setup, base), *small)}
    better = no_worse(setup, stuck, found, Effort())

    def cost(e: Hypothesis) -> float:
        return float((e.fit.r**2).sum())

    assert cost(stuck) > 10 * cost(small[0]) and cost(better) <= min(cost(e) for e in small)
    assert better.key == stuck.key and no_worse(setup, better, found, Effort()) is better


def test_gravity_may_turn_about_one_axis_or_both() -> None:
    plant = Plant(mujoco.MjSpec.from_string(PENDULUM))
    tilts = candidates(plant, {("", ""): TypicalSizes()}, ["gravity_tilt"])
    assert [t.names for t in tilts] == [("angle",), ("roll",), ("angle", "roll")]
    assert settings(tilts[0], np.array([0.1])) == {"angle": 0.1, "roll": 0.0}


def test_an_effect_at_two_joints_is_a_list_in_effects_yaml() -> None:
    gap = as_gap([("payload", {"mass": 1.0}), ("armature", {"at": ["a"]}), ("armature", {"at": ["b"]})])
    assert gap == {"payload": {"mass": 1.0}, "armature": [{"at": ["a"]}, {"at": ["b"]}]}


def test_a_richer_set_is_fitted_again_from_where_the_simpler_one_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    X, Z = rng.normal(size=(2, 24, 40))
    y = 2 * X + Z + rng.normal(size=X.shape)

    class Dry(Lines):
        def residuals(self, terms: Sequence[Term], points: Points, pick: np.ndarray) -> np.ndarray:
            def one(values: Sequence[np.ndarray]) -> np.ndarray:
                x = np.concatenate([*values, np.zeros(3)])  # torque, or coulomb, excess, velocity
                return (x[0] * X + x[1] * x[2] * Z - y)[pick]

            return np.stack([one(p) for p in points])

    def dry(name: str, names: tuple[str, ...]) -> Term:
        one = np.ones(len(names))
        return Term(
            name, (), names, ("1",) * len(one), 0 * one, 0 * one, 50 * one, one, (0.5 * one,), lambda x: Change()
        )

    calls: dict[str, list[tuple[list[str], np.ndarray]]] = {"sharpen": [], "search": []}
    for name, module in (("sharpen", screening), ("search", searching)):

        def told(problem, terms, start, pick, iterations=12, name=name):  # noqa: ANN001, ANN202
            calls[name].append(([t.effect for t in terms], np.concatenate([np.zeros(0), *start])))
            return fit(problem, terms, start, pick, iterations)

        monkeypatch.setattr(module, "fit", told)
    problem, fitted, none = Dry(), np.arange(18), np.zeros(1)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    terms = [dry("coulomb_friction", ("torque",)), dry("stribeck_friction", ("coulomb", "excess", "velocity"))]
    search(setup, terms, 1, np.random.default_rng(0))
    rich = {name: [start for names, start in c if names == ["stribeck_friction"]] for name, c in calls.items()}
    assert len(rich["search"]) == 2
    assert any(abs(s[0] - 2) < 0.2 and s[1] == 0 and s[2] == 0.5 for s in rich["sharpen"])


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


def test_a_rival_that_is_worse_with_the_traces_in_it_does_not_tie() -> None:
    problem, fitted, none, rng = Lines(), np.arange(18), np.zeros(1), np.random.default_rng(0)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, fit(problem, [], [], fitted), none, none, np.log1p)

    def judged(names: str, error: float) -> Hypothesis:
        h = judge_fit(setup, fit(problem, [term(n) for n in names], [np.ones(1)] * len(names), fitted))
        return h._replace(errors=error + 0.01 * np.random.default_rng(len(names)).normal(size=24))

    best, rival, there, worse = judged("a", 1.3), judged("b", 1.25), judged("ac", 0.9), judged("bc", 1.1)
    assert find_ties(setup, best, best, [best, rival, there, worse], rng) == [rival]
    assert find_ties(setup, best, there, [best, rival, there], rng) == [rival], "nobody has looked"
    assert find_ties(setup, best, there, [best, rival, there, worse], rng) == []
    assert find_ties(setup, best, there, [best, rival, there, worse._replace(errors=there.errors)], rng) == [rival]


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
