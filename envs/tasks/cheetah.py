"""Run on a back and a front leg in a plane."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.task import Array
from envs.tasks.planar import ROOT, Link, Pair, PlanarTask, volume

MASS = 14.0  # [kg]
RADIUS = 0.046  # [m] of all capsules


def bone(middle: Pair, lean: float, half: float) -> tuple[Pair, Pair, float]:
    """A capsule by its middle [m], the angle of its axis [deg] and half its length [m]."""
    x, z = half * np.sin(np.deg2rad(lean)), half * np.cos(np.deg2rad(lean))
    return (middle[0] - x, middle[1] - z), (middle[0] + x, middle[1] + z), RADIUS


def part(name: str, parent: str, place: Pair, shape: tuple[Pair, Pair, float], joint: tuple[float, ...]) -> Link:
    """A link of a leg; of its joint, from and to [deg], the largest torque, stiffness and damping."""
    low, high, torque, stiffness, damping = joint
    return Link(name, parent, place, (shape,), (np.deg2rad(low), np.deg2rad(high)), torque, stiffness, damping)


class CheetahRun(PlanarTask):
    """Run forward as fast as can be.

    Observation: height of the torso against standing [m], its pitch and the angles of the six joints [rad], speed of
    the torso along x and z [m/s], of its pitch and of the joints [rad/s]; 17 numbers, x itself is not seen. Action: six
    torques. 50 Hz, 250 steps.

        r = min(max(v / 10, 0), 1)

    with the forward speed v [m/s] of the centre of mass. The scripted policy is a gait whose phase φ it reads from the
    back thigh, and whose torques are shares of the largest: a cos φ + b sin φ + c. It comes 16 m far, at a third of the
    full speed, and turns over in some episodes.

    Source: cheetah of dm_control, Tassa et al. 2018, arXiv:1801.00690: sizes, masses, springs, torques, observation and
    reward. There, episodes have 10 s and start after 2 s of rest, torques jump instead of moving linearly within a
    control step, and actions last 10 ms (20 ms as TD-MPC2 repeats them).
    """

    name = "cheetah_run"
    links = (
        Link("torso", "", (0.0, 0.7), (((-0.5, 0.0), (0.5, 0.0), RADIUS), bone((0.6, 0.1), 50, 0.15))),
        part("back_thigh", "torso", (-0.5, 0.0), bone((0.1, -0.13), -218, 0.145), (-30, 60, 120, 240, 6.0)),
        part("back_shin", "back_thigh", (0.16, -0.25), bone((-0.14, -0.07), -116, 0.15), (-50, 50, 90, 180, 4.5)),
        part("back_foot", "back_shin", (-0.28, -0.14), bone((0.03, -0.097), -15, 0.094), (-230, 50, 60, 120, 3.0)),
        part("front_thigh", "torso", (0.5, 0.0), bone((-0.07, -0.12), 30, 0.133), (-57, 0.4, 90, 180, 4.5)),
        part("front_shin", "front_thigh", (-0.14, -0.24), bone((0.065, -0.09), -34, 0.106), (-70, 50, 60, 120, 3.0)),
        part("front_foot", "front_shin", (0.13, -0.18), bone((0.045, -0.07), -34, 0.07), (-28, 28, 30, 60, 1.5)),
    )
    armature, density, touches_itself, goal = 0.1, MASS / volume(links), True, 10.0
    observation_names = (
        *("z", "pitch", *(link.name for link in links[1:])),
        *(f"speed_{name}" for name in (*ROOT, *(link.name for link in links[1:]))),
    )

    def __init__(self, *, gait: Mapping[str, Any], **settings: Any):
        super().__init__(**settings)
        self.gait = gait

    def observe(self, qpos: Array, qvel: Array) -> Array:
        return np.concatenate([qpos[:, 1:], qvel], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        angle = observation[:, 1:8] @ self.chain.T
        return np.clip(self.forward(angle, observation[:, 8:]) / self.goal, 0, 1)

    def scripted(self, observation: Array) -> Array:
        """A gallop that the back thigh's swing keeps in time; no feedback of balance."""
        thigh, speed = observation[:, 2], observation[:, 11]
        phase = np.arctan2(speed / self.gait["rate"], thigh - self.gait["middle"])[:, None]
        a, b, c = (np.array(self.gait[name]) for name in "abc")
        return np.clip(a * np.cos(phase) + b * np.sin(phase) + c, -1, 1)

    def points(self, observation: Array) -> dict[str, Array]:
        return {"tool": self.at_origin(observation[..., 0] + self.links[0].place[1])}
