"""Second link of the chain: from what the servos were driven to, to joints, objects and observations.

Windows of some control steps are simulated in the task's scene under the *measured* drive, from the measured joints
and the observed objects. What happened to the command before it reached the servos therefore does not matter here.
A window begins where the objects rest, because their velocities are not observed; if possible just before they move.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from envs.effects.actuator_delay import ActuatorDelay
from envs.effects.actuator_lag import ActuatorLag
from envs.effects.base import Effect
from envs.effects.frame_rotation import FrameRotation
from envs.effects.sensor_delay import SensorDelay
from envs.task import AbstractTask, whole_steps
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.deployments.recordings import Deployment, joint_columns

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
JOINT_SAMPLES = 5  # joints are compared so often in a control step
Controls = Callable[[int, NDArray[np.floating]], Array]  # of an episode, at times [M, steps] -> [M, steps, nu]
EXPLODED = 1e3  # predictions are clipped here, so that an unstable candidate is bad, not infinite


class StepWindows(NamedTuple):
    """W windows of n control steps.

    Attributes:
        episode, start: Index of each window's episode and of its first control step, [W].
        samples: n.
    """

    episode: Index
    start: Index
    samples: int


class Outcome(NamedTuple):
    """What K models predict in windows.

    Attributes:
        joints: Predicted minus measured, [K, W, n JOINT_SAMPLES, nj].
        observation: As sensed at the end of each control step, [K, W, n, O].
    """

    joints: Array
    observation: Array


class Motion:
    """Simulates changed scenes over windows.

    Args:
        deployment: Task and episodes.
        drive: Measured control of each servo at the joint samples, [S, nu] each episode.
        length: Control steps in a window.
        rest: Objects that move less than this between two observations rest [m].
        finer: Physics steps instead of one.

    Raises:
        UserError: If no window can be cut.
    """

    def __init__(self, deployment: Deployment, drive: Sequence[Array], length: int, rest: float, finer: int = 1):
        task = deployment.task
        self.task, self.episodes, self.drive = task, deployment.episodes, list(drive)
        self.spec = task.spec()
        for actuator in self.spec.actuators:  # the measured drive is what comes after delay and lag
            actuator.nsample, actuator.delay, actuator.dyntype = 0, 0.0, mujoco.mjtDyn.mjDYN_NONE
        self.h = task.sim_dt / finer
        self.spec.option.timestep = self.h
        self.model = self.spec.copy().compile()
        self.qadr, self.vadr = (np.array(joint_columns(task, kind)) for kind in ("qpos", "qvel"))
        self.objects = np.setdiff1d(np.arange(self.model.nq), self.qadr)
        self.substeps = whole_steps(task.control_dt, self.h)
        self.windows = cut(self, length, rest)
        self.workers = [mujoco.MjData(self.model) for _ in range(len(os.sched_getaffinity(0)))]

    def placed(self, episode: int, observation: Array) -> Array:
        """Positions [M, nq] with the objects where observations [M, O] see them; joints at the scene's own."""
        own = np.tile(self.model.qpos0, (len(observation), 1))
        own[:, self.qadr] = self.episodes[episode].q[0]
        return self.task.place(observation, own)

    def simulate(
        self,
        changes: Sequence[Sequence[Effect]],
        pick: Index | None = None,
        nudge: Array | None = None,
    ) -> Outcome:
        """Predictions of K changed scenes.

        Args:
            changes: Effects of each.
            pick: Windows; all if None.
            nudge: Added to the objects' positions at the start, [K, nq]; 0 if None.
        """
        w = self.windows
        pick = np.arange(len(w.start)) if pick is None else pick
        rows = [
            self.run(self._model(list(effects)), effects, pick, None if nudge is None else nudge[k])
            for k, effects in enumerate(changes)
        ]
        return Outcome(*(np.stack(parts) for parts in zip(*rows, strict=True)))

    def run(
        self,
        m: mujoco.MjModel,
        effects: Sequence[Effect],
        pick: Index,
        nudge: Array | None = None,
        controls: Controls | None = None,
    ) -> Outcome:
        """Predictions of one changed model, without the first axis.

        Args:
            m: The scene's, changed.
            effects: That it was changed by, of which those of sensors act here.
            pick, nudge: As in `simulate`.
            controls: What drives the servos of an episode's windows, in place of what was measured.
        """
        w, controls = self.windows, controls or self._measured
        late = sum(e.delay for e in effects if isinstance(e, SensorDelay))
        steps, nu, nj = w.samples * self.substeps, self.model.nu, len(self.qadr)
        state = np.zeros((len(pick), mujoco.mj_stateSize(m, STATE)))
        inputs = np.zeros((len(pick), steps, m.nu))
        measured = np.empty((len(pick), w.samples * JOINT_SAMPLES, nj))
        for i in np.unique(w.episode[pick]):
            mine, e = np.flatnonzero(w.episode[pick] == i), self.episodes[i]
            begin = np.maximum(w.start[pick[mine]] * self.task.control_dt - late, e.time[0])  # [s]
            qpos = self.placed(i, unsensed(self.task, effects, e.observation[w.start[pick[mine]]]))
            qpos += 0 if nudge is None else nudge
            qpos[:, self.qadr] = at_times(e.time, e.q, begin)
            qvel = np.zeros((len(mine), self.model.nv))
            qvel[:, self.vadr] = at_times(e.time, e.v, begin)
            state[mine, 1 : 1 + self.model.nq] = qpos
            state[mine, 1 + m.nq : 1 + m.nq + self.model.nv] = qvel
            ends = begin[:, None] + self.h * np.arange(1, steps + 1)
            inputs[mine, :, :nu] = controls(i, ends)
            measured[mine] = at_times(e.time, e.q, ends[:, self._compared() - 1])
        data = self.workers if m is self.model else [mujoco.MjData(m) for _ in self.workers]
        out = np.asarray(mujoco.rollout.rollout(m, data, state, inputs, skip_checks=False)[0])
        out = np.clip(np.nan_to_num(out, nan=EXPLODED), -EXPLODED, EXPLODED)
        joints = out[:, self._compared() - 1, 1 : 1 + m.nq][..., self.qadr] - measured
        ends = out[:, self.substeps - 1 :: self.substeps]  # [W, n, …]
        qpos, qvel = ends[..., 1 : 1 + self.model.nq], ends[..., 1 + m.nq : 1 + m.nq + self.model.nv]
        flat = self.task.observe(qpos.reshape(-1, self.model.nq), qvel.reshape(-1, self.model.nv))
        return Outcome(joints, sensed(self.task, effects, flat).reshape(len(pick), w.samples, -1))

    def _measured(self, episode: int, ends: NDArray[np.floating]) -> Array:
        return at_times(self.episodes[episode].time, self.drive[episode], ends)

    def _compared(self) -> Index:
        """Physics steps after which joints are compared, counted from 1, [n JOINT_SAMPLES]."""
        after = np.arange(1, self.windows.samples * JOINT_SAMPLES + 1) * self.substeps / JOINT_SAMPLES
        return np.maximum(np.round(after).astype(int), 1)

    def _model(self, effects: list[Effect]) -> mujoco.MjModel:
        edits = [e for e in effects if not acts_on_command(e) and type(e).edit_spec is not Effect.edit_spec]
        if not edits:
            return self.model
        spec = self.spec.copy()
        for effect in edits:
            effect.edit_spec(spec)
        return spec.compile()


