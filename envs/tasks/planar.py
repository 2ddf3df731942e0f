"""Machines that move in a vertical plane: links of capsules on a torso, a torque at each joint, a floor.

All angles are about y: a link that leans forward has a positive one, a leg that swings forward a negative one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs import fr3
from envs.task import AbstractTask, Array, Start, ValuePlane, View, whole_steps

NSAMPLE = 100  # physics steps of command history that the model holds, so that a delay is a parameter
ROOT = ("x", "z", "pitch")  # joints of the torso
Pair = tuple[float, float]


class Link(NamedTuple):
    """A body and the hinge that carries it. Lengths are along x and z, its own in the frame of its hinge.

    Attributes:
        name: Of the body, its geoms, its joint and its motor.
        parent: The link that it hangs on; empty for the torso.
        place: Of the hinge in the parent's frame, of the torso in the world's, [m].
        bones: Capsules, each from, to and radius, [m].
        range: Of the joint, [rad].
        torque: Largest one of the motor, [N m].
        stiffness: Of the joint's spring, [N m/rad].
        damping: Of the joint, [N m s/rad].
        aside: Along y, [m].
    """

    name: str
    parent: str
    place: Pair
    bones: tuple[tuple[Pair, Pair, float], ...]
    range: Pair = (0.0, 0.0)
    torque: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    aside: float = 0.0


def volume(links: Sequence[Link]) -> float:
    """Of all capsules, [m^3]."""
    bones = [bone for link in links for bone in link.bones]
    return sum(np.pi * r**2 * (np.hypot(*np.subtract(end, start)) + 4 / 3 * r) for start, end, r in bones)


def turned(angle: Array, along: Pair | Array) -> Array:
    """A vector (x, z) turned about y by angles [...], [..., 2]."""
    x, z = along
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([x * cos + z * sin, z * cos - x * sin], -1)


class PlanarTask(AbstractTask):
    """Move forward on a floor, which goes on for ever.

    A task says its links, torso first, parents before children, what is observed, what is rewarded, and a scripted
    policy. The action is the torque of each motor as a share of its largest one.

    An episode starts standing, joints off by up to `start_noise`; an `anywhere_share` of the episodes starts in any
    posture, also upside down. All are put on the floor by their lowest point, and no episode ends early.

    Success: the state is worth a reward of `enough` when the episode ends.

    Attributes:
        links: Of the machine.
        armature: Rotor inertia of each joint, [kg m^2].
        density: [kg/m^3]
        solimp: Of the joint limits, first three numbers; empty for MuJoCo's own.
        touches_itself: Whether links touch each other, not only the floor.
        goal: Speed at which the reward is full, [m/s].
    """

    links: tuple[Link, ...]
    armature: float
    density: float
    solimp: tuple[float, ...] = ()
    touches_itself: bool = False
    goal: float

    def __init__(
        self,
        *,
        episode_steps: int,
        control_dt: float,
        sim_dt: float,
        friction: float,
        start_noise: float,
        enough: float,
        anywhere_share: float,
    ):
        whole_steps(control_dt, sim_dt)
        self.episode_steps, self.control_dt, self.sim_dt = episode_steps, control_dt, sim_dt
        self.friction, self.start_noise, self.enough = friction, start_noise, enough
        self.anywhere_share = anywhere_share
        names = [link.name for link in self.links]
        self.action_dim = len(self.links) - 1
        self.torque = np.array([link.torque for link in self.links[1:]])
        self.parents = [names.index(link.parent) for link in self.links[1:]]
        self.chain = np.eye(len(names))  # which joints turn a link; of the torso, its pitch
        for i, parent in enumerate(self.parents, 1):
            self.chain[i] += self.chain[parent]
        model = self.spec().compile()
        bodies = [model.body(name).id for name in names]
        self.levers = model.body_mass[bodies, None] * model.body_ipos[bodies][:, [0, 2]]  # [links, 2] kg m
        for body, parent in zip(bodies[1:], self.parents, strict=True):
            self.levers[parent] += model.body_subtreemass[body] * model.body_pos[body, [0, 2]]
        self.levers /= model.body_subtreemass[bodies[0]]

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.timestep = self.sim_dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._add_floor(spec)
        bodies = {"": spec.worldbody}
        for link in self.links:
            place = [link.place[0], link.aside, link.place[1]]
            bodies[link.name] = body = bodies[link.parent].add_body(name=link.name, pos=place)
            self._add_bones(body, link)
            if link.parent:
                self._add_joint(spec, body, link)
                continue
            slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
            for name, kind, axis in zip(ROOT, (slide, slide, hinge), np.eye(3)[[0, 2, 1]], strict=True):
                body.add_joint(name=name, type=kind, axis=axis)
            follows = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
            body.add_camera(name="side", pos=[0, -3.5, 0.3], xyaxes=[1, 0, 0, 0, 0.1, 1], mode=follows)
        fr3.allow_delays(spec, NSAMPLE)
        return spec

    def _add_floor(self, spec: mujoco.MjSpec) -> None:
        """Its friction decides in each of its contacts."""
        spec.worldbody.add_light(pos=[0, -2, 6], dir=[0, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        tiles = spec.add_texture(name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, width=64, height=64)
        tiles.builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
        tiles.rgb1, tiles.rgb2 = [0.28, 0.31, 0.35], [0.36, 0.39, 0.43]
        material = spec.add_material(name="tiles", texrepeat=[1, 1], texuniform=1)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, pos=[45, 0, 0])
        floor.size, floor.material = [50, 2, 0.1], "tiles"  # [m] as drawn
        floor.friction, floor.priority = [self.friction, 0.1, 0.1], 1

    def _add_bones(self, body: mujoco.MjsBody, link: Link) -> None:
        for i, (start, end, radius) in enumerate(link.bones):
            bone = body.add_geom(name=link.name + i * "_2", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0])
            bone.fromto = [start[0], 0, start[1], end[0], 0, end[1]]
            bone.density, bone.conaffinity = self.density, int(self.touches_itself)
            bone.friction, bone.rgba = [0.4, 0.1, 0.1], [0.75, 0.55, 0.3, 1]

    def _add_joint(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, link: Link) -> None:
        joint = body.add_joint(name=link.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], limited=1)
        joint.range, joint.armature = link.range, self.armature
        joint.stiffness[0], joint.damping[0] = link.stiffness, link.damping
        joint.solimp_limit[: len(self.solimp)] = self.solimp
        motor = spec.add_actuator(name=link.name, target=link.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=1)
        motor.set_to_motor()
        motor.ctrlrange = [-link.torque, link.torque]

    def start(self, rng: np.random.Generator) -> Start:
        low, high = np.array([link.range for link in self.links[1:]]).T
        qpos = np.zeros((1, 3 + self.action_dim))
        if rng.uniform() < self.anywhere_share:
            qpos[0, 2:] = rng.uniform([-np.pi, *low], [np.pi, *high])
        else:
            qpos[0, 2:] = rng.uniform(-self.start_noise, self.start_noise, 1 + self.action_dim)
            qpos[0, 3:] = np.clip(qpos[0, 3:], low, high)
        qpos[:, 1] = -self.lowest(qpos)
        return Start(qpos, np.zeros_like(qpos), np.zeros((1, self.action_dim)))

    def move(self, target: Array, action: Array) -> Array:
        return self.torque * action

    def ctrl(self, target: Array, previous_ctrl: Array) -> Array:
        return target

    def hold(self, qpos: Array) -> Array:
        return np.zeros((len(qpos), self.action_dim))  # torques: none

    def lowest(self, qpos: Array) -> Array:
        """Height of the lowest point above the floor, [N] m."""
        angle = qpos[:, 2:] @ self.chain.T  # [N, links]
        hinges = [np.array(self.links[0].place) + qpos[:, :2]]
        for link, parent in zip(self.links[1:], self.parents, strict=True):
            hinges.append(hinges[parent] + turned(angle[:, parent], link.place))
        ends = [
            hinges[i][:, 1] + turned(angle[:, i], end)[:, 1] - radius
            for i, link in enumerate(self.links)
            for *both, radius in link.bones
            for end in both
        ]
        return np.min(ends, 0)

    def forward(self, angle: Array, speeds: Array) -> Array:
        """Speed of the whole machine's centre of mass along x, [N] m/s.

            v = v_torso + Σ_links w (l_z cos θ - l_x sin θ)

        with the angle θ and angular velocity w of a link, and its lever l: the centre of mass is the torso's place plus
        all levers, each turned with its link. The masses are the nominal ones.

        Args:
            angle: θ of each link against the upright, [N, links] rad.
            speeds: Of the joints, those of the torso first, [N, nv].
        """
        turns = speeds[:, 2:] @ self.chain.T
        return speeds[:, 0] + (turns * turned(angle, self.levers.T)[..., 1]).sum(1)

    def success(self, observation: Array) -> NDArray[np.bool_]:
        return self.reward(observation, np.zeros((len(observation), self.action_dim))) >= self.enough

    def at_origin(self, height: Array) -> Array:
        """A point that is drawn at x = 0, because how far the machine has come is not observed, [..., 3] m."""
        return np.stack([0 * height, 0 * height, height], -1)

    def value_plane(self, points: int) -> ValuePlane:
        """V over the lean and the speed of the standing machine."""
        extent = (-1.5, 1.5, 0.0, 1.5 * self.goal)
        lean, speed = np.meshgrid(np.linspace(*extent[:2], points), np.linspace(*extent[2:], points), indexing="ij")
        qpos, qvel = np.zeros((2, lean.size, 3 + self.action_dim))
        qpos[:, 2], qvel[:, 0] = lean.ravel(), speed.ravel()
        qpos[:, 1] = -self.lowest(qpos)
        axes = (("lean", "rad"), ("speed", "m/s"))
        return ValuePlane(self.observe(qpos, qvel), (points, points), extent, axes, {"goal": (0.0, self.goal)})

    def view(self) -> View:
        return View(eye=(4.0, -9.0, 2.2), target=(4.0, 0.0, 0.8), second_eye=(0.0, -4.0, 1.2), second_target=(0, 0, 1))
