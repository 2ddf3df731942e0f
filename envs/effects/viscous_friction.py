"""A joint resists in proportion to its speed."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick


@dataclass(frozen=True)
class ViscousFriction(Effect):
    """Add to the joint damping (`dof_damping`)."""

    coefficient: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"coefficient": "N m s/rad or N s/m"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 1e5)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in pick(spec.joints, self.at, "joint"):
            if self.at or joint.type != mujoco.mjtJoint.mjJNT_FREE:
                joint.damping[0] += self.coefficient


EFFECT = ViscousFriction
