"""A joint resists motion more in one direction than in the other: a worn screw, a preloaded gear."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect
from envs.effects.passive import NO_LIMIT, add_force, scalar_joints


@dataclass(frozen=True)
class AsymmetricFriction(Effect):
    """Viscous friction with a coefficient for each direction: -forward v for v > 0, -backward v for v < 0.

    What both directions share is joint damping, the rest a one-sided force without an input. Dry friction that differs
    by direction needs no effect of its own: it is `coulomb_friction` and a constant force together.
    """

    forward: float = 0.0
    backward: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {
        "forward": "N m s/rad or N s/m",
        "backward": "N m s/rad or N s/m",
    }
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"forward": (0.0, 1e5), "backward": (0.0, 1e5)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        more = self.forward - self.backward
        for joint in scalar_joints(spec, self.at):
            joint.damping[0] += min(self.forward, self.backward)
            side = (-NO_LIMIT, 0.0) if more > 0 else (0.0, NO_LIMIT)  # resists moving forward, or backward
            add_force(spec, f"asymmetric_friction/{joint.name}", joint.name, slope=-abs(more), limits=side)


EFFECT = AsymmetricFriction
