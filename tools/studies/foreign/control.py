"""What a laboratory does with a machine: motions to follow, and a controller that follows them through the model."""

from collections.abc import Callable

import mujoco
import numpy as np

from tools.studies.blind.excite import KINDS, Reference, reference
from tools.studies.blind.plants import Array
from tools.studies.foreign.scenes import Scene

LIVELY = ("multisine", "chirp", "steps")
CALM = ("slow", "reversals", "hold")
BANDWIDTH, DAMPING, FILTER = 10.0, 0.8, 25.0  # [rad/s], [1], [Hz] of the speed that is fed back


def motion(scene: Scene, ticks: int, dt: float, rng: np.random.Generator) -> Reference:
    """A lively part, a calm one, and another, in any order, [T, n]; joints without a drive stay at 0."""
    kinds = [rng.choice(LIVELY), rng.choice(CALM), rng.choice(KINDS + ("chirp",))]
    followed = reference(tuple(str(k) for k in rng.permutation(kinds)), scene.kinds, ticks, dt, rng)
    for array in followed:
        array[:, len(scene.actuators) :] = 0.0
    return followed


class Tracking:
    """Inverse dynamics of the nominal model along the motion, and feedback; a servo gets the motion itself.

    Args:
        scene: The kind of machine.
        model: The nominal one.
        followed: What to follow.
        dt: [s] of a tick.
    """

    def __init__(self, scene: Scene, model: mujoco.MjModel, followed: Reference, dt: float) -> None:
        self.servo, self.dt, self.followed = scene.servo, dt, followed
        self.driven = np.arange(len(scene.actuators))
        self.top = model.actuator_ctrlrange[:, 1]
        data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        self.ahead, self.inertia = np.zeros((2, len(followed.position), len(self.driven)))
        if self.servo:
            return
        gear = model.actuator_gear[:, 0]
        for k, (q, v, a) in enumerate(zip(*followed, strict=True)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
            mujoco.mj_inverse(model, data)
            mujoco.mj_fullM(model, data, mass)
            self.ahead[k] = data.qfrc_inverse[self.driven] / gear
            self.inertia[k] = np.diag(mass)[self.driven] / gear
        self.before: Array | None = None
        self.speed = np.zeros(len(self.driven))

    def __call__(self, k: int, read: Array) -> Array:
        read = read[self.driven]
        if self.servo:
            return self.followed.position[k, self.driven]
        if self.before is not None:
            share = 1 - np.exp(-2 * np.pi * FILTER * self.dt)
            self.speed = self.speed + share * ((read - self.before) / self.dt - self.speed)
        else:
            self.speed = self.followed.velocity[k, self.driven].copy()
        self.before = read
        apart = self.followed.position[k, self.driven] - read
        slower = self.followed.velocity[k, self.driven] - self.speed
        pull = BANDWIDTH**2 * apart + 2 * DAMPING * BANDWIDTH * slower
        return np.clip(self.ahead[k] + self.inertia[k] * pull, -self.top, self.top)


def left_alone(drives: int) -> Callable[[int, Array], Array]:
    """No command, for free swings."""
    return lambda k, read: np.zeros(drives)
