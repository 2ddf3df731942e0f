"""The machine drifts when it is told to stand still."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Array, Effect, per_axis, per_name, pick
from envs.effects.passive import require_linear
from envs.task import AbstractTask


@dataclass(frozen=True)
class ActuatorOffset(Effect):
    """Add a constant to the command.

    Without `at` it acts on the action, in units of the largest one; at named actuators it adds to their control signal,
    in the control's own unit (`actuator_biasprm`).
    """

    offset: float | tuple[float, ...] = 0.0  # one for all axes of the action or actuators in `at`, or one each
    at: tuple[str, ...] = ()  # actuators; the whole action if empty
    native: ClassVar[bool] = True  # at named actuators; an action is above any MJCF
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"offset": "of the largest action, or of the control at actuators"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"offset": (-1e4, 1e4)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.at and np.max(np.abs(self.offset)) > 1:
            raise ValueError(f"ActuatorOffset.offset={self.offset} of the largest action: allowed are -1.0 to 1.0")

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        offsets = per_name(self.offset, self.at, "actuator_offset.offset") if self.at else {}
        for actuator in pick(spec.actuators, self.at, "actuator") if self.at else []:
            require_linear(actuator, "actuator_offset", constant_gain=True)
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
                actuator.biastype, actuator.biasprm[:3] = mujoco.mjtBias.mjBIAS_AFFINE, [0.0, 0.0, 0.0]
            actuator.biasprm[0] += actuator.gainprm[0] * offsets[actuator.name]

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        return action if self.at else action + per_axis(self.offset, action.shape[1], "actuator_offset.offset")

    def ctrl(self, ctrl: Array, actuators: list[str]) -> Array:
        return ctrl if self.at else ctrl + per_axis(self.offset, ctrl.shape[1], "actuator_offset.offset")


EFFECT = ActuatorOffset
