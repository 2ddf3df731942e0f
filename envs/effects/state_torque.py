"""A torque that depends on the state and that nobody modelled."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from envs.effects.base import Array, Effect


@dataclass(frozen=True)
class StateTorque(Effect):
    """e(s1, s2) = amplitude sin(s1 + phase) + rate s2 on the first joint, with s1 its angle and s2 its velocity.

    The unmodelled torque of the pedagogical pendulum: it acts as an unknown weight and an unknown (possibly
    negative) damping. MJCF has no attribute for the first part.
    """

    amplitude: float = 0.0
    phase: float = 0.0
    rate: float = 0.0
    native: ClassVar[bool] = False
    units: ClassVar[dict[str, str]] = {"amplitude": "N m", "phase": "rad", "rate": "N m s/rad"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"amplitude": (-100.0, 100.0), "rate": (-100.0, 100.0)}

    def force(self, qpos: Array, qvel: Array) -> Array:
        torque = np.zeros_like(qvel)
        torque[:, 0] = self.amplitude * np.sin(qpos[:, 0] + self.phase) + self.rate * qvel[:, 0]
        return torque


EFFECT = StateTorque
