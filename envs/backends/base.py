"""The line between what is above (learning) and what is below (physics, or a robot)."""

from collections import Counter
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from envs.task import AbstractTask, Array


class BackendError(Exception):
    """A robot cannot be used, or not any longer; it is at rest. The message says why and what to do next."""


class Outcome(NamedTuple):
    """What one control period brought, a row each environment."""

    observation: Array  # [N, O] as sensed
    reward: Array  # [N]
    success: NDArray[np.bool_]  # [N] the goal holds now
    terminated: NDArray[np.bool_]  # [N] the task ended
    action_sent: Array  # [N, A] the action after the interface's own limits
    invalid: NDArray[np.bool_]  # [N] the period must not be learned from


class Backend(Protocol):
    """Resets, and carries out actions. Everything above sees observations and rewards, nothing else.

    Attributes:
        task: What is done.
        num_envs: N.
        counters: How often what went wrong since the beginning; `unstable` counts failed physics.
        note: Why the last period of the first environment is invalid, or why less was sent than asked; often empty.
    """

    task: AbstractTask
    num_envs: int
    counters: Counter[str]
    note: str

    def seed(self, seed: int) -> None:
        """Make everything random from here on a function of `seed`."""
        ...

    def reset(self, sims: NDArray[np.int_]) -> Array:
        """Start new episodes in some environments; their first observations, [n, O]."""
        ...

    def send(self, action: Array) -> Outcome:
        """Carry out one control period in every environment."""
        ...

    def positions(self) -> Array | None:
        """Joint positions of the first environment now, [nq]; None if there are none to show."""
        ...

    def samples(self) -> dict[str, Array] | None:
        """Joint-level record of the first environment's last period at 100 Hz or more: time [S] since the episode's
        start, qpos [S, nq], qvel [S, nv], ctrl [S, nu] as the interface meant it, force [S, nu] of the actuators; None
        if there is none."""
        ...

    def describe(self) -> dict[str, object]:
        """Names of joints and actuators, for recordings; nothing of what is hidden."""
        ...

    def close(self) -> None:
        """Bring everything to rest and let go of it; a second call does nothing."""
        ...
