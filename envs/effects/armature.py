"""The motor's rotor moves too, and seen through the gear it is heavy."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect
from envs.effects.passive import scalar_joints


@dataclass(frozen=True)
class Armature(Effect):
    """Add to the rotor inertia of joints, as the joint feels it (`dof_armature`)."""

    inertia: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"inertia": "kg m^2 or kg"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"inertia": (0.0, 1e4)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in scalar_joints(spec, self.at):
            joint.armature += self.inertia


EFFECT = Armature
