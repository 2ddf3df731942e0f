"""A sensor reads too much or too little by a constant."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect, per_axis, per_name
from envs.effects.sensor_noise import columns
from envs.task import AbstractTask


@dataclass(frozen=True)
class SensorOffset(Effect):
    """Add a constant to what is observed."""

    offset: float | tuple[float, ...] = 0.0  # one for all, or one for each name in `at`
    at: tuple[str, ...] = ()  # observation names, or signals of recorded data; all if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "signal"
    units: ClassVar[dict[str, str]] = {"offset": "of the observation"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"offset": (-10.0, 10.0)}

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        read, at = observation.copy(), columns(task, self.at)
        read[:, at] += per_axis(self.offset, len(at), "sensor_offset.offset")
        return read

    def measured(self, values: Array, name: str, time: Array) -> Array:
        offsets = per_name(self.offset, self.at or (name,), "sensor_offset.offset")
        return values + offsets[name] if name in offsets else values


EFFECT = SensorOffset
