"""A body is heavier than the model says."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick
from envs.effects.passive import unused_name

RADIUS = 0.01  # [m]


@dataclass(frozen=True)
class Payload(Effect):
    """Fix a point mass to a body. It is a body of its own: the arm's gravity compensation does not know of it."""

    mass: float = 0.0
    at: tuple[str, ...] = ("link7",)  # bodies
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the body's frame
    place: ClassVar[str] = "body"
    units: ClassVar[dict[str, str]] = {"mass": "kg", "position": "m"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"mass": (0.0, 100.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for body in pick(spec.bodies, self.at, "body"):
            if self.mass and not moves(body):
                raise ValueError(
                    f"payload at {body.name!r}: nothing moves this body (what is soft moves by nodes of its own), so "
                    "that a load would do nothing"
                )
            load = body.add_body(name=unused_name(spec.bodies, f"payload_{body.name}"), pos=list(self.position))
            load.mass, load.inertia, load.ipos = self.mass, [0.4 * self.mass * RADIUS**2] * 3, [0.0, 0.0, 0.0]
            load.explicitinertial = True  # whatever the scene's compiler infers from geoms
            load.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[RADIUS, 0, 0],
                mass=self.mass,
                group=spec.compiler.inertiagrouprange[0],
                contype=0,
                conaffinity=0,
                rgba=[0, 0, 0, 0],
            )


def moves(body: mujoco._specs.MjsBody) -> bool:
    """Whether a body or one that carries it has a joint."""
    while body is not None:
        if len(body.joints):
            return True
        body = body.parent
    return False


EFFECT = Payload
