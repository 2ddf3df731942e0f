"""Dry friction that is highest at the onset of motion and falls as the joint gets faster."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Effect
from envs.effects.passive import add_force, effective_inertia, scalar_joints, stiff_dry_friction

# exp(-x^2) by straight lines, least squares over knots and heights: at most 0.028 off
KNOTS = np.array([0.274, 1.257, 1.95])
HEIGHTS = np.array([0.945, 0.178, 0.0])
RESOLVED = 0.5  # the fall over one time step, as a share of the momentum


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Dry friction with the Stribeck curve, added to what the joint has.

        F(v) = sign(v) (coulomb + (static - coulomb) exp(-(v / velocity)^2)),  and up to `static` at rest

    MuJoCo's dry friction holds with `static`; forces without an input, each linear up to a speed and constant beyond,
    give back static - coulomb as the joint gets faster. So the joint truly sticks, there is no bristle state to start,
    and the curve is piecewise linear, 3 % of (static - coulomb) from the exponential. A fall that the time step cannot
    resolve (more than half of the momentum per step) is stretched to what it can. A static level below coulomb is
    friction that rises with speed.
    """

    coulomb: float = 0.0
    static: float = 0.0
    velocity: float = 0.1
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"coulomb": "N m or N", "static": "N m or N", "velocity": "rad/s or m/s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        "coulomb": (0.0, 1e4),
        "static": (0.0, 1e4),
        "velocity": (1e-6, 1e3),
    }

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        joints = scalar_joints(spec, self.at)
        knots, heights = np.append(0.0, KNOTS), np.append(1.0, HEIGHTS)
        steepness = -np.diff(heights) / np.diff(knots)
        shares = steepness - np.append(steepness[1:], 0.0)  # slope of each force, of excess / velocity
        excess = self.static - self.coulomb
        for joint, inertia in zip(joints, effective_inertia(spec, joints), strict=True):
            stiff_dry_friction(joint, self.static)
            slowest = steepness.max() * max(excess, 0.0) * spec.option.timestep / (RESOLVED * inertia)
            scale = max(self.velocity, slowest)
            for knot, share in zip(KNOTS, shares, strict=True):
                limit = max(abs(excess * share * knot), 1e-12)
                add_force(
                    spec,
                    f"stribeck_friction/{joint.name}",
                    joint.name,
                    slope=excess * share / scale,
                    limits=(-limit, limit),
                )


EFFECT = StribeckFriction
