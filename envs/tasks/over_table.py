"""What tasks share in which an FR3 moves something over a table with a hole."""

import mujoco
import numpy as np

from envs import fr3, kinematics
from envs.task import AbstractTask, Array

TOP = 0.10  # [m] height of the table above the robot's base
REST = np.array([0.0, -0.1, 0.0, -2.3, 0.0, 2.2, 0.785])  # [rad]
NSAMPLE = 500  # physics steps of command history that the model holds, so that a delay is a parameter


class OverTable(AbstractTask):
    """Moves a point below the flange, the tool upright; an action changes the commanded place of that point.

    Attributes:
        tool_length: From the flange to the point that is commanded, [m].
        above: Of that point over the table, at the start, [m].
        low, high: Where it may go, [3] m each.
        step_size: Largest change a control step, [m].
        hole_x, hole_y: Where the hole may be, from and to, [m].
        start_noise: Of the start, along each axis, [m].
    """

    tool_length: float
    above: float
    low: Array
    high: Array
    step_size: float
    hole_x: tuple[float, float]
    hole_y: tuple[float, float]
    start_noise: float
    action_dim = 3
    moves_in_plane = True
    _home: Array | None = None

    def scene(self) -> tuple[mujoco.MjSpec, mujoco.MjsBody]:
        """The arm under a light, before a camera, and its last link."""
        spec = fr3.arm_scene(self.sim_dt)
        spec.worldbody.add_light(pos=[0.3, -0.6, 1.6], dir=[0, 0.35, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        spec.worldbody.add_camera(name="side", pos=[1.25, -0.95, 0.55], xyaxes=[0.776, 0.63, 0, -0.176, 0.217, 0.959])
        return spec, fr3.add_fr3(spec, base=(0, 0, 0), tool_length=fr3.TCP, tool_radius=0.02)

    def home(self) -> Array:
        """Joint angles [1, 7] with the point above the middle of the table; computed once."""
        if self._home is None:
            q = REST[None]
            for _ in range(30):
                q = self._joints(q, self._middle())
            self._home = q
        return self._home

    def first(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Place [1, 3] m and joint angles [1, 7] of one episode's start."""
        place = self._middle() + rng.uniform(-self.start_noise, self.start_noise, (1, 3))
        return place, self._joints(self.home(), place)

    def move(self, target: Array, action: Array) -> Array:
        return np.clip(target + self.step_size * action, self.low, self.high)

    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        return self._joints(previous_ctrl, target)

    def hold(self, qpos: Array) -> Array:
        return kinematics.tip_position(qpos[:, :7], self.tool_length)

    def _middle(self) -> Array:
        return np.array([[np.mean(self.hole_x), np.mean(self.hole_y), TOP + self.above]], float)

    def _joints(self, q: Array, place: Array) -> Array:
        """Joint angles [N, 7] that bring the point to a place [N, 3] m, the tool upright."""
        return kinematics.inverse(q, place, REST, self.tool_length, upright=0.2)
