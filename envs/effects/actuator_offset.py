"""The machine drifts when it is told to stand still."""

from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect, per_axis
from envs.task import AbstractTask


@dataclass(frozen=True)
class ActuatorOffset(Effect):
    """Add a constant to the command, in units of the largest action."""

    offset: float | tuple[float, ...] = 0.0  # one for all axes of the action, or one each
    units: ClassVar[dict[str, str]] = {"offset": "of the largest action"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"offset": (-1.0, 1.0)}

    def command(self, action: Array, task: AbstractTask) -> Array:
        return action + per_axis(self.offset, action.shape[1], "actuator_offset.offset")


EFFECT = ActuatorOffset
