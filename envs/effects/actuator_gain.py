"""The machine does more or less than it is told."""

from dataclasses import dataclass
from typing import ClassVar

from envs.effects.base import Array, Effect, per_axis
from envs.task import AbstractTask


@dataclass(frozen=True)
class ActuatorGain(Effect):
    """Scale the command: a motor's drive gain, or the ratio of a commanded displacement that is realised."""

    gain: float | tuple[float, ...] = 1.0  # one for all axes of the action, or one each
    units: ClassVar[dict[str, str]] = {"gain": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"gain": (-5.0, 5.0)}

    def command(self, action: Array, task: AbstractTask) -> Array:
        return action * per_axis(self.gain, action.shape[1], "actuator_gain.gain")


EFFECT = ActuatorGain
