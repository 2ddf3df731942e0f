"""The search over sets, on a problem made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.candidates.library import Term, as_gap, candidates, settings, simplify
from mpc_sgft.diagnose.fitting import screening
from mpc_sgft.diagnose.fitting import search as searching
from mpc_sgft.diagnose.fitting.fit import Fit, fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, holds, judge_fit
from mpc_sgft.diagnose.fitting.prepare import NOISE, Setup
from mpc_sgft.diagnose.fitting.screening import Effort, Proposal
from mpc_sgft.diagnose.fitting.search import no_worse, of_each, search, swaps
from mpc_sgft.diagnose.simulation.plant import Change, Plant
from mpc_sgft.diagnose.verdict.verdict import reach_verdict
from tests.mpc_sgft.diagnose.lines import Lines, Points, motion, term

PENDULUM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.4" mass="1"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


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


def test_a_set_gets_no_more_quick_fits_than_starts_however_well_it_promises() -> None:
    problem, fitted, none = Lines(), np.arange(18), np.zeros(1)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, NOISE)
    a, b, c = (term(name) for name in "abc")
    ranked = [Proposal((t,), (np.array([x]),), 0.0) for t, x in ((a, 1.0), (a, 2.0), (a, 3.0), (b, 4.0), (c, 5.0))]
    kept = of_each(setup, ranked, starts=2, most=2)
    assert [float(p.start[0][0]) for p in kept] == [1.0, 2.0, 4.0]


def found(pairs: int, problem: Lines | None = None, **numbers: int) -> list[set[str]]:
    problem, fitted = problem or Lines(), np.arange(18)
    base = fit(problem, [], [], fitted)
    none = np.zeros(1)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p, NOISE)
    terms = [term(name) for name in "abcdefghxy"]
    effort = Effort(beam=(1,), full=(1, 1, 1), pairs=pairs)._replace(**numbers)
    _, hypotheses = search(setup, terms, 2, np.random.default_rng(0), effort=effort)
    return [set(e.names) for e in hypotheses if e.error < NOISE + 0.1]


def test_two_effects_that_nearly_cancel_are_found_together() -> None:
    assert found(pairs=4) == [{"x", "y"}]


@pytest.mark.parametrize(("alone", "sets"), [(1, []), (3, [{"x", "y"}])])
def test_where_no_effect_gains_alone_more_of_them_are_extended(alone: int, sets: list[set[str]]) -> None:
    """By chance the best of those that do nothing is none of the two that do all together."""
    problem = Lines()
    problem.columns["a"] = np.random.default_rng(9).normal(size=problem.y.shape) + 0.03 * problem.y
    assert found(pairs=0, problem=problem, full=(10, 1, 1), exchange=0, alone=alone) == sets


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
