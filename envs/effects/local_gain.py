"""The machine does more of what it is told in one place than in another."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect, indices
from envs.task import AbstractTask


@dataclass(frozen=True)
class LocalGain(Effect):
    """Scale the action by 1 + slope (x - centre), never by less than 0, where x is what the task observes `at`.

    Such is an arm whose Jacobian is wrong: right in the middle, short on one side and long on the other.
    """

    slope: float = 0.0
    centre: float = 0.0
    at: str = ""  # name of the observed x
    native: ClassVar[bool] = False
    units: ClassVar[dict[str, str]] = {"slope": "per unit of x", "centre": "of x"}

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        if not self.slope:
            return action
        (column,) = indices(list(task.observation_names), (self.at,), "observation")
        return action * np.maximum(0.0, 1 + self.slope * (truth[:, [column]] - self.centre))


EFFECT = LocalGain
