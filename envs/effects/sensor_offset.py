"""A sensor reads too much or too little by a constant."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect, per_axis
from envs.effects.sensor_noise import columns
from envs.task import AbstractTask


@dataclass(frozen=True)
class SensorOffset(Effect):
    """Add a constant to what is observed."""

    offset: float | tuple[float, ...] = 0.0  # one for all, or one for each name in `at`
    at: tuple[str, ...] = ()  # observation names; all if empty
    units: ClassVar[dict[str, str]] = {"offset": "of the observation"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"offset": (-10.0, 10.0)}

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        read, at = observation.copy(), columns(task, self.at)
        read[:, at] += per_axis(self.offset, len(at), "sensor_offset.offset")
        return read


EFFECT = SensorOffset
