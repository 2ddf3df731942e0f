"""Put a table's leg into its hole with an FR3."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs import fr3, kinematics
from envs.fixture import add_table_with_hole
from envs.task import Array, Start, ValuePlane, View, whole_steps
from envs.tasks.over_table import NSAMPLE, TOP, OverTable

BELOW = 0.08  # [m] from the hand to the leg's end
START = 0.10  # [m] of the leg's end above the table, at the start
LOW, HIGH = np.array([0.35, -0.15, TOP - 0.05]), np.array([0.65, 0.15, TOP + 0.2])  # [m] where the leg's end may go


class Insert(OverTable):
    """Lower the leg into the hole until its end is `depth` below the table.

    Observation: place of the hand, of the leg's end, and where that has to be, x, y, z each [m], in the frame of the
    base. Action: change of the commanded place of the leg's end. 5 Hz, 40 steps.

        r = 1[|dx|, |dy|, |dz| < 1 cm] - 100 (dx^2 + dy^2 + dz^2), each of the differences at most 10 cm

    Success: all three are below 1 cm when the episode ends; the hole is narrower than that, so that the leg is in it.

    Source: Yin, Westenbroek et al., ICLR 2025, inserting. The hole is `clearance` times as wide as the leg, as there;
    it is round, and so is the leg, since the hand does not turn.
    """

    name = "insert"
    observation_names = tuple(f"{what}_{axis}" for what in ("hand", "leg", "hole") for axis in "xyz")
    tool_length, above, low, high = fr3.TCP + BELOW, START, LOW, HIGH

    def __init__(
        self,
        *,
        step_size: float,
        episode_steps: int,
        control_dt: float,
        sim_dt: float,
        hole_x: tuple[float, float],
        hole_y: tuple[float, float],
        hole_yaw: tuple[float, float],
        leg_radius: float,
        clearance: float,
        depth: float,
        friction: float,
        tolerance: float,
        start_noise: float,
    ):
        whole_steps(control_dt, sim_dt)
        self.step_size, self.episode_steps = step_size, episode_steps
        self.control_dt, self.sim_dt = control_dt, sim_dt
        self.hole_x, self.hole_y, self.hole_yaw = hole_x, hole_y, hole_yaw
        self.leg_radius, self.clearance, self.depth = leg_radius, clearance, depth
        self.friction, self.tolerance, self.start_noise = friction, tolerance, start_noise

    def spec(self) -> mujoco.MjSpec:
        spec, hand = self.scene()
        leg = hand.add_body(name="leg", pos=[0, 0, fr3.FLANGE + fr3.TCP], gravcomp=1)
        leg.add_geom(
            name="leg",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.leg_radius, (BELOW + 0.02) / 2, 0],
            pos=[0, 0, (BELOW - 0.02) / 2],
            mass=0.1,
            friction=[self.friction, 0.005, 0.0001],
            priority=1,
            rgba=[0.72, 0.52, 0.3, 1],
            contype=fr3.OBJECT_BIT,
            conaffinity=0,
        )
        fr3.allow_delays(spec, NSAMPLE)
        add_table_with_hole(spec, radius=self.leg_radius * self.clearance, floor=TOP - self.depth, top=TOP)
        return spec

    def start(self, rng: np.random.Generator) -> Start:
        place, q = self.first(rng)
        hole = [rng.uniform(*self.hole_x), rng.uniform(*self.hole_y), rng.uniform(*self.hole_yaw)]
        return Start(qpos=np.concatenate([q[0], hole])[None], qvel=np.zeros((1, 10)), target=place)

    def place(self, observation: Array, qpos: Array) -> Array:
        """The table where its hole is seen; its turn is not observed and left as it is."""
        placed = qpos.copy()
        placed[:, 7:9] = observation[:, 6:8]
        return placed

    def observe(self, qpos: Array, qvel: Array) -> Array:
        hand, leg = (kinematics.tip_position(qpos[:, :7], length) for length in (fr3.TCP, fr3.TCP + BELOW))
        return np.concatenate([hand, leg, qpos[:, 7:9], np.full((len(qpos), 1), TOP - self.depth)], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        apart = np.abs(observation[:, 3:6] - observation[:, 6:9])
        return self.success(observation) - 100 * (np.minimum(apart, 0.1) ** 2).sum(1)

    def success(self, observation: Array) -> NDArray[np.bool_]:
        return np.all(np.abs(observation[:, 3:6] - observation[:, 6:9]) < self.tolerance, axis=1)

    def scripted(self, observation: Array) -> Array:
        """Stand above the hole, and go down while the leg is over it."""
        apart = observation[:, 6:9] - observation[:, 3:6]
        aside = np.linalg.norm(apart[:, :2], axis=1)
        inside = observation[:, 5] < TOP - 0.003
        down = np.where(inside | (aside < 0.5 * (self.clearance - 1) * self.leg_radius), -0.02, 0.0)
        hover = TOP + 0.004 - observation[:, 5]
        dz = np.where(down < 0, np.maximum(down, apart[:, 2]), hover)
        across = np.where(inside[:, None], 0.0, apart[:, :2])
        return np.clip(np.concatenate([across, dz[:, None]], 1) / self.step_size, -1, 1)

    def points(self, observation: Array) -> dict[str, Array]:
        return {"tool": observation[..., 3:6], "object": observation[..., 6:9]}

    def place_of(self, qpos: Array) -> Array:
        return np.concatenate([qpos[:, 7:9], np.full((len(qpos), 1), TOP)], 1)

    def view(self) -> View:
        return View(
            eye=(1.2, -0.8, 0.6),
            target=(0.4, 0.0, 0.22),
            second_eye=(0.5, -0.5, 0.2),
            second_target=(0.5, 0.0, 0.15),
            object_radius=self.leg_radius,
            object_height=0.01,
        )

    def value_plane(self, points: int) -> ValuePlane:
        """V over x and height of the leg's end, in the plane through a hole in the middle of its range."""
        x, z = np.meshgrid(np.linspace(LOW[0], HIGH[0], points), np.linspace(LOW[2], HIGH[2], points), indexing="ij")
        middle = float(np.mean(self.hole_x)), float(np.mean(self.hole_y))
        leg = np.stack([x.ravel(), np.full(x.size, middle[1]), z.ravel()], 1)
        hole = np.tile([*middle, TOP - self.depth], (x.size, 1))
        observation = np.concatenate([leg + [0, 0, BELOW], leg, hole], 1)
        extent = (LOW[0], HIGH[0], LOW[2], HIGH[2])
        return ValuePlane(observation, (points, points), extent, (("x", "m"), ("z", "m")), {"hole": (middle[0], TOP)})
