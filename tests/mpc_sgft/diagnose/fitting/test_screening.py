"""A start that is far too large is cut down, and a richer effect starts where the simpler one ended."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.candidates.library import Term, candidates, enrich, includes, simplify
from mpc_sgft.diagnose.fitting import screening as screening
from mpc_sgft.diagnose.fitting.fit import Fit, fit
from mpc_sgft.diagnose.fitting.hypothesis import judge_fit
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.fitting.screening import proposals, screen
from mpc_sgft.diagnose.simulation.plant import Change, Plant

TRUE = 2e-4  # of the typical size
HINGE = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="1"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""


def term(name: str) -> Term:
    one = np.ones(1)
    return Term(name, (), ("a",), ("1",), 0 * one, -50 * one, 50 * one, one, (0.5 * one,), lambda x: Change())


class Steep:
    """One effect, tame at its true size and wild at its typical one."""

    blocks, step, pattern = 20, 1e-5, ()

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.column = rng.normal(size=(24, 20))
        self.y = self.shape(TRUE) * self.column + 0.1 * rng.normal(size=self.column.shape)

    def shape(self, x: float) -> float:
        return 5e3 * x + (5e3 * x) ** 3

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        size = [sum(float(v[0]) for v in p) for p in points]
        return np.stack([(self.shape(x) * self.column - self.y)[pick] for x in size])


@pytest.mark.parametrize(("shrinks", "found"), [(3, True), (0, False)])
def test_an_effect_far_below_its_typical_size_is_seen(
    monkeypatch: pytest.MonkeyPatch, shrinks: int, found: bool
) -> None:
    monkeypatch.setattr(screening, "SHRINKS", shrinks)
    problem, fitted, none = Steep(), np.arange(18), np.zeros(1)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    parent = judge_fit(setup, base)
    ranked, _ = screen(setup, parent, proposals(parent, [term("a")], 1, (1.0, 0.1, 0.01)), 6)
    assert (0.5 < float(ranked[0].start[0][0]) / TRUE < 2.0) == found


def test_a_richer_effect_starts_where_the_simpler_one_ended_whatever_its_idle_parameters() -> None:
    plant = Plant(mujoco.MjSpec.from_string(HINGE))
    dry, rich, bristles = candidates(
        plant, {("joint", "hinge"): TypicalSizes(force=2.0, speed=1.0)}, ["coulomb_friction", "stribeck_friction"]
    )
    starts = enrich(rich, dry, np.array([0.7]))
    assert rich.names == ("coulomb", "excess", "velocity")
    np.testing.assert_allclose(starts, [[0.7, 0.0, 0.1], [0.7, 0.0, 0.5], [0.7, 0.35, 0.1], [0.7, 0.35, 0.5]])
    assert includes(bristles, rich) and not includes(rich, bristles) and not includes(rich, rich)
    assert bristles.names == ("coulomb", "excess", "velocity", "deflection", "damping_ratio")
    np.testing.assert_allclose(enrich(bristles, rich, np.array([0.7, 0.2, 0.3])), [[0.7, 0.2, 0.3, 0.001, 0.1]])
    np.testing.assert_allclose(simplify(bristles, np.array([0.7, 0.2, 0.3, 0.004, 0.5]), rich), [0.7, 0.2, 0.3])


def test_every_effect_of_a_set_counts_however_much_another_shows() -> None:
    problem, fitted, none = Steep(), np.arange(18), np.zeros(1)
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    J = np.stack([1e6 * problem.column[:18], problem.column[18:].repeat(3, 0)], -1)
    both = Fit((term("a"), term("b")), (np.array([TRUE]), np.zeros(1)), base.r, J)
    assert judge_fit(setup, both).complexity == 2


class Spring:
    """r = k (q - rest) - y: a stiffness far below its typical size, at rest far from the motion."""

    blocks, step, pattern = 20, 1e-2, ()

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.q = rng.normal(size=(24, 20))
        self.y = 1e4 * TRUE * (self.q + 2.5) + 0.3 * rng.normal(size=self.q.shape)

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        springs = [p[0] if len(p) else (0.0, 0.0) for p in points]
        return np.stack([(1e4 * k * (self.q - rest) - self.y)[pick] for k, rest in springs])


def test_every_rest_of_a_spring_is_tried_with_small_stiffness() -> None:
    """From rest in the middle derivatives promise most, and lead nowhere."""
    one, both = np.ones(1), np.ones(2)
    starts = tuple(np.array([0.1, rest]) for rest in (0.0, -3.0, 3.0))
    spring = Term(
        "joint_stiffness", (), ("stiffness", "rest"), ("1", "1"), 0 * both, np.array([0, -5.0]), np.array([50, 5.0]),
        both, starts, lambda x: Change(),
    )  # fmt: skip
    problem, fitted, none = Spring(), np.arange(18), 0 * one
    base = fit(problem, [], [], fitted)
    setup = Setup(problem, fitted, np.arange(18, 24), fitted // 3, base, none, none, np.log1p)
    parent = judge_fit(setup, base)
    ranked, _ = screen(setup, parent, proposals(parent, [spring], 1, (1.0, 0.1, 0.01)), 6)
    k, rest = ranked[0].start[0]
    assert rest < -1.5 and 0.3 < k / TRUE < 3
