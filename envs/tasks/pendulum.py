"""Swing up a pendulum: the smallest task that shows the method, in seconds."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.task import AbstractTask, Array, Start, ValuePlane, View, whole_steps

MASS, LENGTH, DAMPING = 1.0, 1.0, 0.05  # [kg], [m], [N m s/rad]


class Pendulum(AbstractTask):
    """A point mass on a rod; the torque is limited, so it must be swung up.

    Observation: cos and sin of the angle from upright, angular velocity [rad/s]. Action: torque, scaled to
    `max_torque`. The reward is 1 when upright and still:

        r = (1 + cos th) / 2 - 0.01 w^2 - 0.01 a^2

    Success: within 0.3 rad of upright and slower than 1 rad/s when the episode ends. The unmodelled torque e(th, w) of
    the paper's pedagogical example is the effect `state_torque` (configs/gap/pendulum_torque.yaml).
    """

    name = "pendulum"
    observation_names = ("cos", "sin", "velocity")
    action_dim = 1

    def __init__(self, *, episode_steps: int, control_dt: float, sim_dt: float, max_torque: float, start: str):
        if start not in ("down", "anywhere"):
            raise ValueError(f"start={start!r}; allowed: down, anywhere")
        whole_steps(control_dt, sim_dt)
        self.episode_steps, self.control_dt, self.sim_dt = episode_steps, control_dt, sim_dt
        self.max_torque, self.start_from = max_torque, start

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.timestep = self.sim_dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.worldbody.add_light(pos=[0, -2, 3], dir=[0, 0.5, -1])
        spec.worldbody.add_camera(name="side", pos=[0, -4, 0], xyaxes=[1, 0, 0, 0, 0, 1])
        rod = spec.worldbody.add_body(name="rod")
        joint = rod.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        joint.damping[0] = DAMPING
        rod.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0, 0, LENGTH], size=[0.02, 0, 0], mass=0, contype=0
        )
        rod.add_geom(
            name="bob", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0, LENGTH], size=[0.08, 0, 0], mass=MASS, contype=0
        )
        motor = spec.add_actuator(
            name="torque", target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=1, nsample=200, delay=0.0
        )
        motor.set_to_motor()
        motor.ctrlrange = [-self.max_torque, self.max_torque]
        motor.dyntype, motor.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1
        motor.dynprm[0] = 1e-6
        return spec

    def start(self, rng: np.random.Generator) -> Start:
        angle = rng.uniform(-np.pi, np.pi) if self.start_from == "anywhere" else np.pi + rng.uniform(-0.3, 0.3)
        return Start(np.array([[angle]]), rng.uniform(-0.3, 0.3, (1, 1)), np.zeros((1, 1)))

    def move(self, target: Array, action: Array) -> Array:
        return self.max_torque * action

    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        return target

    def hold(self, qpos: Array) -> Array:
        return np.zeros_like(qpos)  # a torque: none

    def observe(self, qpos: Array, qvel: Array) -> Array:
        return np.concatenate([np.cos(qpos), np.sin(qpos), qvel], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        upright = (1 + observation[:, 0]) / 2
        return upright - 0.01 * observation[:, 2] ** 2 - 0.01 * (action**2).sum(1)

    def success(self, observation: Array) -> NDArray[np.bool_]:
        return (observation[:, 0] > np.cos(0.3)) & (np.abs(observation[:, 2]) < 1.0)

    def scripted(self, observation: Array) -> Array:
        """Pump energy along the motion until the top is in reach, then balance by a linear law."""
        cos, sin, velocity = observation.T
        gravity = MASS * 9.81 * LENGTH
        energy = 0.5 * MASS * LENGTH**2 * velocity**2 + gravity * (cos - 1)
        pump = -np.sign(velocity + 1e-9) * np.sign(energy) * self.max_torque
        balance = -(2.0 * gravity * sin + 6.0 * velocity)
        torque = np.where(cos > 0.9, balance, pump)
        return np.clip(torque / self.max_torque, -1, 1)[:, None]

    def view(self) -> View:
        return View(eye=(0.0, -3.0, 0.0), second_eye=(0.0, -3.0, 0.0))

    def value_plane(self, points: int) -> ValuePlane:
        """V over angle and speed."""
        extent = (-np.pi, np.pi, -8.0, 8.0)
        angle, speed = np.meshgrid(np.linspace(*extent[:2], points), np.linspace(*extent[2:], points), indexing="ij")
        observation = np.stack([np.cos(angle).ravel(), np.sin(angle).ravel(), speed.ravel()], 1)
        axes = (("angle", "rad"), ("speed", "rad/s"))
        return ValuePlane(observation, (points, points), extent, axes, {"upright": (0.0, 0.0)})
