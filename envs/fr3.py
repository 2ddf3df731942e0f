"""The Franka FR3 as MJCF: primitive geoms, written from published figures.

Sources: franka_description 1.0.1 (kinematics, masses, limits, collision capsules) and the FCI documentation; the joint
dynamics are values identified for position control. Link inertias are those of the collision capsules, scaled to the
published link mass: the arm is position-controlled, so this is enough for pushing, not for torque control.
"""

from typing import NamedTuple

import mujoco
import numpy as np

Q_MIN = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])  # [rad]
Q_MAX = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])  # [rad]
DQ_MAX = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])  # [rad/s]
TORQUE_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # [N m]
DH_A = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])  # [m], Craig's convention
DH_D = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])  # [m]
DH_ALPHA = np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0]) * np.pi / 2  # [rad]
FLANGE = 0.107  # [m] along the axis of joint 7
TCP = 0.1034  # [m] from the flange to where the hand holds things
LINK_MASS = np.array([2.9275, 2.9355, 2.2449, 2.6156, 2.3271, 1.8170, 0.6271])  # [kg]
BASE_MASS = 2.3966  # [kg]
ARMATURE = np.array([0.195, 0.195, 0.195, 0.195, 0.074, 0.074, 0.074])  # [kg m^2]
FRICTIONLOSS = np.array([1.137, 1.137, 1.137, 1.137, 0.763, 0.44, 0.248])  # [N m]
DAMPING = 0.21  # [N m s/rad]
KP = np.array([4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0])  # [N m/rad]; velocity gain KP / 10

# Collision classes: the arm and its tool meet the table and objects, not each other
TABLE_BIT, OBJECT_BIT, TOOL_BIT = 1, 2, 4


class Capsule(NamedTuple):
    """A collision capsule along z of its link: sizes and centre in metres."""

    link: int
    radius: float
    length: float
    centre: tuple[float, float, float]


CAPSULES = (
    Capsule(1, 0.06, 0.283, (0, 0, -0.1915)),
    Capsule(2, 0.06, 0.12, (0, 0, 0)),
    Capsule(3, 0.06, 0.15, (0, 0, -0.145)),
    Capsule(4, 0.06, 0.12, (0, 0, 0)),
    Capsule(5, 0.06, 0.10, (0, 0, -0.26)),
    Capsule(5, 0.025, 0.14, (0, 0.08, -0.13)),
    Capsule(6, 0.05, 0.08, (0, 0, -0.03)),
    Capsule(7, 0.04, 0.14, (0, 0, 0.01)),
)
JOINTS = tuple(f"joint{i}" for i in range(1, 8))
WHITE, GREY, BLUE = [0.93, 0.94, 0.95, 1], [0.35, 0.37, 0.4, 1], [0.12, 0.36, 0.62, 1]


def arm_scene(sim_dt: float) -> mujoco.MjSpec:
    """An empty scene with what position-controlled arms and their contacts need, in steps of `sim_dt` [s]."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = sim_dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # the pyramid lets a puck slide 1.4 times too far on diagonals
    return spec


def allow_delays(spec: mujoco.MjSpec, steps: int) -> None:
    """Give all actuators a zero delay and a vanishing lag, so that both are parameters of the model.

    Args:
        spec: The scene.
        steps: Physics steps of command history, the longest delay.
    """
    for actuator in spec.actuators:
        actuator.nsample, actuator.delay = steps, 0.0
        actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1
        actuator.dynprm[0] = 1e-6


def add_fr3(
    spec: mujoco.MjSpec, *, base: tuple[float, float, float], tool_length: float, tool_radius: float
) -> mujoco.MjsBody:
    """Add the arm with a round peg as its tool; return the last link's body.

    The peg is a capsule along the flange axis; the site `tip` is the lowest point of its axis, `tool_length` beyond the
    flange. Joint order and names are `joint1`..`joint7`, position actuators `position1`..`position7` follow a target
    in radians, limited to the joint range and torque.

    Args:
        spec: The scene to add to.
        base: Where the base stands in the world, [m].
        tool_length: From the flange to the tip, [m].
        tool_radius: Of the peg, [m].
    """
    body = spec.worldbody.add_body(name="link0", pos=list(base), gravcomp=1)
    body.add_geom(
        name="link0",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.07, 0.04, 0],
        pos=[-0.03, 0, 0.06],
        mass=BASE_MASS,
        rgba=WHITE,
        contype=0,
        conaffinity=0,
    )
    for i in range(7):
        alpha, a, d = DH_ALPHA[i], DH_A[i], DH_D[i]
        body = body.add_body(
            name=f"link{i + 1}",
            pos=[a, -np.sin(alpha) * d, np.cos(alpha) * d],
            quat=[np.cos(alpha / 2), np.sin(alpha / 2), 0, 0],
            gravcomp=1,
        )
        joint = body.add_joint(
            name=JOINTS[i], type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], range=[Q_MIN[i], Q_MAX[i]], limited=1
        )
        joint.armature, joint.frictionloss = ARMATURE[i], FRICTIONLOSS[i]
        joint.damping[0] = DAMPING
        capsules = [c for c in CAPSULES if c.link == i + 1]
        for k, c in enumerate(capsules):
            body.add_geom(
                name=f"link{i + 1}_{k}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[c.radius, c.length / 2, 0],
                pos=list(c.centre),
                mass=LINK_MASS[i] / len(capsules),
                rgba=WHITE if i != 5 else GREY,
                contype=0,
                conaffinity=TABLE_BIT | OBJECT_BIT,
            )
    half = tool_length / 2 - tool_radius / 2
    body.add_geom(
        name="tool",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[tool_radius, half, 0],
        pos=[0, 0, FLANGE + half],
        mass=0.1,
        rgba=BLUE,
        contype=TOOL_BIT,
        conaffinity=TABLE_BIT | OBJECT_BIT,
    )
    body.add_site(name="tip", pos=[0, 0, FLANGE + tool_length], size=[0.004, 0, 0], rgba=[0, 0, 0, 0])
    for i in range(7):
        actuator = spec.add_actuator(
            name=f"position{i + 1}", target=JOINTS[i], trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=1, forcelimited=1
        )
        actuator.set_to_position(kp=KP[i], kv=KP[i] / 10)
        actuator.ctrlrange, actuator.forcerange = [Q_MIN[i], Q_MAX[i]], [-TORQUE_MAX[i], TORQUE_MAX[i]]
    return body
