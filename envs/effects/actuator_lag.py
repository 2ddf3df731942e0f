"""Commands take effect gradually."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick


@dataclass(frozen=True)
class ActuatorLag(Effect):
    """First-order low pass on every actuator's signal, integrated exactly (`dyntype="filterexact"`)."""

    time_constant: float = 0.0
    at: tuple[str, ...] = ()  # actuators; all if empty
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"time_constant": "s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"time_constant": (0.0, 5.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for actuator in pick(spec.actuators, self.at, "actuator"):
            actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1
            actuator.dynprm[0] = max(self.time_constant, 1e-6)


EFFECT = ActuatorLag
