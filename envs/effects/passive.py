"""Forces that MJCF carries although it has no attribute for them: actuators without an input.

A `dcmotor` without an input takes no control, so a scene keeps its `nu`, its state and the order of everything in it.
With an affine bias its force is min(max(constant + slope * speed, low), high); sums of such forces give every friction
that is piecewise linear in the speed. MuJoCo's implicit integrators know the slope, and plain MJCF keeps all of it.
"""

from typing import Any

import mujoco
import numpy as np

from envs.effects.base import pick

NO_LIMIT = 1e10  # [N or N m] MJCF knows no infinity
SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
OF_A_SCENE = {
    "classname",
    "compiler",
    "default",
    "frame",
    "id",
    "info",
    "name",
    "parent",
    "path",
    "plugin",
    "signature",
    "userdata",
}

EMPTY = mujoco.MjSpec()  # kept, because its defaults go with it


def scalar_joints(spec: mujoco.MjSpec, at: tuple[str, ...]) -> list[mujoco.MjsJoint]:
    """The hinges and slides with the names in `at`, all of them if it is empty; each has a name afterwards.

    Raises:
        ValueError: For a name that the scene lacks, or that of a ball or free joint.
    """
    joints = pick(spec.joints, at, "joint")
    for joint in joints:
        if at and joint.type not in SCALAR:
            raise ValueError(f"joint {joint.name!r} is a ball or free; this effect needs a hinge or a slide")
    joints = [j for j in joints if j.type in SCALAR]
    for i, joint in enumerate(joints):
        joint.name = joint.name or unused_name(spec.joints, f"unnamed_joint{i}")
    return joints


def unused_name(elements: list, name: str) -> str:
    """`name`, or with a number after it if one of the elements has it already."""
    taken = {e.name for e in elements}
    return next(n for n in (name, *(f"{name}_{i}" for i in range(2, len(taken) + 3))) if n not in taken)


def plain(element: Any, kind: str) -> Any:
    """An element that an effect has just added, as if its scene had no `<default>`, which is meant for others.

    Args:
        element: Of a scene; changed, and returned.
        kind: "joint", "actuator" or "tendon".
    """
    without = getattr(EMPTY.default, kind)
    for field in dir(without):
        if not field.startswith("_") and field not in OF_A_SCENE and not callable(getattr(without, field)):
            setattr(element, field, getattr(without, field))
    return element


def drives_of(spec: mujoco.MjSpec, joint: str) -> list[Any]:
    """The actuators with an input that turn a joint."""
    kinds, without = (
        (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT),
        int(mujoco.mjtCtrlInput.mjINPUT_NONE),
    )
    return [a for a in spec.actuators if joint and a.target == joint and a.trntype in kinds and a.ctrlspec != without]


def limit_drives(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, effect: str) -> None:
    """Let a joint's own limit of what actuators give it (`actuatorfrcrange`) be that of its drive, not of friction.

    Args:
        spec: The scene.
        joint: Of the scene.
        effect: Who asks, for the message.

    Raises:
        ValueError: If several drives share the limit.
    """
    low, high = joint.actfrcrange
    if not _limited(joint.actfrclimited, joint.actfrcrange, spec):
        return
    drives = drives_of(spec, joint.name)
    if len(drives) > 1:
        raise ValueError(
            f"{effect}: the drives {', '.join(a.name for a in drives)} share the limit of {joint.name!r} "
            "(actuatorfrcrange), which would hold for friction, too. Give each a forcerange instead"
        )
    for drive in drives:
        ends = sorted((low / drive.gear[0], high / drive.gear[0]))
        if _limited(drive.forcelimited, drive.forcerange, spec):
            ends = [max(ends[0], drive.forcerange[0]), min(ends[1], drive.forcerange[1])]
        drive.forcelimited, drive.forcerange = 1, ends
    joint.actfrclimited, joint.actfrcrange = int(mujoco.mjtLimited.mjLIMITED_FALSE), [0.0, 0.0]


