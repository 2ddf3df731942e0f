"""A joint resists with the same force at any speed, and sticks."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick
from envs.effects.passive import stiff_dry_friction


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Add to the dry friction of joints (`dof_frictionloss`), with a stiff friction constraint."""

    torque: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"torque": "N m or N"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"torque": (0.0, 1e4)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in pick(spec.joints, self.at, "joint"):
            if self.at or joint.type != mujoco.mjtJoint.mjJNT_FREE:
                stiff_dry_friction(joint, self.torque)


EFFECT = CoulombFriction
