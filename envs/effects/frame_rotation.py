"""The robot's base or its camera is turned against the model's frame: the calibration error everybody has."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect
from envs.task import AbstractTask


@dataclass(frozen=True)
class FrameRotation(Effect):
    """Turn a frame about the vertical.

    At the `base`, commanded displacements (the first two entries of the action) are carried out in a turned frame,
    while a camera that sees tip and object is right. At the `camera`, commands are right and all observed points
    (pairs of x and y) are turned about `centre`.
    """

    angle: float = 0.0
    at: str = "base"
    centre: tuple[float, float] = (0.25, 0.0)  # of the camera's turn, in the task frame
    native: ClassVar[bool] = False
    units: ClassVar[dict[str, str]] = {"angle": "rad", "centre": "m"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"angle": (-np.pi, np.pi)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.at not in ("base", "camera"):
            raise ValueError(f"FrameRotation.at={self.at!r}; allowed: base, camera")

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        if self.at != "base":
            return action
        if not task.moves_in_plane:
            raise ValueError(f"frame_rotation at the base: actions of {task.name} are no displacements along x and y")
        return np.concatenate([action[:, :2] @ self._matrix().T, action[:, 2:]], 1)

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        if self.at != "camera":
            return observation
        names = task.observation_names
        if not all(name.endswith("_x" if i % 2 == 0 else "_y") for i, name in enumerate(names)) or len(names) % 2:
            raise ValueError(f"frame_rotation at the camera: {task.name} observes {', '.join(names)}, not points")
        points = observation.reshape(len(observation), -1, 2) - self.centre
        return (points @ self._matrix().T + self.centre).reshape(observation.shape)

    def _matrix(self) -> Array:
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, -s], [s, c]])


EFFECT = FrameRotation
