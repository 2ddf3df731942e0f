"""Lower a peg that hangs on a rope into a hole, with an FR3."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs import fr3, kinematics
from envs.fixture import add_table_with_hole
from envs.task import Array, Start, ValuePlane, View, whole_steps
from envs.tasks.over_table import NSAMPLE, TOP, OverTable

BEADS = 4  # point masses along the rope
BEAD_MASS = 0.005  # [kg]
STIFF = [0.9999, 0.9999]  # impedances of a taut string: with MuJoCo's own, light beads let it stretch by a sixth
START = 0.34  # [m] of the hand above the table, at the start; twice the rope fits below
LOW, HIGH = np.array([0.35, -0.15, TOP + 0.03]), np.array([0.65, 0.15, TOP + 0.45])  # [m] where the hand may go
CLEAR = 0.02  # [m] that the scripted policy keeps the peg above the table until it is over the hole


class RopePegInHole(OverTable):
    """Lower the peg until its middle is `depth` below the table.

    The rope is a chain of point masses, each tied to the next by a string that can be slack and not stretched: the peg
    swings, and is pulled and never pushed.

    Observation: place of the hand, of the peg's middle, and where that has to be, x, y, z each [m], in the frame of the
    base. Action: change of the commanded place of the hand. 5 Hz, 60 steps.

        r = 1[the peg is in the hole] - 5 |peg - goal|

    Success: the peg is in the hole when the episode ends.

    Source: rope peg-in-hole of Du et al. 2021 (arXiv:2104.07662), as its public code has it: a rope of 12 cm, a peg of
    3 by 4 cm, a hole 5 cm wide, 60 decisions, the distance as the reward. There a single string holds a peg that cannot
    turn, the robot is an xArm that moves 2.5 cm at a time, and images are observed.
    """

    name = "rope_peg_in_hole"
    observation_names = tuple(f"{what}_{axis}" for what in ("hand", "peg", "hole") for axis in "xyz")
    tool_length, above, low, high = fr3.TCP, START, LOW, HIGH

    def __init__(
        self,
        *,
        step_size: float,
        episode_steps: int,
        control_dt: float,
        sim_dt: float,
        hole_x: tuple[float, float],
        hole_y: tuple[float, float],
        rope_length: float,
        peg_radius: float,
        peg_half_height: float,
        peg_mass: float,
        hole_radius: float,
        depth: float,
        drag: float,
        start_noise: float,
    ):
        whole_steps(control_dt, sim_dt)
        self.step_size, self.episode_steps = step_size, episode_steps
        self.control_dt, self.sim_dt = control_dt, sim_dt
        self.hole_x, self.hole_y, self.start_noise = hole_x, hole_y, start_noise
        self.rope_length, self.drag = rope_length, drag
        self.peg_radius, self.peg_half_height, self.peg_mass = peg_radius, peg_half_height, peg_mass
        self.hole_radius, self.depth = hole_radius, depth
        self.goal_z = TOP - depth

    def spec(self) -> mujoco.MjSpec:
        spec, _ = self.scene()
        for i in range(BEADS):
            bead = spec.worldbody.add_body(name=f"bead{i}")
            for axis, direction in zip("xyz", np.eye(3), strict=True):
                bead.add_joint(name=f"bead{i}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=list(direction))
            bead.add_site(name=f"bead{i}", size=[0.002, 0, 0], rgba=[0, 0, 0, 0])
            bead.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[0.003, 0, 0],
                mass=BEAD_MASS,
                rgba=[0.35, 0.26, 0.16, 1],
                contype=0,
                conaffinity=0,
            )
        self._add_peg(spec)
        ties = ["tip", *(f"bead{i}" for i in range(BEADS)), "peg_top"]
        for i, (upper, lower) in enumerate(zip(ties[:-1], ties[1:], strict=True)):
            string = spec.add_tendon(name=f"rope{i}", width=0.002, rgba=[0.35, 0.26, 0.16, 1])
            string.wrap_site(upper)
            string.wrap_site(lower)
            string.limited, string.range = 1, [0.0, self.rope_length / len(ties[1:])]
            string.solref_limit[:], string.solimp_limit[:2] = [2 * self.sim_dt, 1.0], STIFF
        fr3.allow_delays(spec, NSAMPLE)
        add_table_with_hole(spec, radius=self.hole_radius, floor=self.goal_z - self.peg_half_height - 0.01, top=TOP)
        return spec

    def _add_peg(self, spec: mujoco.MjSpec) -> None:
        peg = spec.worldbody.add_body(name="peg")
        free = peg.add_freejoint(name="peg")
        free.damping[0] = self.drag
        peg.add_site(name="peg_top", pos=[0, 0, self.peg_half_height], size=[0.002, 0, 0], rgba=[0, 0, 0, 0])
        peg.add_geom(
            name="peg",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.peg_radius, self.peg_half_height, 0],
            mass=self.peg_mass,
            friction=[0.3, 0.005, 0.0001],
            priority=1,
            rgba=[0.72, 0.52, 0.3, 1],
            contype=fr3.OBJECT_BIT,
            conaffinity=0,
        )

    def start(self, rng: np.random.Generator) -> Start:
        place, q = self.first(rng)
        hand = kinematics.tip_position(q, fr3.TCP)[0]
        down = np.array([0.0, 0.0, -1.0])
        beads = [hand + down * self.rope_length * (i + 1) / (BEADS + 1) for i in range(BEADS)]
        peg = hand + down * (self.rope_length + self.peg_half_height)
        hole = [rng.uniform(*self.hole_x), rng.uniform(*self.hole_y), 0.0]
        qpos = np.concatenate([q[0], *beads, peg, [1.0, 0.0, 0.0, 0.0], hole])
        return Start(qpos=qpos[None], qvel=np.zeros((1, len(qpos) - 1)), target=place)

    def place(self, observation: Array, qpos: Array) -> Array:
        """The table where its hole is seen and the peg where it is seen, upright; the rope is left as it is."""
        placed = qpos.copy()
        peg = 7 + 3 * BEADS
        placed[:, peg : peg + 7] = np.concatenate([observation[:, 3:6], np.tile([1.0, 0, 0, 0], (len(qpos), 1))], 1)
        placed[:, peg + 7 : peg + 9] = observation[:, 6:8]
        return placed

    def observe(self, qpos: Array, qvel: Array) -> Array:
        hand, peg = kinematics.tip_position(qpos[:, :7], fr3.TCP), 7 + 3 * BEADS
        goal = np.full((len(qpos), 1), self.goal_z)
        return np.concatenate([hand, qpos[:, peg : peg + 3], qpos[:, peg + 7 : peg + 9], goal], 1)

    def reward(self, observation: Array, action: Array) -> Array:
        apart = observation[:, 3:6] - observation[:, 6:9]
        return self.success(observation) - 5 * np.linalg.norm(apart, axis=1)

    def success(self, observation: Array) -> NDArray[np.bool_]:
        aside = np.linalg.norm(observation[:, 3:5] - observation[:, 6:8], axis=1)
        return (aside < self.hole_radius) & (np.abs(observation[:, 5] - observation[:, 8]) < self.peg_half_height)

    def scripted(self, observation: Array) -> Array:
        """Stand with the peg close above the hole, and go down while it hangs over it."""
        hand, peg, goal = observation[:, :3], observation[:, 3:6], observation[:, 6:9]
        aside, swing = (np.linalg.norm((x - y)[:, :2], axis=1) for x, y in ((peg, goal), (peg, hand)))
        inside = peg[:, 2] - self.peg_half_height < TOP
        free = self.hole_radius - self.peg_radius
        hover = TOP + CLEAR + self.peg_half_height
        down = inside | (aside < 0.7 * free) & (swing < free) & (peg[:, 2] < hover + 0.01)
        dz = np.where(down, goal[:, 2], hover) - peg[:, 2]
        across = 0.25 * (goal - hand)[:, :2]
        return np.clip(np.concatenate([across, dz[:, None]], 1) / self.step_size, -1, 1)

    def points(self, observation: Array) -> dict[str, Array]:
        return {"tool": observation[..., :3], "object": observation[..., 3:6]}

    def place_of(self, qpos: Array) -> Array:
        return qpos[:, 7 + 3 * BEADS :][:, :3]

    def view(self) -> View:
        return View(
            eye=(1.2, -0.8, 0.6),
            target=(0.4, 0.0, 0.3),
            second_eye=(0.5, -0.6, 0.3),
            second_target=(0.5, 0.0, 0.25),
            object_radius=self.peg_radius,
            object_height=2 * self.peg_half_height,
        )

    def value_plane(self, points: int) -> ValuePlane:
        """V over x and height of a peg that hangs still, in the plane through a hole in the middle of its range."""
        low, high = self.goal_z, TOP + START - self.rope_length
        x, z = np.meshgrid(np.linspace(LOW[0], HIGH[0], points), np.linspace(low, high, points), indexing="ij")
        middle = float(np.mean(self.hole_x)), float(np.mean(self.hole_y))
        peg = np.stack([x.ravel(), np.full(x.size, middle[1]), z.ravel()], 1)
        hole = np.tile([*middle, self.goal_z], (x.size, 1))
        observation = np.concatenate([peg + [0, 0, self.rope_length + self.peg_half_height], peg, hole], 1)
        extent = (LOW[0], HIGH[0], low, high)
        return ValuePlane(observation, (points, points), extent, (("x", "m"), ("z", "m")), {"hole": (middle[0], TOP)})
