"""A gear has play: the motor turns a little before the joint follows."""

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from envs.effects.base import ROTOR, Array, Effect
from envs.effects.passive import effective_inertia, scalar_joints

ROTOR_SHARE = 0.05  # of the joint's inertia, where the model has no armature
CENTRE_MASS = 1e-9  # [kg] MuJoCo wants a mass; the rotor's inertia is its joint's armature


@dataclass(frozen=True)
class Backlash(Effect):
    """Let motor and joint move apart by `gap` to either side before one pushes the other.

    Each joint's actuators drive a rotor of their own, `backlash/<joint>`, a joint that is added behind all others, so
    the scene's own numbering stays. A limited tendon (joint - rotor) is the play. The rotor takes over the joint's
    armature; a joint without one gives it `inertia`, which stays part of the whole, or 5 % of its own if that is 0.
    Servos follow their motor, whose position is the actuator's length; friction stays at the joint. No play changes
    nothing.
    """

    gap: float = 0.0  # half of the play, at the joint
    inertia: float = 0.0  # of the rotor, at the joint, for joints without armature
    at: tuple[str, ...] = ()  # joints; all hinges and slides with an actuator if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"gap": "rad or m", "inertia": "kg m^2 or kg"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"gap": (0.0, 10.0), "inertia": (0.0, 1e4)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        driven = {name: [a for a in spec.actuators if _drives(a, name)] for name in (j.name for j in spec.joints)}
        rotors = {tendon.name: tendon for tendon in spec.tendons if tendon.name.startswith(ROTOR)}
        joints = scalar_joints(spec, self.at)
        for name in self.at:
            if not driven[name] and ROTOR + name not in rotors:
                raise ValueError(f"backlash: no actuator drives the joint {name!r}, so nothing can have play")
        if not self.gap:
            return
        for joint, whole in list(zip(joints, effective_inertia(spec, joints), strict=True)):
            if ROTOR + joint.name in rotors:  # the play of two gears in a row adds up
                rotors[ROTOR + joint.name].range = np.array(rotors[ROTOR + joint.name].range) + [-self.gap, self.gap]
            elif driven.get(joint.name):
                self._add_rotor(spec, joint, whole, driven[joint.name])

    def _add_rotor(self, spec: mujoco.MjSpec, joint: mujoco.MjsJoint, whole: float, drives: list[Any]) -> None:
        inertia = joint.armature or self.inertia or ROTOR_SHARE * whole
        if inertia >= whole:
            raise ValueError(f"backlash.inertia={inertia}: all that moves with {joint.name!r} is only {whole:.3g}")
        address = int(spec.copy().compile().joint(joint.name).qposadr[0])
        joint.armature -= inertia  # rotor and joint together weigh what they did
        body = spec.worldbody.add_body(name=ROTOR + joint.name, mass=CENTRE_MASS, inertia=[CENTRE_MASS] * 3)
        body.ipos, body.explicitinertial = np.zeros(3), True
        rotor = body.add_joint(name=ROTOR + joint.name, type=joint.type, axis=[0, 0, 1], armature=inertia)
        rotor.range, rotor.limited = joint.range, int(mujoco.mjtLimited.mjLIMITED_FALSE)
        play = spec.add_tendon(name=ROTOR + joint.name, limited=1, range=[-self.gap, self.gap])
        play.wrap_joint(joint.name, 1.0)
        play.wrap_joint(rotor.name, -1.0)
        play.solref_limit, play.solimp_limit[:3] = np.array([0.002, 1.0]), [0.99, 0.9999, 1e-4]
        for actuator in drives:
            actuator.target = rotor.name
        for key in spec.keys:
            if len(key.qpos):
                key.qpos = [*key.qpos, key.qpos[address]]
            if len(key.qvel):
                key.qvel = [*key.qvel, 0.0]


def _drives(actuator: Any, joint: str) -> bool:
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    has_input = actuator.ctrlspec != int(mujoco.mjtCtrlInput.mjINPUT_NONE)
    return bool(joint) and actuator.target == joint and actuator.trntype in kinds and has_input


def place_rotors(model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array | None = None) -> None:
    """Put every rotor where its joint is, moving with it; in place.

    A start that comes from measured joints has to be completed by this: rotors are not measured. A rotor leans against
    the flank through which it gives its joint the acceleration; without one it is in the middle of the play.

    Args:
        model: A scene, with or without rotors.
        qpos: [..., nq], with the joints set.
        qvel: [..., nv], with the joints set.
        qacc: [..., nv], with the joints set.
    """
    rotors = [i for i in range(model.njnt) if model.joint(i).name.startswith(ROTOR)]
    joints = [model.joint(model.joint(i).name.removeprefix(ROTOR)) for i in rotors]
    for i, joint in zip(rotors, joints, strict=True):
        qpos[..., model.jnt_qposadr[i]] = qpos[..., joint.qposadr[0]]
        qvel[..., model.jnt_dofadr[i]] = qvel[..., joint.dofadr[0]]
    if not rotors or qacc is None:
        return
    data = mujoco.MjData(model)
    needed = np.zeros(model.nv)
    for at in np.ndindex(qpos.shape[:-1]):
        data.qpos[:], data.qvel[:] = qpos[at], qvel[at]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_mulM(model, data, needed, qacc[at])
        dry = model.dof_frictionloss * np.sign(qvel[at])
        force = needed + data.qfrc_bias - data.qfrc_passive + dry
        for i, joint in zip(rotors, joints, strict=True):
            play = model.tendon_range[model.tendon(model.joint(i).name).id, 1]
            qpos[(*at, model.jnt_qposadr[i])] += play * np.sign(force[joint.dofadr[0]])


EFFECT = Backlash