def _limited(flag: int, ends: Any, spec: mujoco.MjSpec) -> bool:
    auto = flag == int(mujoco.mjtLimited.mjLIMITED_AUTO) and spec.compiler.autolimits and ends[0] < ends[1]
    return bool(auto or flag == int(mujoco.mjtLimited.mjLIMITED_TRUE))


def add_force(
    spec: mujoco.MjSpec,
    name: str,
    target: str,
    *,
    constant: float = 0.0,
    slope: float = 0.0,
    limits: tuple[float, float] | None = None,
    at_joint: bool = True,
) -> mujoco.MjsActuator:
    """Add min(max(constant + slope * speed, low), high) at a joint, N or N m.

    Args:
        spec: The scene.
        name: Of the actuator; a number is added if it is taken.
        target: A joint, or a site if `at_joint` is false (then along the first three numbers of its `gear`).
        constant: N or N m.
        slope: N s/m or N m s/rad; negative resists motion.
        limits: (low, high); None for no limits.
    """
    kind = mujoco.mjtTrn.mjTRN_JOINT if at_joint else mujoco.mjtTrn.mjTRN_SITE
    if at_joint:
        limit_drives(spec, spec.joint(target), name.partition("/")[0])
    actuator = plain(spec.add_actuator(name=unused_name(spec.actuators, name)), "actuator")
    actuator.target, actuator.trntype = target, kind
    actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_DCMOTOR, mujoco.mjtBias.mjBIAS_AFFINE
    actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_DCMOTOR, 1
    actuator.ctrlspec = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
    actuator.gainprm[:2], actuator.dynprm[0] = [1.0, 0.0], 0.0  # no motor constant, no electrical dynamics
    actuator.biasprm[0], actuator.biasprm[2] = constant, slope
    if limits is not None:
        actuator.forcelimited, actuator.forcerange = 1, list(limits)
    return actuator


def stiff_dry_friction(joint: mujoco.MjsJoint, level: float) -> None:
    """Add to a joint's dry friction, and stiffen it: MuJoCo's default impedance gives way by some per cent."""
    if level:
        joint.frictionloss += level
        stiffen_dry_friction(joint)


def stiffen_dry_friction(joint: mujoco.MjsJoint) -> None:
    """As dry as the time step allows: MuJoCo raises a solref below two steps to two steps."""
    joint.solimp_friction[:3] = [0.99, 0.9999, 0.001]
    joint.solref_friction[:2] = [1e-4, 1.0]


def effective_inertia(spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint]) -> list[float]:
    """Inertia that a force at each joint has to move in the initial posture, armatures and all, kg or kg m^2."""
    model = spec.copy().compile()
    data, whole = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, whole)  # dof_invweight0 leaves armatures out
    inverse = np.linalg.inv(whole)
    return [float(1 / inverse[i, i]) for i in (int(model.joint(j.name).dofadr[0]) for j in joints)]


def require_linear(actuator: mujoco.MjsActuator, effect: str, constant_gain: bool = False) -> None:
    """Check that an actuator's force is its control, or that control's low pass, times a gain, plus a bias.

    Args:
        actuator: Of the scene.
        effect: Who asks, for the message.
        constant_gain: Whether the gain must not depend on the state.

    Raises:
        ValueError: If it is not.
    """
    gains = [mujoco.mjtGain.mjGAIN_FIXED] + ([] if constant_gain else [mujoco.mjtGain.mjGAIN_AFFINE])
    filters = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    biases = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    if actuator.gaintype not in gains or actuator.dyntype not in filters or actuator.biastype not in biases:
        allowed = "fixed" if constant_gain else "fixed or affine"
        raise ValueError(
            f"{effect}: actuator {actuator.name!r} is not linear in its control (its gain must be {allowed}, its bias "
            "none or affine, its dynamics none or a filter); without `at` the effect acts on the signals instead"
        )
