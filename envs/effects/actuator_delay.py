"""Commands arrive late."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick


@dataclass(frozen=True)
class ActuatorDelay(Effect):
    """Delay every actuator's signal, beyond its own; MuJoCo's own actuator history carries it (`actuator_delay`)."""

    delay: float = 0.0
    at: tuple[str, ...] = ()  # actuators; all if empty
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"delay": (0.0, 2.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for actuator in pick(spec.actuators, self.at, "actuator"):
            actuator.delay += self.delay
            # MuJoCo silently clips a delay that its buffer cannot hold
            actuator.nsample = max(actuator.nsample, int(actuator.delay / spec.option.timestep) + 2)


EFFECT = ActuatorDelay
