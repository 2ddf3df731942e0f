"""The next experiment: among proposals, the one whose simulated outcome separates the tied candidates best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import change_of
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.simulation.plant import Change

WINDOWS = 16  # to simulate
LOAD = 0.5  # of the body's mass
CLEAR = 3.0  # times what hides it: a separation below is not worth an experiment


def _at_speed(ctrl: Array, speed: float) -> Array:
    """The same commands faster or slower, from the start of the recording, repeated where they end."""
    n = len(ctrl)
    return ctrl[np.round(np.arange(n) * speed).astype(int) % n]


def _command_changes() -> dict[str, Callable[[Array], Array]]:
    return {
        "slower motion: the same commands in twice the time": lambda u: _at_speed(u, 0.5),
        "faster motion: the same commands in half the time": lambda u: _at_speed(u, 2.0),
        "larger motion: commands 1.5 times as large": lambda u: u.mean(0) + 1.5 * (u - u.mean(0)),
        "reversals: the same commands mirrored, so that every motion is also made backwards": lambda u: (
            2 * u.mean(0) - u
        ),
        "a hold: the mean command, held": lambda u: np.broadcast_to(u.mean(0), u.shape).copy(),
    }


def next_experiment(setup: Setup, tied: Sequence[Hypothesis]) -> str:
    """Words for the proposal that separates the tied candidates best, and by how many times what hides them."""
    problem = setup.problem
    pick = setup.fitted[np.unique(np.linspace(0, len(setup.fitted) - 1, WINDOWS).astype(int))]
    changes = [change_of(e.fit.terms, e.fit.values) for e in tied[:4]]
    outcomes: dict[str, float] = {}
    for words, change in _command_changes().items():
        replayer = problem.replayer.with_commands(change)
        outcomes[words] = separation(problem.whiten(replayer.simulate(changes, pick), pick))
    for body in problem.replayer.plant.bodies:
        loaded = [c + Change(edits=(_load(body, LOAD * _mass(setup, body)),)) for c in changes]
        words = f"another load: {LOAD * _mass(setup, body):.3g} kg, weighed, on {body}"
        outcomes[words] = separation(problem.whiten(problem.replayer.simulate(loaded, pick), pick))
    hides = "noise and tolerance" if np.any(setup.tolerated) else "the noise"
    return best_of(outcomes, "motions and loads", "measure a force, a current or the load itself", hides)


def best_of(outcomes: dict[str, float], tried: str, otherwise: str, hides: str = "the noise") -> str:
    """The experiment that separates best, in words; what to do otherwise if none does clearly.

    Args:
        outcomes: Experiment in words -> difference of the closest candidates, in units of what hides it.
        tried: What the experiments are, in words.
        otherwise: What else would tell.
        hides: What hides differences, in words.
    """
    words, size = max(outcomes.items(), key=lambda item: item[1])
    if size < CLEAR:
        return f"none of the simulated {tried} separates them (best: {words}, {size:.1f} times {hides}); {otherwise}"
    return f"{words} (simulated, the candidates then differ by {size:.1f} times {hides})"


def separation(r: Array) -> float:
    """Root mean square difference of the closest pair, [K, W, m] -> number."""
    pairs = [(i, j) for i in range(len(r)) for j in range(i)]
    return min(float(np.sqrt(np.mean((r[i] - r[j]) ** 2))) for i, j in pairs) if pairs else 0.0


def _mass(setup: Setup, body: str) -> float:
    return float(setup.problem.replayer.plant.model.body(body).mass[0])


def _load(body: str, mass: float) -> Callable[[mujoco.MjSpec], None]:
    def edit(spec: mujoco.MjSpec) -> None:
        model = spec.copy().compile()
        position = model.body(body).ipos
        load = spec.body(body).add_body(name="diagnose/load", pos=position)
        load.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=mass, contype=0, conaffinity=0)

    return edit
