"""What the model's forces miss along the measured motion, where a law is visible by eye."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit, change_of
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.simulation.plant import joint_of
from mpc_sgft.diagnose.verdict.locate import missing_force

MOST = 6  # joints that are drawn


class Law(NamedTuple):
    """What is missing, against what it may depend on.

    Attributes:
        where: The joint or signal.
        missing: What of it, with its unit.
        along: Labels with units, and values, each [M].
        before: What the nominal model misses, [M].
        after: What the repaired one misses; None where that cannot be said, or nothing was found.
    """

    where: str
    missing: str
    along: Sequence[tuple[str, Array]]
    before: Array
    after: Array | None


class Laws(NamedTuple):
    """A section of the page: what is drawn, how to read it, and what there is to draw."""

    title: str = ""
    reading: str = ""
    laws: Sequence[Law] = ()


FORCE = (
    "What the measured motion needs and the model does not give, by inverse dynamics of the smoothed recording. "
    "Friction shows against speed, springs and loads against position, gains and dead bands against the command."
)


def missing_forces(setup: Setup, repaired: Fit) -> Laws:
    """Of the joints that miss most of their force, largest first."""
    plant = setup.problem.replayer.plant
    before, q, v, u = missing_force(setup)
    change = change_of(repaired.terms, repaired.values)
    after, memory = None, change.reads or change.frictions or change.late or np.any(change.delay) or np.any(change.lag)
    if repaired.terms and not memory:
        model, own = plant.compile(change), plant.model
        if (model.nq, model.nu) == (own.nq, own.nu):  # no joints of their own, as a play in a drive has
            after = missing_force(setup, repaired)[0]
    drives = {joint: i for i, a in enumerate(plant.actuators) if (joint := joint_of(plant, a))}
    out = []
    for j in np.argsort(-np.median(np.abs(before), 0))[:MOST]:
        joint = plant.joints[j]
        force, place, speed = ("N", "m", "m/s") if plant.axes()[joint].slide else ("N m", "rad", "rad/s")
        along = [(f"speed [{speed}]", v[:, j]), (f"position [{place}]", q[:, j])]
        if joint in drives and np.ptp(u[:, drives[joint]]):
            along.append(("command", u[:, drives[joint]]))
        out.append(Law(joint, f"missing force [{force}]", along, before[:, j], None if after is None else after[:, j]))
    return Laws("The force that is missing", FORCE, out)
