"""A gear rubs more, the more force it transmits."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Array, Effect, indices
from envs.effects.passive import scalar_joints, stiffen_dry_friction


@dataclass(frozen=True)
class LoadDependentFriction(Effect):
    """Dry friction in proportion to the force of the joint's actuators: coefficient * |load|.

    MJCF has no field for it: the level of dry friction is set before each physics step, from the load of the step
    before. Below 1 the joint can always be driven; driving it back against its actuator takes 1 + coefficient times
    the force.
    """

    coefficient: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"coefficient": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 1.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in scalar_joints(spec, self.at):
            if self.coefficient:
                stiffen_dry_friction(joint)

    def friction(self, load: Array, joints: list[str]) -> Array:
        level = np.zeros_like(load)
        columns = indices(joints, self.at, "joint")
        level[:, columns] = self.coefficient * np.abs(load[:, columns])
        return level


EFFECT = LoadDependentFriction
