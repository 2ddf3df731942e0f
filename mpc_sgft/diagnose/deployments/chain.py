"""The whole chain of a deployment as least squares: commands to drive, drive to motion, motion to observations.

Each link is driven by what was measured at its beginning, so an error in one does not hide another, and an effect
shows where it acts. Each link has the same weight. What a window can tell at all is asked of the simulator: objects
that start half a millimetre aside, turned, or in finer time steps, must not be told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from envs.effects.base import Effect
from envs.effects.contact_friction import ContactFriction
from envs.task import AbstractTask
from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.data.smooth import noise_of
from mpc_sgft.diagnose.deployments.command_link import ServoCommands, measured_drive, saturated
from mpc_sgft.diagnose.deployments.motion_link import JOINT_SAMPLES, Motion, StepWindows, acts_on_command, at_times
from mpc_sgft.diagnose.deployments.recordings import Deployment, joint_columns

RESOLUTION = 1e-4  # [m] of an observed position, beside its noise
JOINT_RESOLUTION = 2e-5  # [rad] of a joint position simulated under a measured drive, beside noise
DRIVE_SHARE = 0.003  # of the commands' spread: how well the first command is known
TURN = 0.5  # [rad] of an object about the vertical, which is not observed
REST = 1e-3  # [m] between two observations
PLAUSIBLE = (1.0, 0.25, 2.0)  # times the object's own friction: pushing is unstable, how much depends on it
BEND = 4.0  # residuals beyond this many standard deviations count by their size, not its square
SIGMA = 1.4826  # standard deviations in a median absolute deviation
QUARTER = 0.3186  # lower quartile of |x| of a standard normal


class Prediction(NamedTuple):
    """What K models predict; J is JOINT_SAMPLES.

    Attributes:
        drive: Change of control, [K, W, n J, nu]; as measured where a servo gave all the force that it can.
        joints: Error of the joints, [K, W, n J, nj].
        observation: At the end of each control step, [K, W, n, O].
    """

    drive: Array
    joints: Array
    observation: Array


class Chain:
    """Residuals of sets of effects over windows of a deployment; a `Residuals` for `fit`.

    Args:
        deployment: Task and episodes.
        length: Control steps in a window.
        most: Windows at most; those in which objects move come first, and no more of the others than of these.
    """

    step, pattern = 0.1, (1.0, 0.3, 0.1, 0.03)  # contacts make residuals rugged

    def __init__(self, deployment: Deployment, length: int, most: int):
        task, self.episodes = deployment.task, deployment.episodes
        self.task = task
        model = task.spec().compile()
        measured = [measured_drive(model, e) for e in self.episodes]
        self.noise = observation_noise(deployment)  # [O]
        rest = max(REST, 4 * float(self.noise.max()))
        self.motion = Motion(deployment, measured, length, rest)
        self.commands = ServoCommands(task, self.episodes)
        self._choose(most, rest)
        self.blocks = length
        w = self.windows
        pairs = list(zip(w.episode, w.start, strict=True))
        within = task.control_dt / JOINT_SAMPLES * np.arange(length * JOINT_SAMPLES + 1)
        since = task.control_dt * w.start[:, None] + within  # the episode's start
        self.times = task.sim_dt * np.round(since / task.sim_dt)  # [W, 1 + n JOINT_SAMPLES], ends of physics steps
        told = [at_times(self.episodes[i].time, measured[i], t) for i, t in zip(w.episode, self.times, strict=True)]
        self.drive = changes_since_start(np.stack(told))
        spent = [saturated(model, e).astype(float) for e in self.episodes]
        at_limit = np.stack(
            [at_times(self.episodes[i].time, spent[i], t) for i, t in zip(w.episode, self.times, strict=True)]
        )
        self.untold = at_limit[:, 1:] + at_limit[:, :1] > 0  # of `drive`, by a servo that gave all it can
        self.observed = np.stack([self.episodes[i].observation[s + 1 : s + 1 + length] for i, s in pairs])
        self._cache: dict[tuple[object, ...], tuple[Array, ...]] = {}
        self._scales(deployment, measured, rest)
        actuators = [model.actuator(i).name for i in range(model.nu)]
        joints = [model.joint(int(j)).name for j in np.flatnonzero(np.isin(model.jnt_qposadr, self.motion.qadr))]
        self.groups = {
            "observation": [f"observation/{n}" for n in task.observation_names],
            "drive": [f"drive/{n}" for n in actuators],
            "qpos": [f"qpos/{n}" for n in joints],
        }

    @property
    def windows(self) -> StepWindows:
        """The windows that are compared."""
        return self.motion.windows

    def predict(self, changes: Sequence[tuple[Effect, ...]], pick: Index) -> Prediction:
        """What sets of effects predict; results of a link are kept for sets that do not differ in it."""
        drive = np.where(self.untold[pick], self.drive[pick], self._drive(changes)[:, pick])
        moved = [self._motion(e, pick) for e in changes]
        joints, observation = (np.stack(parts) for parts in zip(*moved, strict=True))
        return Prediction(drive, joints, observation)

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[Array]], pick: Index) -> Array:
        """As `Residuals.residuals`: bent beyond BEND, observation, drive and joints one after the other."""
        return self.joined(self.predict([effects_of(terms, p) for p in points], pick), pick)

    def joined(self, y: Prediction, pick: Index) -> Array:
        """Residuals of predictions, each link with the same weight, [K, W, m]."""
        parts = self.whitened(y, pick)
        m = sum(p.shape[2] for p in parts)
        return np.concatenate([p * np.sqrt(m / (len(parts) * p.shape[2])) for p in parts], 2)

    def whitened(self, y: Prediction, pick: Index) -> list[Array]:
        """Bent residuals of each link, [K, W, m_i]."""
        raw = [
            (y.observation - self.observed[pick]) / self.observation_scale[pick],
            (y.drive - self.drive[pick]) / self.drive_scale,
            y.joints / self.joint_scale[pick],
        ]
        return [_bend(r).reshape(*r.shape[:2], -1) for r in raw]

    def _drive(self, changes: Sequence[tuple[Effect, ...]]) -> Array:
        """Control at the servos at the compared times, since the window's start, [K, W, n JOINT_SAMPLES, nu]."""
        keys = [("drive", tuple(e for e in effects if acts_on_command(e))) for effects in changes]
        new = list(dict.fromkeys(k for k in keys if k not in self._cache))
        rows = np.round(self.times / self.task.sim_dt).astype(int) - 1
        found = {k: self._cache[k][0] for k in keys if k in self._cache}
        if new:
            every = self.commands.drive([effects for _, effects in new])
            found |= {
                k: changes_since_start(u[self.windows.episode[:, None], rows]) for k, u in zip(new, every, strict=True)
            }
        for k in new:
            self._keep(k, (found[k],))
        return np.stack([found[k] for k in keys])

    def _motion(self, effects: tuple[Effect, ...], pick: Index) -> tuple[Array, Array]:
        mine = tuple(e for e in effects if not acts_on_command(e))
        key = ("motion", mine, pick.tobytes())
        if key not in self._cache:
            out = self.motion.simulate([mine], pick)
            self._keep(key, (out.joints[0], out.observation[0]))
        joints, observation = self._cache[key]
        return joints, observation

    def _keep(self, key: tuple[object, ...], value: tuple[Array, ...]) -> None:
        if len(self._cache) > 200:
            self._cache.clear()
        self._cache[key] = value

    def _choose(self, most: int, rest: float) -> None:
        """Keep at most so many windows: first those in which an object was seen to move, then others, spread out."""
        w = self.motion.windows
        seen = [self.episodes[i].observation[s : s + w.samples + 1] for i, s in zip(w.episode, w.start, strict=True)]
        places = [self.motion.placed(i, o)[:, self.motion.objects] for i, o in zip(w.episode, seen, strict=True)]
        self.moving = np.array([bool(p.size) and float(np.ptp(p, axis=0).max()) > rest for p in places])
        order = np.flatnonzero(self.moving), np.flatnonzero(~self.moving)
        spare = min(max(most - len(order[0]), most // 4), len(order[1]), max(len(order[0]), most // 4))
        first = order[0][np.unique(np.linspace(0, len(order[0]) - 1, min(len(order[0]), most - spare)).astype(int))]
        then = order[1][np.unique(np.linspace(0, len(order[1]) - 1, spare).astype(int))]
        keep = np.sort(np.concatenate([first, then]).astype(int))
        self.motion.windows = w._replace(episode=w.episode[keep], start=w.start[keep])
        self.moving = self.moving[keep]

    def _scales(self, deployment: Deployment, measured: Sequence[Array], rest: float) -> None:
        """Standard deviation of every compared number if the model is right."""
        w, m = self.windows, self.motion
        nudges = np.zeros((4, m.model.nq))
        aside = np.hypot(RESOLUTION, self.noise.max())
        kinds, address = m.model.jnt_type, m.model.jnt_qposadr
        first = address[kinds == int(mujoco.mjtJoint.mjJNT_FREE)]  # where each free joint begins in qpos
        slides = np.intersect1d(address[kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)], m.objects)
        nudges[1, first], nudges[2, first + 1] = aside, aside
        nudges[1, slides], nudges[2, slides] = aside, -aside
        nudges[3, first + 3], nudges[3, first + 6] = np.cos(TURN / 2) - 1, np.sin(TURN / 2)
        finer = Motion(deployment, measured, w.samples, rest, finer=2)
        finer.windows = w
        spread: list[list[Array]] = [[], []]
        for change in friction_variants(self.task):
            out, fine = m.simulate([change] * len(nudges), nudge=nudges), finer.simulate([change])
            for mine, x, y in zip(spread, out, fine, strict=True):
                mine.append(SIGMA * np.median(np.abs(np.concatenate([x[1:], y]) - x[0]), 0))
        joints, seen = (np.max(mine, 0) for mine in spread)  # a typical start, the worst friction
        self.joint_floor, self.observation_floor = np.median(joints, (0, 1)), np.median(seen, (0, 1))
        noise = np.median([[noise_of(q) for q in e.q.T] for e in self.episodes], 0)
        servos = m.model.actuator_biasprm[:, 1] < 0  # go where they are told, and so follow the noise of it
        shaken = max(float(np.median([noise_of(u) for u in x[:, servos].T])) for x in measured) if servos.any() else 0.0
        self.joint_scale = np.sqrt(joints**2 + noise**2 + JOINT_RESOLUTION**2 + shaken**2)
        self.observation_scale = np.sqrt(seen**2 + RESOLUTION**2 + self.noise**2)
        self.drive_scale = DRIVE_SHARE * float(np.std(np.concatenate(measured), axis=0).max()) + 1e-9


def friction_variants(task: AbstractTask) -> list[tuple[Effect, ...]]:
    """The nominal scene, and with all objects' friction lower and higher."""
    model = task.spec().compile()
    free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
    geoms = [model.geom(int(model.body_geomadr[model.jnt_bodyid[j]])) for j in free]
    changed: list[tuple[Effect, ...]] = [
        tuple(ContactFriction(coefficient=share * float(g.friction[0]), at=(g.name,)) for g in geoms)
        for share in PLAUSIBLE
    ]
    return changed if geoms else [()]


def changes_since_start(u: Array) -> Array:
    """Control [..., 1 + n, nu] -> how it changed since the first, [..., n, nu].

    Commands add up over an episode. What a wrong gain made of the earlier ones must not hide what it does now.
    """
    return u[..., 1:, :] - u[..., :1, :]


def effects_of(terms: Sequence[Term], values: Sequence[Array]) -> tuple[Effect, ...]:
    """The effects of a set; delays of sensors first, because they start from the truth."""
    found = [e for term, value in zip(terms, values, strict=True) for e in term.build(value)]
    return tuple(sorted(found, key=lambda e: type(e).__name__ != "SensorDelay"))


def observation_noise(deployment: Deployment) -> Array:
    """Standard deviation of white noise on each observation, from the quietest quarter of its changes, [O]."""
    task, changes = deployment.task, []
    model = task.spec().compile()
    columns = joint_columns(task, "qpos")
    for e in deployment.episodes:
        qpos = task.place(
            np.repeat(e.observation[:1], len(e.observation), 0), np.tile(model.qpos0, (len(e.observation), 1))
        )
        qpos[:, columns] = at_times(e.time, e.q, task.control_dt * np.arange(len(e.observation)))
        known = task.observe(qpos, np.zeros((len(qpos), model.nv)))  # of the machine, by its own joints
        changes.append(np.abs(np.diff(e.observation - known, axis=0)))
    return np.quantile(np.concatenate(changes), 0.25, axis=0) / (QUARTER * np.sqrt(2))


def _bend(r: Array) -> Array:
    """Pseudo-Huber as a residual: its square is 2 b^2 (sqrt(1 + (r/b)^2) - 1)."""
    return np.sign(r) * BEND * np.sqrt(2 * (np.sqrt(1 + (r / BEND) ** 2) - 1))
