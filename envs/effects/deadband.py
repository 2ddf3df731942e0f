"""A drive does nothing until it is asked for enough."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect, indices
from envs.task import AbstractTask


@dataclass(frozen=True)
class Deadband(Effect):
    """Take the same amount off every command, and what is smaller is nothing: sign(u) max(|u| - width, 0).

    Without `at` it acts on the action, in units of the largest one; at named actuators on their control signals, in
    the control's own unit, about its zero. MJCF has no attribute for it.
    """

    width: float = 0.0
    at: tuple[str, ...] = ()  # actuators; the whole action if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"width": "of the largest action, or of the control at actuators"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"width": (0.0, 1e4)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.at and self.width > 1:
            raise ValueError(f"Deadband.width={self.width} of the largest action: allowed are 0.0 to 1.0")

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        return action if self.at else self._beyond(action)

    def ctrl(self, ctrl: Array, actuators: list[str]) -> Array:
        changed, columns = ctrl.copy(), indices(actuators, self.at, "actuator")
        changed[:, columns] = self._beyond(ctrl[:, columns])
        return changed

    def _beyond(self, signal: Array) -> Array:
        return signal - np.clip(signal, -self.width, self.width) if self.width else signal


EFFECT = Deadband
