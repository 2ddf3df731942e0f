"""What the model's forces miss along the measured motion, where a law is visible by eye."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit, change_of
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.simulation.plant import joint_of
from mpc_sgft.diagnose.verdict.locate import missing_force

MOST = 6  # joints that are drawn


class Law(NamedTuple):
    """Of one joint: what force is missing, and along what.

    Attributes:
        joint: Its name.
        slide: Whether it slides, with forces in N.
        position, speed: [M] rad or m, rad/s or m/s.
        command: Of the actuator that drives it, [M]; None where none does or it never changes.
        before: Missing force of the nominal model, [M] N m or N.
        after: Of the repaired one; None where what was found is no force, or nothing was.
    """

    joint: str
    slide: bool
    position: Array
    speed: Array
    command: Array | None
    before: Array
    after: Array | None


def laws(setup: Setup, repaired: Fit) -> list[Law]:
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
    for j, joint in enumerate(plant.joints):
        command = u[:, drives[joint]] if joint in drives else None
        if command is not None and not np.ptp(command):
            command = None
        left = None if after is None else after[:, j]
        out.append(Law(joint, plant.axes()[joint].slide, q[:, j], v[:, j], command, before[:, j], left))
    return sorted(out, key=lambda law: -float(np.median(np.abs(law.before))))[:MOST]
