"""What a task must say: its scene, its controller, what it observes, what it rewards."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[float, float, float]


class Start(NamedTuple):
    """The state that an episode starts from, one row each environment."""

    qpos: Array  # [n, nq]
    qvel: Array  # [n, nv]
    target: Array  # [n, C], the controller's first command


class Arm(NamedTuple):
    """What the robot backend must know of a task on the FR3.

    Attributes:
        rest: Posture to which the redundant joint is drawn, [7] rad.
        tool_length: From the flange to the tool's tip, [m].
    """

    rest: Array
    tool_length: float


class View(NamedTuple):
    """Where the viewer's cameras stand, and how large the object's ghost is; None leaves it to the viewer.

    Attributes:
        eye: Where the camera stands, [m].
        target: What it looks at, [m].
        second_eye: The same of the view that shows paths without the machine, [m].
        second_target: What it looks at, [m].
        object_radius: Of the object's ghost, a cylinder, [m].
        object_height: Of the same, [m].
    """

    eye: Point | None = None
    target: Point | None = None
    second_eye: Point | None = None
    second_target: Point | None = None
    object_radius: float = 0.03
    object_height: float = 0.02


class ValuePlane(NamedTuple):
    """Two quantities over which the value of a state is drawn as a map.

    Attributes:
        observation: At each point of a G by G' grid, the first quantity varying slowest, [G G', O].
        shape: (G, G').
        extent: First quantity from, to, second from, to.
        axes: Name and unit of each.
        marks: Named places to mark.
    """

    observation: Array
    shape: tuple[int, int]
    extent: tuple[float, float, float, float]
    axes: tuple[tuple[str, str], tuple[str, str]]
    marks: dict[str, tuple[float, float]]


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

    A task must say its attributes and the abstract methods: the scene, the start, the controller, observation, reward,
    success and a scripted policy. The rest has a default; say it where it holds: `hold`, `place` and `points` if there
    is an object or a controller of its own, `view` and `value_plane` for the viewer, `arm`, `place_of` and `qpos_of`
    for a robot.

    Attributes:
        name: As in configs/task/.
        observation_names: One name for each entry of the observation.
        action_dim: Size of an action; actions lie in [-1, 1].
        episode_steps: Control steps in an episode.
        control_dt: Seconds between actions.
        sim_dt: Seconds between physics steps.
        moves_in_plane: Whether the first two entries of an action displace the tool along x and y.
        arm: Of a task that an FR3 can do; None: simulation alone.
    """

    name: str
    observation_names: tuple[str, ...]
    action_dim: int
    episode_steps: int
    control_dt: float
    sim_dt: float
    moves_in_plane: bool = False
    arm: Arm | None = None

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
        """What a viewer can draw for an observation: `tool`, and `object` if there is one, [N, 3] m in the world frame;
        empty if nothing can be drawn."""
        return {}

    def view(self) -> View:
        """How a viewer looks at the scene."""
        return View()

    def value_plane(self, points: int) -> ValuePlane | None:
        """Over what the value is drawn as a map of `points` by `points`; None: no map."""
        return None

    def place_of(self, qpos: Array) -> Array:
        """Where the object is, base frame, [N, 3] m, for the scene's joint positions [N, nq].

        Raises:
            ValueError: If the task has no object.
        """
        raise ValueError(f"task {self.name} has no object")

    def qpos_of(self, joints: Array, place: Array) -> Array:
        """The scene's joint positions [N, nq] for the machine's [N, n] and the object's place [N, 3] m, upright."""
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(joints), 1))
        return np.concatenate([joints, place, upright], 1)

    def describe(self) -> str:
        return f"{self.name}: {self.action_dim} actions, observes {', '.join(self.observation_names)}"
