"""A sensor is noisy."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect
from envs.task import AbstractTask


def columns(task: AbstractTask, at: tuple[str, ...]) -> list[int]:
    """Indices of named observations, in the order of `at`; all of them if it is empty.

    Raises:
        ValueError: For a name that the task does not observe.
    """
    for name in at:
        if name not in task.observation_names:
            raise ValueError(f"{task.name} observes no {name!r}. It observes: {', '.join(task.observation_names)}.")
    return [task.observation_names.index(name) for name in at] if at else list(range(len(task.observation_names)))


@dataclass(frozen=True)
class SensorNoise(Effect):
    """Add white Gaussian noise to what is observed."""

    sd: float = 0.0
    at: tuple[str, ...] = ()  # observation names, or signals of recorded data; all if empty
    native: ClassVar[bool] = False
    place: ClassVar[str] = "signal"
    units: ClassVar[dict[str, str]] = {"sd": "of the observation"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"sd": (0.0, 10.0)}

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        read, at = observation.copy(), columns(task, self.at)
        read[:, at] += self.sd * noise(len(at))
        return read


EFFECT = SensorNoise
