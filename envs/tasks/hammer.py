"""Drive a nail with an FR3 that holds a hammer: it gives way to blows, hardly to pressure."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs import fr3, kinematics
from envs.effects.passive import stiffen_dry_friction
from envs.fixture import add_fixture
from envs.task import AbstractTask, Array, Start, ValuePlane, View, whole_steps

HANDLE, FACE = 0.16, 0.03  # [m] from the hand to the head's axis, and from that down to its face
HEAD_RADIUS, HANDLE_RADIUS = 0.015, 0.01  # [m]
SWUNG = (1, 3, 5)  # joints that are commanded; the others hold the arm in a vertical plane
REST = np.array([0.0, -0.93, 0.0, -2.0, 0.0, 1.08, 0.0])  # [rad] the face on a nail in the middle of the range
LOW, HIGH = np.array([-1.5, -2.7, 0.65]), np.array([-0.2, -1.0, 1.9])  # [rad] of the commanded joints
NAIL_INERTIA = 0.3  # [kg] that a blow has to start, nail and wood
RAISED, CLOSE = 0.14, 0.02  # [m] of the face above the nail, before a blow and when it hit
NSAMPLE = 500  # physics steps of command history that the model holds, so that a delay is a parameter


class Hammer(AbstractTask):
    """Hammer a nail until its head is at the goal height.

    Observation: place of the hand x, y, z [m], angles [rad] and speeds [rad/s] of joints 2, 4 and 6, height of the
    nail's head, and its goal x and z [m], all in the frame of the base. Action: change of the three joints' targets.
    5 Hz, 50 steps.

        r = -10 (nail z - goal z)

    The nail stands upright in a board that holds it by dry friction, so that pressing moves it by some millimetres and
    no more, and each blow by a few. Success: its head is within `tolerance` of the goal when the episode ends. The
    scripted policy strikes at a point `aim` below the head.

    Source: Yin, Westenbroek et al., ICLR 2025, hammering. Friction, depth and the hammer's size are ours.
    """

    name = "hammer"
    observation_names = (
        *("hand_x", "hand_y", "hand_z", "angle_2", "angle_4", "angle_6", "speed_2", "speed_4", "speed_6"),
        *("nail_z", "goal_x", "goal_z"),
    )
    action_dim = 3

    def __init__(
        self,
        *,
        joint_step: float,
        episode_steps: int,
        control_dt: float,
        sim_dt: float,
        depth: float,
        tolerance: float,
        nail_x: tuple[float, float],
        nail_z: tuple[float, float],
        nail_friction: float,
        nail_damping: float,
        nail_head: tuple[float, float],
        hammer_mass: float,
        start_noise: float,
        aim: float,
    ):
        whole_steps(control_dt, sim_dt)
        self.joint_step, self.episode_steps = joint_step, episode_steps
        self.control_dt, self.sim_dt = control_dt, sim_dt
        self.depth, self.tolerance = depth, tolerance
        self.nail_x, self.nail_z = nail_x, nail_z
        self.nail_friction, self.nail_damping, self.nail_head = nail_friction, nail_damping, nail_head
        self.hammer_mass, self.start_noise, self.aim = hammer_mass, start_noise, aim

    def spec(self) -> mujoco.MjSpec:
        spec = fr3.arm_scene(self.sim_dt)
        spec.worldbody.add_light(pos=[0.3, -0.6, 1.8], dir=[0, 0.35, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        spec.worldbody.add_camera(name="side", pos=[0.9, -1.35, 0.95], xyaxes=[0.85, 0.53, 0, -0.13, 0.21, 0.97])
        self._add_hammer(fr3.add_fr3(spec, base=(0, 0, 0), tool_length=fr3.TCP, tool_radius=0.02))
        fr3.allow_delays(spec, NSAMPLE)
        self._add_nail(spec)
        return spec

    def _add_hammer(self, hand: mujoco.MjsBody) -> None:
        """A handle across the hand, pointing forward, and a head with its axis along the hand's."""
        hammer = hand.add_body(name="hammer", pos=[0, 0, fr3.FLANGE + fr3.TCP], gravcomp=1)
        cylinder, capsule = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE
        handle = hammer.add_geom(name="handle", type=capsule, size=[HANDLE_RADIUS, 0, 0], rgba=[0.55, 0.38, 0.2, 1])
        handle.fromto, handle.mass = [0, 0, 0, HANDLE, 0, 0], 0.3 * self.hammer_mass
        head = hammer.add_geom(name="head", type=cylinder, size=[HEAD_RADIUS, 0, 0], rgba=[0.3, 0.32, 0.35, 1])
        head.fromto, head.mass = [HANDLE, 0, -0.05, HANDLE, 0, FACE], 0.7 * self.hammer_mass
        handle.contype = handle.conaffinity = head.conaffinity = 0
        head.contype = fr3.OBJECT_BIT

    def _add_nail(self, spec: mujoco.MjSpec) -> None:
        """A nail on a slide, in a board."""
        slide, cylinder = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtGeom.mjGEOM_CYLINDER
        board = add_fixture(spec, "board", "x z")
        board.add_geom(
            name="board",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.07, 0.07, 0.015],
            pos=[0, 0, -self.depth - 0.02],
            mass=1,
            rgba=[0.80, 0.68, 0.5, 1],
            contype=0,
            conaffinity=0,
        )
        nail = board.add_body(name="nail", gravcomp=1)
        joint = nail.add_joint(name="nail", type=slide, axis=[0, 0, 1], range=[-self.depth, 0], limited=1)
        joint.solref_limit[:] = [2 * self.sim_dt, 1.0]  # then its head lies on the board
        joint.armature, joint.frictionloss = NAIL_INERTIA, self.nail_friction
        joint.damping[0] = self.nail_damping
        stiffen_dry_friction(joint)
        joint.solimp_friction[:2] = 0.9999
        radius, thickness = self.nail_head
        head = nail.add_geom(name="nail", type=cylinder, size=[radius, thickness / 2, 0], pos=[0, 0, -thickness / 2])
        shaft = nail.add_geom(name="shaft", type=cylinder, size=[0.005, 0.02, 0], pos=[0, 0, -0.02 - thickness])
        head.mass = shaft.mass = 0.01
        head.rgba = shaft.rgba = [0.72, 0.74, 0.78, 1]
        head.contype = shaft.contype = shaft.conaffinity = 0
        head.conaffinity = fr3.OBJECT_BIT
        head.solref, head.friction, head.priority = [2 * self.sim_dt, 1.0], [0.6, 0.005, 0.0001], 1

    def start(self, rng: np.random.Generator) -> Start:
        x, z = rng.uniform(*self.nail_x), rng.uniform(*self.nail_z)
        q = self._raised(np.array([[x, z]]))
        q = np.clip(q + rng.uniform(-self.start_noise, self.start_noise, q.shape), LOW, HIGH)
        qpos = np.concatenate([self._arm(q)[0], [x, z, 0.0]])[None]
        return Start(qpos=qpos, qvel=np.zeros((1, 10)), target=q)

    def move(self, target: Array, action: Array) -> Array:
        return np.clip(target + self.joint_step * action, LOW, HIGH)

    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        return self._arm(target)

    def hold(self, qpos: Array) -> Array:
        return qpos[:, SWUNG].copy()

    def place(self, observation: Array, qpos: Array) -> Array:
        """The board where the goal tells that it is, the nail at the height where it is seen."""
        placed = qpos.copy()
        placed[:, 7] = observation[:, 10]
        placed[:, 8] = observation[:, 11] + self.depth
        placed[:, 9] = observation[:, 9] - placed[:, 8]
        return placed

    def observe(self, qpos: Array, qvel: Array) -> Array:
        hand = kinematics.tip_position(qpos[:, :7], fr3.TCP)
        board_x, board_z, nail = qpos[:, 7:8], qpos[:, 8:9], qpos[:, 9:10]
        return np.concatenate([hand, qpos[:, SWUNG], qvel[:, SWUNG], board_z + nail, board_x, board_z - self.depth], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        return -10 * (observation[:, 9] - observation[:, 11])

    def success(self, observation: Array) -> NDArray[np.bool_]:
        return np.abs(observation[:, 9] - observation[:, 11]) < self.tolerance

    def scripted(self, observation: Array) -> Array:
        """Raise the hammer above the nail, strike through it, and raise it again."""
        q, speed, nail = observation[:, 3:6], observation[:, 6:9], observation[:, [10, 9]]
        face = self._face(q)
        above, falls = face[:, 1] - nail[:, 1], self._face(q + 0.01 * speed)[:, 1] < face[:, 1] - 1e-3
        strikes = (above > 0.8 * RAISED) | (falls & (above > CLOSE))
        raised = self._raised(nail)
        struck = self._reach(raised, nail - [0.0, self.aim])
        wanted = np.where((strikes & ~self.success(observation))[:, None], struck, raised) - q
        return wanted / np.maximum(np.abs(wanted).max(1, keepdims=True), self.joint_step)

    def points(self, observation: Array) -> dict[str, Array]:
        def in_plane(xz: Array) -> Array:
            return np.stack([xz[..., 0], 0 * xz[..., 0], xz[..., 1]], -1)

        q = observation[..., 3:6]
        face = self._face(q.reshape(-1, 3)).reshape(*q.shape[:-1], 2)
        return {"tool": in_plane(face), "object": in_plane(observation[..., [10, 9]])}

    def place_of(self, qpos: Array) -> Array:
        return np.stack([qpos[:, 7], 0 * qpos[:, 7], qpos[:, 8] + qpos[:, 9]], 1)

    def view(self) -> View:
        return View(
            eye=(0.95, -1.0, 0.9),
            target=(0.22, 0.0, 0.58),
            second_eye=(0.35, -0.7, 0.65),
            second_target=(0.35, 0.0, 0.65),
            object_radius=self.nail_head[0],
            object_height=0.005,
        )

    def value_plane(self, points: int) -> ValuePlane:
        """V over the angles of joints 4 and 6, at rest over a nail in the middle of its range."""
        q4, q6 = np.meshgrid(np.linspace(LOW[1], HIGH[1], points), np.linspace(LOW[2], HIGH[2], points), indexing="ij")
        q = np.stack([np.full(q4.size, REST[1]), q4.ravel(), q6.ravel()], 1)
        x, z = float(np.mean(self.nail_x)), float(np.mean(self.nail_z))
        scene = np.concatenate([self._arm(q), np.tile([x, z, 0.0], (len(q), 1))], 1)
        observation = self.observe(scene, np.zeros((len(q), 10)))
        extent = (LOW[1], HIGH[1], LOW[2], HIGH[2])
        raised = self._raised(np.array([[x, z]]))[0].tolist()
        axes = (("joint 4", "rad"), ("joint 6", "rad"))
        return ValuePlane(observation, (points, points), extent, axes, {"raised": (raised[1], raised[2])})

    def _arm(self, q: Array) -> Array:
        """All joints [N, 7] for the commanded ones [N, 3]."""
        full = np.tile(REST, (len(q), 1))
        full[:, SWUNG] = q
        return full

    def _face(self, q: Array) -> Array:
        """x and z of the middle of the hammer's face, [N, 2] m, for the commanded joints [N, 3]."""
        _, axes, hand = kinematics.chain(self._arm(q), fr3.TCP)
        down = axes[:, -1][:, [0, 2]]
        forward = np.stack([-down[:, 1], down[:, 0]], 1)
        return hand[:, [0, 2]] + HANDLE * forward + FACE * down

    def _reach(self, q: Array, goal: Array, upright: float = 0.0) -> Array:
        """Joints [N, 3] near q that bring the face to x and z [N, 2], the hand upright by a weight [m/rad]."""

        def told(q: Array) -> Array:
            return np.concatenate([self._face(q), upright * (q[:, :1] - q[:, 1:2] - q[:, 2:])], 1)

        wanted = np.concatenate([goal, np.zeros((len(goal), 1))], 1)
        for _ in range(20):
            now = told(q)
            slopes = np.stack([(told(q + step) - now) / 1e-4 for step in 1e-4 * np.eye(3)], 2)  # [N, 3, 3]
            square = slopes.transpose(0, 2, 1) @ slopes + 4e-4 * np.eye(3)
            q = q + np.linalg.solve(square, slopes.transpose(0, 2, 1) @ (wanted - now)[..., None])[..., 0]
        return np.clip(q, LOW, HIGH)

    def _raised(self, nail: Array) -> Array:
        """Joints [N, 3] with the hammer ready to strike a nail whose head is at x and z [N, 2]."""
        on_it = self._reach(np.tile(REST[list(SWUNG)], (len(nail), 1)), nail, upright=0.15)
        return self._reach(on_it, nail + [0.0, RAISED])
