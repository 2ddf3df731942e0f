"""The machine does more of what it is told in one direction than in the other."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect, per_axis
from envs.task import AbstractTask


@dataclass(frozen=True)
class DirectionalGain(Effect):
    """Scale each axis of the action by one number where it is positive and by another where it is negative."""

    positive: float | tuple[float, ...] = 1.0  # one for all axes, or one each
    negative: float | tuple[float, ...] = 1.0
    native: ClassVar[bool] = False
    units: ClassVar[dict[str, str]] = {"positive": "1", "negative": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"positive": (-5.0, 5.0), "negative": (-5.0, 5.0)}

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        up = per_axis(self.positive, action.shape[1], "directional_gain.positive")
        down = per_axis(self.negative, action.shape[1], "directional_gain.negative")
        return action * np.where(action > 0, up, down)


EFFECT = DirectionalGain
