"""The machine does not stand level."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Array, Effect
from envs.effects.passive import add_force, unused_name

WEIGHTLESS = 1e-6  # [kg] bodies lighter than this need no compensation


@dataclass(frozen=True)
class GravityTilt(Effect):
    """Turn the base by `roll` about x, then by `angle` about y; the scene feels gravity turned back (`opt.gravity`).

    A machine that compensates gravity compensates the one it believes in. MuJoCo's `gravcomp` would follow the tilt, so
    each compensated body gets the difference as a constant force at its centre of mass.
    """

    angle: float = 0.0  # about y: gravity along -z gets a component g sin(angle) along x
    roll: float = 0.0  # about x: … and -g sin(roll) along y
    units: ClassVar[dict[str, str]] = {"angle": "rad", "roll": "rad"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"angle": (-np.pi, np.pi), "roll": (-np.pi, np.pi)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        before = np.array(spec.option.gravity)
        spec.option.gravity = after = self._turn_back(before)
        if not any(body.gravcomp for body in spec.bodies):
            return
        twin = spec.copy()  # compiled, to know masses and centres of mass
        model = twin.compile()
        world = spec.worldbody.add_site(name=unused_name(spec.sites, "gravity_tilt"), size=[1e-3, 0, 0], group=5)
        for body, index in list(zip(spec.bodies, (b.id for b in twin.bodies), strict=True)):
            if body.gravcomp and model.body_mass[index] > WEIGHTLESS and model.body_weldid[index]:
                name = unused_name(spec.sites, f"gravity_tilt/{body.name or index}")
                body.add_site(name=name, pos=model.body_ipos[index], size=[1e-3, 0, 0], group=5)
                force = add_force(spec, name, name, constant=1.0, at_joint=False)
                force.refsite = world.name
                force.gear[:3] = body.gravcomp * model.body_mass[index] * (after - before)

    def _turn_back(self, gravity: Array) -> Array:
        (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (self.angle, self.roll))
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        return (about_y @ about_x).T @ gravity


EFFECT = GravityTilt
