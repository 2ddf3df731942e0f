"""A drive that does not move quite as its joint does: the joint's actuators turn a rotor of its own.

A tendon, joint - rotor, holds the two together. Within the play of a gear it does nothing, beyond it stops them or, of
an elastic drive, pulls like a spring.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from envs.effects.base import ROTOR, Array
from envs.effects.passive import drives_of, effective_inertia, plain, scalar_joints

FASTEST = 1.0  # oscillation of rotor and joint against each other, in radians a physics step
MOST_DAMPED = 0.25  # share of their speed against each other that a step may take
ROTOR_SHARE = 0.05  # of the joint's inertia, where the model has no armature
IMPLICIT = (int(mujoco.mjtIntegrator.mjINT_IMPLICIT), int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST))
SOON = 1e-4  # [s] to differentiate forces along the motion
CENTRE_MASS = 1e-9  # [kg] MuJoCo wants a mass; the rotor's inertia is its joint's armature
CENTRE_INERTIA = 1e-14  # [kg m^2] with the mass the size of 8 mm, so that a fluid has nothing to hold


class Coupling(NamedTuple):
    """What holds a rotor to its joint.

    Attributes:
        tendon: Of length joint - rotor, rad or m.
        rotor: The joint that is the rotor.
        inertia: Of rotor and joint against each other, kg m^2 or kg.
    """

    tendon: mujoco.MjsTendon
    rotor: mujoco.MjsJoint
    inertia: float

    @property
    def elastic(self) -> bool:
        return bool(self.tendon.stiffness[0])

    @property
    def play(self) -> float:
        """To either side, rad or m."""
        return float((self.tendon.springlength if self.elastic else self.tendon.range)[1])

    def widen(self, gap: float) -> None:
        """Add play to either side; the play of two gears in a row adds up."""
        play, tendon = self.play + gap, self.tendon
        if self.elastic:
            tendon.springlength = [-play, play]
        else:
            tendon.range, tendon.limited = [-play, play], 1
            tendon.solref_limit, tendon.solimp_limit[:3] = np.array([0.002, 1.0]), [0.99, 0.9999, 1e-4]

    def soften(self, compliance: float, damping_ratio: float, option: mujoco.MjOption) -> None:
        """Add a spring in series, which twists by `compliance` under 1 N m or 1 N, beyond the play if there is one.

        The implicit integrators know of the damping what acts on each of the two, and not what they do to each other,
        so that either is heavier by `step * damping`; the rotor is made lighter by what both are.

        Args:
            compliance: rad/(N m) or m/N.
            damping_ratio: Of the oscillation of rotor and joint against each other.
            option: The scene's. A spring, or damping, too stiff for its time step is made as stiff as that can follow.
        """
        play, tendon, step = self.play, self.tendon, option.timestep
        softness = compliance + (1 / tendon.stiffness[0] if self.elastic else 0.0)
        stiffness = min(1 / softness, self.inertia * (FASTEST / step) ** 2)
        tendon.springlength, tendon.limited = [-play, play], 0
        tendon.stiffness[0] = stiffness
        damping = min(2 * damping_ratio * np.sqrt(stiffness * self.inertia), self.inertia * MOST_DAMPED / step)
        before, tendon.damping[0] = tendon.damping[0], damping
        if option.integrator in IMPLICIT:
            self.rotor.armature -= 2 * step * (damping - before)


def driven_joints(spec: mujoco.MjSpec, at: tuple[str, ...], effect: str) -> list[mujoco.MjsJoint]:
    """The hinges and slides that an actuator moves: those in `at`, or all.

    Args:
        spec: The scene.
        at: Names; empty for all.
        effect: Who asks, for the message.

    Raises:
        ValueError: For a joint in `at` that is not there or that nothing drives.
    """
    joints = scalar_joints(spec, at)
    driven = [j for j in joints if drives_of(spec, j.name) or _tendon_of(spec, j.name)]
    idle = [j.name for j in joints if at and j not in driven]
    if idle:
        raise ValueError(f"{effect}: no actuator drives the joint {idle[0]!r}, so nothing lies between the two")
    return driven


def couplings(spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint], inertia: float, effect: str) -> list[Coupling]:
    """What holds the rotors of driven joints, which get one if they have none; in the order of the joints.

    A rotor takes over the joint's armature. It is `rotor/<joint>`, a joint that is added behind all others, so the
    scene's own numbering stays.

    Args:
        spec: The scene.
        joints: From `driven_joints`.
        inertia: Of rotors of joints without armature, kg m^2 or kg, part of the joint's; 5 % of that if 0.
        effect: Who asks, for the message.

    Raises:
        ValueError: For a rotor that is all that moves with its joint.
    """
    found = []
    for joint, whole in zip(joints, effective_inertia(spec, joints), strict=True):
        tendon = _tendon_of(spec, joint.name)
        if tendon is None:
            own = joint.armature or inertia or ROTOR_SHARE * whole
            if own >= whole:
                raise ValueError(f"{effect}.inertia={own}: all that moves with {joint.name!r} is only {whole:.3g}")
            link, tendon = whole - own, _add_rotor(spec, joint, own)
        else:
            own, link = float(spec.joint(ROTOR + joint.name).armature), whole
        found.append(Coupling(tendon, spec.joint(ROTOR + joint.name), own * link / (own + link)))
    return found


def _tendon_of(spec: mujoco.MjSpec, joint: str) -> mujoco.MjsTendon | None:
    return next((tendon for tendon in spec.tendons if tendon.name == ROTOR + joint), None)


def _add_rotor(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, inertia: float) -> mujoco.MjsTendon:
    drives, address = drives_of(spec, joint.name), int(spec.copy().compile().joint(joint.name).qposadr[0])
    joint.armature -= inertia  # rotor and joint together weigh what they did
    body = spec.worldbody.add_body(name=ROTOR + joint.name, mass=CENTRE_MASS, inertia=[CENTRE_INERTIA] * 3)
    body.ipos, body.explicitinertial = np.zeros(3), True
    rotor = plain(body.add_joint(name=ROTOR + joint.name), "joint")
    rotor.type, rotor.axis, rotor.armature = joint.type, [0, 0, 1], inertia
    rotor.range, rotor.limited = joint.range, int(mujoco.mjtLimited.mjLIMITED_FALSE)
    rotor.actfrclimited, rotor.actfrcrange = joint.actfrclimited, joint.actfrcrange  # what limits drives goes with them
    joint.actfrclimited, joint.actfrcrange = int(mujoco.mjtLimited.mjLIMITED_FALSE), [0.0, 0.0]
    tendon = plain(spec.add_tendon(name=ROTOR + joint.name), "tendon")
    tendon.wrap_joint(joint.name, 1.0)
    tendon.wrap_joint(rotor.name, -1.0)
    for actuator in drives:
        actuator.target = rotor.name
    for key in spec.keys:
        if len(key.qpos):
            key.qpos = [*key.qpos, key.qpos[address]]
        if len(key.qvel):
            key.qvel = [*key.qvel, 0.0]
    return tendon


def place_rotors(
    model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array | None = None, jerk: Array | None = None
) -> None:
    """Put every rotor where its joint is, moving with it; in place.

    A start that comes from measured joints has to be completed by this: rotors are not measured. A rotor leans against
    the flank, or is ahead by the twist, through which it gives its joint the acceleration, and twists at the rate at
    which that changes; without one it is in the middle of the play.

    Args:
        model: A scene, with or without rotors.
        qpos: [..., nq], with the joints set.
        qvel: [..., nv], with the joints set.
        qacc: [..., nv], with the joints set.
        jerk: The same of the derivative of qacc; 0 if None.
    """
    rotors = [i for i in range(model.njnt) if model.joint(i).name.startswith(ROTOR)]
    joints = [model.joint(model.joint(i).name.removeprefix(ROTOR)) for i in rotors]
    for i, joint in zip(rotors, joints, strict=True):
        qpos[..., model.jnt_qposadr[i]] = qpos[..., joint.qposadr[0]]
        qvel[..., model.jnt_dofadr[i]] = qvel[..., joint.dofadr[0]]
    if not rotors or qacc is None:
        return
    data = mujoco.MjData(model)
    tendons = [model.tendon(model.joint(i).name).id for i in rotors]
    elastic = model.tendon_stiffness[tendons] > 0
    softness = np.divide(1.0, model.tendon_stiffness[tendons], where=elastic, out=np.zeros(len(rotors)))
    play = np.where(elastic, model.tendon_lengthspring[tendons, 1], model.tendon_range[tendons, 1])
    at_joints = [joint.dofadr[0] for joint in joints]
    for at in np.ndindex(qpos.shape[:-1]):
        q, v, a = qpos[at].copy(), qvel[at].copy(), qacc[at].copy()
        a[model.jnt_dofadr[rotors]] = a[at_joints]
        push = _forces(model, data, q, v, a)[at_joints]
        qpos[at][model.jnt_qposadr[rotors]] += play * np.sign(push) + softness * push
        if jerk is not None and elastic.any():
            then = q.copy()
            mujoco.mj_integratePos(model, then, v, SOON)
            rate = (_forces(model, data, then, v + SOON * a, a + SOON * jerk[at])[at_joints] - push) / SOON
            qvel[at][model.jnt_dofadr[rotors]] += softness * rate


def _forces(model: mujoco.MjModel, data: mujoco.MjData, q: Array, v: Array, a: Array) -> Array:
    """On each joint, for this acceleration, beyond those of springs, dampers and gravity compensation, [nv]."""
    data.qpos[:], data.qvel[:], needed = q, v, np.zeros(model.nv)
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_mulM(model, data, needed, a)
    return needed + data.qfrc_bias - data.qfrc_passive + model.dof_frictionloss * np.sign(v)
