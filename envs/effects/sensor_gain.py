"""A sensor reads in proportion too much or too little."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect, per_axis, per_name
from envs.effects.sensor_noise import columns
from envs.task import AbstractTask


@dataclass(frozen=True)
class SensorGain(Effect):
    """Scale what is observed, about zero."""

    gain: float | tuple[float, ...] = 1.0  # one for all, or one for each name in `at`
    at: tuple[str, ...] = ()  # observation names, or signals of recorded data; all if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "signal"
    units: ClassVar[dict[str, str]] = {"gain": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"gain": (-5.0, 5.0)}

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        read, at = observation.copy(), columns(task, self.at)
        read[:, at] *= per_axis(self.gain, len(at), "sensor_gain.gain")
        return read

    def measured(self, values: Array, name: str, time: Array) -> Array:
        gains = per_name(self.gain, self.at or (name,), "sensor_gain.gain")
        return values * gains[name] if name in gains else values


EFFECT = SensorGain