def acts_on_command(effect: Effect) -> bool:
    """Whether an effect acts before the servos, on the command alone."""
    if isinstance(effect, FrameRotation):
        return effect.at == "base"
    return isinstance(effect, ActuatorDelay | ActuatorLag) or type(effect).command is not Effect.command


def at_times(time: Array, values: Array, when: NDArray[np.floating]) -> Array:
    """Linear interpolation of [S, k] at times [...] -> [..., k]; constant beyond the ends."""
    return np.stack([np.interp(when, time, values[:, i]) for i in range(values.shape[1])], -1)


def sensed(task: AbstractTask, effects: Sequence[Effect], truth: Array) -> Array:
    """What is observed of true observations [M, O]; a delay is in the times already, noise is left out."""
    read = truth
    for effect in effects:
        read = effect.sense(read, lambda _, same=read: same, lambda k: np.zeros((len(truth), k)), task)
    return read


def unsensed(task: AbstractTask, effects: Sequence[Effect], read: Array) -> Array:
    """The true observation behind a reading [M, O]: sensor effects are affine."""
    size = read.shape[1]
    probe = sensed(task, effects, np.vstack([np.zeros(size), np.eye(size)]))
    return np.linalg.lstsq((probe[1:] - probe[0]).T, (read - probe[0]).T, rcond=None)[0].T


def cut(motion: Motion, length: int, rest: float) -> StepWindows:
    """Windows that begin where the objects rest, just before they move if they are about to.

    Raises:
        UserError: If there are fewer than four.
    """
    episode, start = [], []
    for i, e in enumerate(motion.episodes):
        where = motion.placed(i, e.observation)[:, motion.objects]
        step = np.abs(np.diff(where, axis=0)).max(1) if len(motion.objects) else np.zeros(len(where) - 1)
        still = np.r_[False, step < rest]  # [T + 1] since the observation before
        leaves = still & np.r_[~still[1:], False]
        t, last = 1, len(where) - 1 - length
        while t <= last:
            soon = np.flatnonzero(leaves[t : min(t + length // 2, last) + 1])
            if still[t] and (leaves[t] or not len(soon)):
                episode.append(i)
                start.append(t)
                t += length
            else:
                t += 1
    if len(start) < 4:
        raise UserError(
            f"only {len(start)} windows of {length} steps in which objects first rest: record more episodes."
        )
    return StepWindows(np.array(episode), np.array(start), length)
