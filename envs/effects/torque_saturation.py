"""A drive cannot give the force that the model lets it give."""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick
from envs.effects.passive import NO_LIMIT


@dataclass(frozen=True)
class TorqueSaturation(Effect):
    """Limit every actuator's force to plus and minus `limit` (`actuator_forcerange`); tighter limits stay."""

    limit: float = math.inf  # before the gear
    at: tuple[str, ...] = ()  # actuators; all if empty
    place: ClassVar[str] = "actuator"
    units: ClassVar[dict[str, str]] = {"limit": "N m or N"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"limit": (1e-9, math.inf)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for actuator in pick(spec.actuators, self.at, "actuator"):
            low, high = actuator.forcerange
            unlimited = actuator.forcelimited == int(mujoco.mjtLimited.mjLIMITED_FALSE)
            if unlimited or low >= high:  # (0, 0) is MJCF's "no range"
                low, high = -NO_LIMIT, NO_LIMIT
            low, high = max(low, -self.limit), min(high, self.limit)
            if low >= high:
                raise ValueError(
                    f"torque_saturation.limit={self.limit}: actuator {actuator.name!r} gives {low} or more"
                )
            if self.limit < NO_LIMIT:
                actuator.forcelimited, actuator.forcerange = 1, [low, high]


EFFECT = TorqueSaturation
