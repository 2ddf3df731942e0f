"""Things that an episode's start puts somewhere and nothing moves from there: boards, tables."""

import mujoco
import numpy as np

from envs import fr3
from envs.effects.passive import stiffen_dry_friction

HEAVY = 1e4  # [kg], [kg m^2]; no more: at 1e8 rounding errors loosened the nail of hammer
STUCK = 1e6  # [N], [N m] of dry friction, beyond all that an arm can do
WALLS = 12  # boxes around a round hole
WALL, EDGE = 0.05, 0.12  # [m] width of their ring, and from the hole's middle to the table's edges


def add_fixture(spec: mujoco.MjSpec, name: str, axes: str) -> mujoco.MjsBody:
    """Add a body that may be put along some axes and stays there.

    Its place is in qpos, so that each episode has its own without a model of its own; joints are so heavy and stick so
    well that no blow moves them.

    Args:
        spec: The scene to add to.
        name: Of the body; its joints are `<name>_<axis>`.
        axes: Of "x", "y", "z" [m] and "yaw" [rad], separated by blanks.
    """
    body = spec.worldbody.add_body(name=name, gravcomp=1)
    for axis in axes.split():
        kind = mujoco.mjtJoint.mjJNT_HINGE if axis == "yaw" else mujoco.mjtJoint.mjJNT_SLIDE
        direction = [0, 0, 1] if axis == "yaw" else [float(axis == a) for a in "xyz"]
        joint = body.add_joint(name=f"{name}_{axis}", type=kind, axis=direction)
        joint.armature, joint.frictionloss = HEAVY, STUCK
        stiffen_dry_friction(joint)
    return body


def add_table_with_hole(spec: mujoco.MjSpec, *, radius: float, floor: float, top: float) -> None:
    """Add a square table that may be put along x and y and turned, with a round hole in its middle.

    The hole is made of boxes that stand around its floor.

    Args:
        spec: The scene to add to.
        radius: Of the hole, [m].
        floor: Height of the hole's floor above the ground, [m].
        top: Height of the table, [m].
    """
    table = add_fixture(spec, "table", "x y yaw")
    across, half = radius + WALL / 2, (radius + WALL) * np.tan(np.pi / WALLS)
    boxes = [([radius, radius, floor / 2], [0, 0, floor / 2], 0.0)]
    for angle in 2 * np.pi * np.arange(WALLS) / WALLS:
        boxes.append(([WALL / 2, half, top / 2], [across * np.cos(angle), across * np.sin(angle), top / 2], angle))
    inner, low = 0.7 * (radius + WALL), top / 2 - 0.0002  # corners within the ring; a hair lower, so that one is seen
    width, away = (EDGE - inner) / 2, (EDGE + inner) / 2
    for side in (-1, 1):
        boxes.append(([width, EDGE, low], [side * away, 0, low], 0.0))
        boxes.append(([inner, width, low], [0, side * away, low], 0.0))
    for i, (size, place, angle) in enumerate(boxes):
        table.add_geom(
            name=f"table_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=place,
            quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)],
            mass=0.1,
            rgba=[0.80, 0.74, 0.64, 1],
            contype=0,
            conaffinity=fr3.OBJECT_BIT,
        )
