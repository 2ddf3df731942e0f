"""Forces that MJCF carries although it has no attribute for them: actuators without an input.

A `dcmotor` without an input takes no control, so a scene keeps its `nu`, its state and the order of everything in it.
With an affine bias its force is min(max(constant + slope * speed, low), high); sums of such forces give every friction
that is piecewise linear in the speed. MuJoCo's implicit integrators know the slope, and plain MJCF keeps all of it.
"""

import mujoco
import numpy as np

from envs.effects.base import pick

NO_LIMIT = 1e10  # [N or N m] MJCF knows no infinity
SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


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
    actuator = spec.add_actuator(name=unused_name(spec.actuators, name), target=target, trntype=kind)
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
