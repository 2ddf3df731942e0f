"""Commands take effect gradually."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick
from envs.effects.passive import require_linear

NONE = 1e-6  # [s] as good as none


@dataclass(frozen=True)
class ActuatorLag(Effect):
    """First-order low pass on every actuator's signal, integrated exactly (`dyntype="filterexact"`).

    An actuator with a low pass of its own gets one with the sum of both time constants, which is what a slow signal
    notices of two in a row.
    """

    time_constant: float = 0.0
    at: tuple[str, ...] = ()  # actuators; all if empty
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"time_constant": "s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"time_constant": (0.0, 5.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for actuator in pick(spec.actuators, self.at, "actuator"):
            require_linear(actuator, "actuator_lag")
            own = 0.0 if actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE else float(actuator.dynprm[0])
            lag = self.time_constant + (own if own > NONE else 0.0)
            actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1
            actuator.dynprm[0] = max(lag, NONE)


EFFECT = ActuatorLag
