"""The machine does more or less than it is told."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Array, Effect, per_axis, per_name, pick
from envs.effects.passive import require_linear
from envs.task import AbstractTask


@dataclass(frozen=True)
class ActuatorGain(Effect):
    """Scale the command: a motor's drive gain, or the ratio of a commanded displacement that is realised.

    Without `at` it acts on the action; at named actuators it scales what their control signal does
    (`actuator_gainprm`), for a position servo its target.
    """

    gain: float | tuple[float, ...] = 1.0  # one for all axes of the action or actuators in `at`, or one each
    at: tuple[str, ...] = ()  # actuators; the whole action if empty
    native: ClassVar[bool] = True  # at named actuators; an action is above any MJCF
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"gain": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"gain": (-5.0, 5.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        gains = per_name(self.gain, self.at, "actuator_gain.gain") if self.at else {}
        for actuator in pick(spec.actuators, self.at, "actuator") if self.at else []:
            require_linear(actuator, "actuator_gain")
            actuator.gainprm[:3] *= gains[actuator.name]

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        return action if self.at else action * per_axis(self.gain, action.shape[1], "actuator_gain.gain")

    def ctrl(self, ctrl: Array, actuators: list[str]) -> Array:
        return ctrl if self.at else ctrl * per_axis(self.gain, ctrl.shape[1], "actuator_gain.gain")


EFFECT = ActuatorGain
