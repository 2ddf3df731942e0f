"""A joint resists with the square of its speed: air, water, a fan."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect
from envs.effects.passive import scalar_joints


@dataclass(frozen=True)
class QuadraticDrag(Effect):
    """Add -coefficient v |v| to joints (`dof_dampingpoly`)."""

    coefficient: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"coefficient": "N m s^2/rad^2 or N s^2/m^2"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 1e5)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in scalar_joints(spec, self.at):
            joint.damping[1] += self.coefficient


EFFECT = QuadraticDrag
