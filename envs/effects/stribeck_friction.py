"""Dry friction that is highest at the onset of motion and falls as the joint gets faster."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Array, Effect
from envs.effects.passive import (
    add_force,
    effective_inertia,
    limit_drives,
    plain,
    scalar_joints,
    stiff_dry_friction,
    unused_name,
)

# exp(-x^2) by straight lines, least squares over knots and heights: at most 0.028 off
KNOTS = np.array([0.274, 1.257, 1.95])
HEIGHTS = np.array([0.945, 0.178, 0.0])
RESOLVED = 0.5  # the fall over one time step, as a share of the momentum; a bristle's swing, in radians a step
BRISTLE = "stribeck_friction/bristle/"  # and the joint: names of the forces whose activations are bristles
SLOW = 0.1  # of the Stribeck velocity: slower joints need not slide
FLAT = 1e-3  # of the static level: the least that a bristle slides with


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Dry friction with the Stribeck curve, added to what the joint has.

        F(v) = sign(v) (coulomb + (static - coulomb) exp(-(v / velocity)^2)),  and up to `static` at rest

    MuJoCo's dry friction holds with `static`; forces without an input, each linear up to a speed and constant beyond,
    give back static - coulomb as the joint gets faster. So the joint truly sticks, there is no bristle state to start,
    and the curve is piecewise linear, 3 % of (static - coulomb) from the exponential. A fall that the time step cannot
    resolve (more than half of the momentum per step) is stretched to what it can. A static level below coulomb is
    friction that rises with speed.

    With a `deflection` it is LuGre friction (Canudas de Wit et al., IEEE TAC 40(3), 1995), MuJoCo's own: bristles of
    stiffness static / deflection, or coulomb / deflection if that is more, bend before they slide, so that over a short
    way the force does not reach its static level. A deflection too small for the time step is one that it can resolve.
    What the bristles damp, MuJoCo's implicit integrators take for damping while they slide, too: an error that vanishes
    with the time step.
    """

    coulomb: float = 0.0
    static: float = 0.0
    velocity: float = 0.1
    deflection: float = 0.0  # of the bristles at the static level; 0: the joint truly sticks
    damping_ratio: float = 0.5  # of the joint on its bristles
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {
        "coulomb": "N m or N",
        "static": "N m or N",
        "velocity": "rad/s or m/s",
        "deflection": "rad or m",
        "damping_ratio": "1",
    }
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        "coulomb": (0.0, 1e4),
        "static": (0.0, 1e4),
        "velocity": (1e-6, 1e3),
        "deflection": (0.0, 10.0),
        "damping_ratio": (0.0, 10.0),
    }

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        joints = scalar_joints(spec, self.at)
        if self.deflection:
            for joint, inertia in zip(joints, effective_inertia(spec, joints), strict=True):
                self._add_bristles(spec, joint.name, inertia)
            return
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

    def _add_bristles(self, spec: mujoco.MjSpec, joint: str, inertia: float) -> None:
        level = max(self.static, self.coulomb)
        if not level:
            return
        stiffness = min(level / self.deflection, inertia * (RESOLVED / spec.option.timestep) ** 2)
        name = unused_name(spec.actuators, BRISTLE + joint)
        limit_drives(spec, spec.joint(joint), "stribeck_friction")
        force = plain(spec.add_actuator(name=name), "actuator")
        force.target, force.trntype = joint, mujoco.mjtTrn.mjTRN_JOINT
        slides = [max(x, FLAT * level) for x in (self.coulomb, self.static)]
        force.set_to_dcmotor(
            motorconst=[0.0, 0.0],
            resistance=1.0,
            lugre=[stiffness, 2 * self.damping_ratio * np.sqrt(stiffness * inertia), *slides, self.velocity],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_NONE),
        )


def bend_bristles(model: mujoco.MjModel, qvel: Array, act: Array) -> None:
    """Bend every bristle as far as it is while its joint goes on sliding at this speed, not at rest; in place.

    Args:
        model: A scene, with or without bristles.
        qvel: [..., nv].
        act: Activations, [..., na].
    """
    for i in bristles(model):
        stiffness, (coulomb, static, velocity) = model.actuator_dynprm[i, 5], model.actuator_biasprm[i, 3:6]
        v = qvel[..., model.jnt_dofadr[model.actuator_trnid[i, 0]]]
        level = coulomb + (static - coulomb) * np.exp(-((v / velocity) ** 2))
        act[..., model.actuator_actadr[i]] = np.tanh(v / (SLOW * velocity)) * level / stiffness


def bristles(model: mujoco.MjModel) -> list[int]:
    """Which actuators are LuGre friction of this effect."""
    return [i for i in range(model.nactuator) if model.actuator(i).name.startswith(BRISTLE)]


EFFECT = StribeckFriction
