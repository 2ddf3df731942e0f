"""What a task must say: its scene, its controller, what it observes, what it rewards."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Start(NamedTuple):
    """The state that an episode starts from, one row each environment."""

    qpos: Array  # [n, nq]
    qvel: Array  # [n, nv]
    target: Array  # [n, C], the controller's first command


def whole_steps(control_dt: float, sim_dt: float) -> int:
    """Physics steps in a control period.

    Raises:
        ValueError: If the period is not a whole number of physics steps.
    """
    steps = round(control_dt / sim_dt)
    if steps < 1 or abs(steps * sim_dt - control_dt) > 1e-9:
        raise ValueError(f"control_dt={control_dt} s is not a whole number of sim_dt={sim_dt} s")
    return steps


class AbstractTask(ABC):
    """One task: all arrays have a leading row per environment, all units are SI.

    Attributes:
        name: As in configs/task/.
        observation_names: One name for each entry of the observation.
        action_dim: Size of an action; actions lie in [-1, 1].
        episode_steps: Control steps in an episode.
        control_dt: Seconds between actions.
        sim_dt: Seconds between physics steps.
        moves_in_plane: Whether the first two entries of an action displace the tool along x and y.
    """

    name: str
    observation_names: tuple[str, ...]
    action_dim: int
    episode_steps: int
    control_dt: float
    sim_dt: float
    moves_in_plane: bool = False

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """The nominal scene."""

    @abstractmethod
    def start(self, rng: np.random.Generator) -> Start:
        """Draw one episode's start (n = 1)."""

    @abstractmethod
    def move(self, target: Array, action: Array) -> Array:
        """The controller's command after an action [N, A] from the one before, within limits, [N, C]."""

    @abstractmethod
    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        """Actuator signal [N, nu] at the end of the period that realises a command [N, C]."""

    @abstractmethod
    def observe(self, qpos: Array, qvel: Array) -> Array:
        """Observation [N, O] of a state."""

    @abstractmethod
    def reward(self, observation: Array, action: Array) -> Array:
        """Reward [N] for arriving at an observation [N, O] by an action [N, A]."""

    @abstractmethod
    def success(self, observation: Array) -> NDArray[np.bool_]:
        """Whether the goal holds at an observation, [N]."""

    @abstractmethod
    def scripted(self, observation: Array) -> Array:
        """A hand-written policy [N, A]: proof that the task can be solved."""

    def hold(self, qpos: Array) -> Array:
        """The controller's command that keeps the machine where it stands, [N, C], for its own joints [N, nu]."""
        return qpos.copy()

    def place(self, observation: Array, qpos: Array) -> Array:
        """Joint positions [N, nq] with the objects where an observation [N, O] sees them; other joints stay."""
        return qpos.copy()

    def terminated(self, observation: Array) -> NDArray[np.bool_]:
        """Whether the task itself ends here, [N]; by default it never does, only the clock runs out."""
        return np.zeros(len(observation), bool)

    def points(self, observation: Array) -> dict[str, Array]:
        """Named points in the world frame, [N, 3] m, that a viewer can draw for an observation; may be empty."""
        return {}

    def describe(self) -> str:
        return f"{self.name}: {self.action_dim} actions, observes {', '.join(self.observation_names)}"
