"""What is observed is old."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect
from envs.effects.sensor_noise import columns
from envs.task import AbstractTask


@dataclass(frozen=True)
class SensorDelay(Effect):
    """Observe the true state of some time ago. List it before other sensor effects: it starts from the truth."""

    delay: float = 0.0
    at: tuple[str, ...] = ()  # observation names, or signals of recorded data; all if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "signal"
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"delay": (0.0, 2.0)}

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        read, at = observation.copy(), columns(task, self.at)
        read[:, at] = past(self.delay)[:, at]
        return read

    def measured(self, values: Array, name: str, time: Array) -> Array:
        if not self.delay or (self.at and name not in self.at):
            return values
        return np.interp(time - self.delay, time, values)  # before the record, its first value


EFFECT = SensorDelay
