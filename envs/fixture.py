"""Things that an episode's start puts somewhere and nothing moves from there: boards, tables."""

import mujoco

from envs.effects.passive import stiffen_dry_friction

HEAVY = 1e4  # [kg], [kg m^2]; no more: at 1e8 rounding errors loosened the nail of hammer
STUCK = 1e6  # [N], [N m] of dry friction, beyond all that an arm can do


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
