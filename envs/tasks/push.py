"""Push a puck to a line with an FR3: four numbers seen, two commanded."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs import fr3, kinematics
from envs.task import AbstractTask, Arm, Array, Start, ValuePlane, View, whole_steps

ORIGIN = np.array([0.20, 0.0, -0.15])  # [m] origin of the task frame on the table, base frame, unless told otherwise
PUCK_RADIUS, PUCK_HALF_HEIGHT = 0.025, 0.015  # [m]
TOOL_RADIUS, TOOL_LENGTH, TOOL_HEIGHT = 0.010, 0.15, 0.012  # [m]; the tip is kept this far above the table
REACH = 0.78  # [m] from the base axis: beyond it the arm is stretched
REST = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785])  # [rad]
TABLE_LOW, TABLE_SIDE = np.array([-0.15, -0.45]), 0.45  # [m] edges of the table but the far one, task frame
# [m] where the tip may be commanded, task frame
WORKSPACE_LOW, WORKSPACE_HIGH = np.array([-0.08, -0.32]), np.array([0.56, 0.32])
CONTACT = 0.035  # [m] tip to puck centre when they touch
NSAMPLE = 250  # physics steps of command history that the model holds, so that a delay is a parameter


class Push(AbstractTask):
    """Push the puck along x until it lies at the goal line.

    Observation [m]: tip x, tip y, puck x, puck y in the task frame, which lies on the table 0.20 m in front of the
    robot's base (at the paper's own x = 0 the puck would stand inside the base). Action: change of the commanded tip
    xy, or of joint targets with `control="joint"` (joints 1, 2 and 4). 5 Hz, 40 steps.

        r = -|tip - puck + (3.5 cm, 0)| - |puck_x - 55 cm| + 1[|puck_x - 55 cm| < 2.5 cm] - 1[puck fell]

    The puck falls where its centre leaves the table, which ends at `edge_x`: in the paper with the goal line
    (configs/task/push_edge.yaml), in `push` 20 cm beyond it.

    Success: the puck lies within 2.5 cm of the line when the episode ends, and has not left the table.

    A `stray_share` of the episodes start with the puck anywhere in `stray_x`, past the line too. Where the puck does
    not glide no other episode ends there, so without them a critic never learns what that costs.

    Source: Yin, Westenbroek et al., ICLR 2025, puck pushing.
    """

    name = "push"
    observation_names = ("tip_x", "tip_y", "puck_x", "puck_y")
    arm_joints = (0, 1, 3)  # commanded with control="joint"
    puck_dof = 6
    arm = Arm(rest=REST, tool_length=TOOL_LENGTH)

    def __init__(
        self,
        *,
        control: str,
        step_size: float,
        joint_step: float,
        episode_steps: int,
        control_dt: float,
        sim_dt: float,
        goal_x: float,
        tolerance: float,
        puck_x: tuple[float, float],
        puck_y: tuple[float, float],
        puck_mass: float,
        puck_friction: float,
        start_noise: float,
        stray_share: float = 0.0,
        stray_x: tuple[float, float] = (0.0, 0.7),
        edge_x: float = 0.75,
        origin: Sequence[float] = tuple(ORIGIN),
    ):
        if control not in ("cartesian", "joint"):
            raise ValueError(f"control={control!r}; allowed: cartesian, joint")
        whole_steps(control_dt, sim_dt)
        self.control, self.step_size, self.joint_step = control, step_size, joint_step
        self.action_dim, self.moves_in_plane = (2, True) if control == "cartesian" else (3, False)
        self.episode_steps, self.control_dt, self.sim_dt = episode_steps, control_dt, sim_dt
        self.goal_x, self.tolerance = goal_x, tolerance
        self.puck_x, self.puck_y, self.puck_mass, self.puck_friction = puck_x, puck_y, puck_mass, puck_friction
        self.start_noise, self.stray_share, self.stray_x = start_noise, stray_share, stray_x
        self.table_high = np.array([edge_x, TABLE_SIDE])
        self.origin = np.array(origin, float)
        self._home: Array | None = None

    def spec(self) -> mujoco.MjSpec:
        spec = fr3.arm_scene(self.sim_dt)
        world = spec.worldbody
        world.add_light(pos=[0.3, -0.6, 1.6], dir=[0, 0.35, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        world.add_camera(name="side", pos=[1.25, -1.05, 0.75], xyaxes=[0.68, 0.73, 0, -0.36, 0.33, 0.87])
        # The table is a plane: a box makes the puck's contacts slower and less stable. Its edges are drawn, and a puck
        # beyond them counts as fallen.
        world.add_geom(
            name="table",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[*(self.table_high - TABLE_LOW) / 2, 0.05],
            pos=[*(self.origin[:2] + (TABLE_LOW + self.table_high) / 2), self.origin[2]],
            rgba=[0.80, 0.74, 0.64, 1],
            contype=fr3.TABLE_BIT,
            conaffinity=0,
        )
        world.add_geom(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[self.tolerance, 0.4, 0.0005],
            pos=[self.origin[0] + self.goal_x, 0, self.origin[2] + 0.0005],
            rgba=[0.2, 0.65, 0.35, 0.6],
            contype=0,
            conaffinity=0,
        )
        fr3.add_fr3(spec, base=(0, 0, 0), tool_length=TOOL_LENGTH, tool_radius=TOOL_RADIUS)
        fr3.allow_delays(spec, NSAMPLE)
        self._add_puck(spec)
        return spec

    def _add_puck(self, spec: mujoco.MjSpec) -> None:
        puck = spec.worldbody.add_body(name="puck", pos=[0.5, 0, self.origin[2] + PUCK_HALF_HEIGHT])
        puck.add_freejoint(name="puck")
        puck.add_geom(
            name="puck",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[PUCK_RADIUS, PUCK_HALF_HEIGHT, 0],
            mass=self.puck_mass,
            friction=[self.puck_friction, 0.005, 0.0001],
            priority=1,
            rgba=[0.85, 0.25, 0.2, 1],
            contype=fr3.OBJECT_BIT,
            conaffinity=fr3.TABLE_BIT,
        )

    def home(self) -> Array:
        """Joint angles [1, 7] with the tip behind every puck start; computed once."""
        if self._home is None:
            q = REST[None]
            for x in np.linspace(0.2, -0.07, 30):
                q = kinematics.inverse(q, self._tip_target(np.array([[x, 0.0]])), REST, TOOL_LENGTH)
            self._home = q
        return self._home

    def start(self, rng: np.random.Generator) -> Start:
        xy = np.array([[-0.07, 0.0]]) + rng.uniform(-self.start_noise, self.start_noise, (1, 2))
        q = kinematics.inverse(self.home(), self._tip_target(xy), REST, TOOL_LENGTH)
        strays = self.stray_share > 0 and rng.uniform() < self.stray_share
        puck_x = self.stray_x if strays else self.puck_x
        puck = np.array([[rng.uniform(*puck_x), rng.uniform(*self.puck_y)]])
        puck = self._lying(puck, np.array([rng.uniform(-np.pi, np.pi)]))
        velocities = np.zeros((1, 7 + self.puck_dof))
        return Start(np.concatenate([q, puck], 1), velocities, xy if self.control == "cartesian" else q)

    def _lying(self, xy: Array, yaw: Array) -> Array:
        """Joint positions of a puck that lies on the table at a place [N, 2] m, turned by a yaw [N] rad."""
        turn = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)
        return np.concatenate([xy + self.origin[:2], np.full((len(xy), 1), self.origin[2] + PUCK_HALF_HEIGHT), turn], 1)

    def move(self, target: Array, action: Array) -> Array:
        if self.control == "cartesian":
            xy = np.clip(target + self.step_size * action, WORKSPACE_LOW, WORKSPACE_HIGH)
            from_base = xy + self.origin[:2]
            far = np.linalg.norm(from_base, axis=1, keepdims=True)
            return from_base * np.minimum(1.0, REACH / far) - self.origin[:2]
        moved = target.copy()
        moved[:, self.arm_joints] += self.joint_step * action
        moved = np.clip(moved, fr3.Q_MIN + 0.1, fr3.Q_MAX - 0.1)
        tip = kinematics.tip_position(moved, TOOL_LENGTH) - self.origin
        inside = ((tip[:, :2] >= WORKSPACE_LOW - 0.05) & (tip[:, :2] <= WORKSPACE_HIGH + 0.05)).all(1)
        return np.where((inside & (tip[:, 2] > 0.005) & (tip[:, 2] < 0.3))[:, None], moved, target)

    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        if self.control == "joint":
            return target
        return kinematics.inverse(previous_ctrl, self._tip_target(target), REST, TOOL_LENGTH)

    def hold(self, qpos: Array) -> Array:
        if self.control == "joint":
            return qpos[:, :7].copy()
        return kinematics.tip_position(qpos[:, :7], TOOL_LENGTH)[:, :2] - self.origin[:2]

    def place(self, observation: Array, qpos: Array) -> Array:
        """The puck lies flat where it is seen; its turn about the vertical is not observed and left at zero."""
        return np.concatenate([qpos[:, :7], self._lying(observation[:, 2:4], np.zeros(len(qpos)))], 1)

    def observe(self, qpos: Array, qvel: Array) -> Array:
        tip = kinematics.tip_position(qpos[:, :7], TOOL_LENGTH)
        return np.concatenate([tip[:, :2], self.place_of(qpos)[:, :2]], 1) - np.tile(self.origin[:2], 2)

    def reward(self, observation: Array, action: Array) -> Array:
        tip, puck = observation[:, :2], observation[:, 2:]
        behind = np.linalg.norm(tip - puck + [CONTACT, 0.0], axis=1)
        distance = np.abs(puck[:, 0] - self.goal_x)
        return -behind - distance + (distance < self.tolerance) - self.fell(observation)

    def fell(self, observation: Array) -> NDArray[np.bool_]:
        """Whether the puck's centre is beyond the table's edge, [N]."""
        puck = observation[:, 2:]
        return np.any((puck < TABLE_LOW) | (puck > self.table_high), axis=1)

    def success(self, observation: Array) -> NDArray[np.bool_]:
        return (np.abs(observation[:, 2] - self.goal_x) < self.tolerance) & ~self.fell(observation)

    def scripted(self, observation: Array) -> Array:
        """Line up behind the puck, then push along x, staying behind its centre (Cartesian control only)."""
        if self.control != "cartesian":
            raise ValueError("the scripted policy of push needs control='cartesian'")
        tip, puck = observation[:, :2], observation[:, 2:]
        aside, room = puck[:, 1] - tip[:, 1], puck[:, 0] - tip[:, 0]
        gap = np.maximum(room - CONTACT, 0)
        remaining = self.goal_x - puck[:, 0]
        advance = np.where(remaining < 0.02, 0.0, np.minimum(remaining, 0.035) + gap)
        lined_up = (np.abs(aside) < 0.012) & (room > 0)
        dx = np.where(lined_up, advance, np.where(room < 0.05, room - 0.055, 0.0))
        dy = np.where(gap < 0.005, 1.2, 1.0) * aside
        return np.clip(np.stack([dx, dy], 1) / self.step_size, -1, 1)

    def points(self, observation: Array) -> dict[str, Array]:
        def lift(xy: Array, height: float) -> Array:
            return np.concatenate([xy, np.full_like(xy[..., :1], height)], -1) + self.origin

        xy = observation[..., :4]
        return {"tool": lift(xy[..., :2], TOOL_HEIGHT), "object": lift(xy[..., 2:4], PUCK_HALF_HEIGHT)}

    def place_of(self, qpos: Array) -> Array:
        return qpos[:, 7:10]

    def view(self) -> View:
        return View(
            eye=(1.18, -0.76, 0.46),
            target=(0.385, 0.02, 0.025),
            second_eye=(0.43, 0.0, 0.42),
            second_target=(0.43, 0.0, -0.15),
            object_radius=PUCK_RADIUS,
            object_height=2 * PUCK_HALF_HEIGHT,
        )

    def value_plane(self, points: int) -> ValuePlane:
        """V over the tip's place on the table with the puck in the middle of its range (the paper's Figure 7)."""
        (x0, y0), (x1, y1) = WORKSPACE_LOW.tolist(), WORKSPACE_HIGH.tolist()
        puck = float(np.mean(self.puck_x)), float(np.mean(self.puck_y))
        x, y = np.meshgrid(np.linspace(x0, x1, points), np.linspace(y0, y1, points), indexing="ij")
        observation = np.stack([x.ravel(), y.ravel(), np.full(x.size, puck[0]), np.full(x.size, puck[1])], 1)
        axes = (("x", "m"), ("y", "m"))
        return ValuePlane(observation, (points, points), (x0, x1, y0, y1), axes, {"puck": puck})

    def _tip_target(self, xy: Array) -> Array:
        return np.concatenate([xy, np.full((len(xy), 1), TOOL_HEIGHT)], 1) + self.origin
