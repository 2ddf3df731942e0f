"""Things that an episode's start puts somewhere and nothing moves from there: boards, tables."""

import mujoco

HEAVY = 1e6  # [kg], [kg m^2]


def add_fixture(spec: mujoco.MjSpec, name: str, axes: str) -> mujoco.MjsBody:
    """Add a body that may be put along some axes and stays there.

    Its place is in qpos, so that each episode has its own without a model of its own; joints are so heavy that no blow
    moves them.

    Args:
        spec: The scene to add to.
        name: Of the body; its joints are `<name>_<axis>`.
        axes: Of "x", "y", "z" [m] and "yaw" [rad], separated by blanks.
    """
    body = spec.worldbody.add_body(name=name, gravcomp=1)
    for axis in axes.split():
        kind = mujoco.mjtJoint.mjJNT_HINGE if axis == "yaw" else mujoco.mjtJoint.mjJNT_SLIDE
        direction = [0, 0, 1] if axis == "yaw" else [float(axis == a) for a in "xyz"]
        body.add_joint(name=f"{name}_{axis}", type=kind, axis=direction).armature = HEAVY
    return body
