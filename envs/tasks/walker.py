"""Walk on two legs in a plane."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.task import Array
from envs.tasks.planar import ROOT, Link, PlanarTask

DENSITY = 1000.0  # [kg/m^3]; 28.5 kg in all
STAND_HEIGHT = 1.2  # [m] of the torso's middle, from which on the machine stands; 1.3 with straight legs
THIGH, SHIN, FOOT = (0.0, -0.45), (0.0, -0.5), ((-0.04, 0.0), (0.16, 0.0))  # [m] from their hinges


def leg(side: str, aside: float) -> tuple[Link, Link, Link]:
    """Thigh, shin and foot of a leg."""
    hip, knee, ankle = np.deg2rad([[-100, 20], [0, 150], [-45, 45]]).tolist()
    thigh, shin, foot = (f"{side}_{part}" for part in ("thigh", "shin", "foot"))
    origin = (0.0, 0.0)
    return (
        Link(thigh, "torso", (0.0, -0.3), ((origin, THIGH, 0.05),), hip, 100.0, damping=0.1, aside=aside),
        Link(shin, thigh, THIGH, ((origin, SHIN, 0.04),), knee, 50.0, damping=0.1),
        Link(foot, shin, SHIN, ((*FOOT, 0.05),), ankle, 20.0, damping=0.1),
    )


class WalkerWalk(PlanarTask):
    """Walk forward at 1 m/s or faster.

    Observation: cos, then sin of the lean of each of the seven links, height of the torso's middle [m], speed of the
    torso along x and z [m/s], of its lean and of the joints [rad/s]; 24 numbers, x itself is not seen. Action: six
    torques. 20 Hz, 200 steps.

        r = (3 s + u) / 4 * (5 m + 1) / 6

        s = 0.1^(((1.2 m - height) / 0.6 m)^2) below 1.2 m, else 1;  u = (1 + cos lean) / 2;  m = min(max(v, 0), 1)

    with the forward speed v [m/s] of the centre of mass. The scripted policy pushes off behind and walks five
    metres upright in most episodes, at half of the full speed.

    Source: walker of dm_control, Tassa et al. 2018, arXiv:1801.00690: sizes, masses, torques, observation and reward.
    There, episodes have 25 s and start anywhere (`anywhere_share=1`), torques jump instead of moving linearly within a
    control step, and actions last 25 ms (50 ms as TD-MPC2 repeats them).
    """

    name = "walker_walk"
    links = (
        Link("torso", "", (0.0, 1.3), (((0.0, -0.3), (0.0, 0.3), 0.07),)),
        *leg("right", -0.05),
        *leg("left", 0.05),
    )
    armature, density, solimp, goal = 0.01, DENSITY, (0.0, 0.99, 0.01), 1.0
    observation_names = (
        *(f"cos_{link.name}" for link in links),
        *(f"sin_{link.name}" for link in links),
        "height",
        *(f"speed_{name}" for name in (*ROOT, *(link.name for link in links[1:]))),
    )

    def __init__(self, *, gait: Mapping[str, Any], **settings: Any):
        super().__init__(**settings)
        self.gait = gait

    def observe(self, qpos: Array, qvel: Array) -> Array:
        angle = qpos[:, 2:] @ self.chain.T
        height = qpos[:, 1:2] + self.links[0].place[1]
        return np.concatenate([np.cos(angle), np.sin(angle), height, qvel], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        cos, sin, height, speeds = np.split(observation, [7, 14, 15], 1)
        standing = 0.1 ** ((np.maximum(STAND_HEIGHT - height[:, 0], 0) / (STAND_HEIGHT / 2)) ** 2)
        upright = (1 + cos[:, 0]) / 2
        moving = np.clip(self.forward(np.arctan2(sin, cos), speeds) / self.goal, 0, 1)
        return (3 * standing + upright) / 4 * (5 * moving + 1) / 6

    def scripted(self, observation: Array) -> Array:
        """The front leg holds torso and speed, the back one pushes; the knees bend while the feet pass each other."""
        cos, sin, speeds, g = observation[:, :7], observation[:, 7:14], observation[:, 15:], self.gait
        thigh, shin = [1, 4], [2, 5]  # right, left
        foot = THIGH[1] * sin[:, thigh] + SHIN[1] * sin[:, shin]  # [N, 2] m before the hip
        ahead = foot - foot[:, ::-1]
        lean, knee = np.arctan2(sin[:, 0], cos[:, 0]), np.arctan2(sin, cos)[:, shin] - np.arctan2(sin, cos)[:, thigh]
        hold = g["bias"] + g["lean"] * lean + g["lean_speed"] * speeds[:, 2] + g["speed"] * speeds[:, 0]
        hip = np.where(ahead > 0, hold[:, None], 1.0)
        bent = np.where(ahead > 0, g["front_knee"], g["back_knee"] / (1 + np.exp(-g["passing"] * ahead)))
        knee = g["knee"] * (bent - knee) - g["knee_speed"] * speeds[:, [4, 7]]
        legs = np.stack([hip, knee, -np.ones_like(hip)], 2)  # [N, 2, 3]
        return np.clip(legs.reshape(-1, 6), -1, 1)

    def points(self, observation: Array) -> dict[str, Array]:
        return {"tool": self.at_origin(observation[..., 14])}
