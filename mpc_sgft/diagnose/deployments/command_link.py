"""First link of the chain: from what was commanded to what the servos were driven to.

A servo's force is linear in its control, its position and its velocity. So the measured force tells which control the
servo really acted on, whatever happened to the command on its way. It is compared with what the interface makes of the
recorded actions if some effects are there; no simulation is needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from envs.effects.actuator_delay import ActuatorDelay
from envs.effects.actuator_lag import ActuatorLag
from envs.effects.base import Effect
from envs.task import AbstractTask, whole_steps
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.held_commands import MIN_LAG
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.deployments.recordings import Rollout, columns_of, joint_columns

AT_LIMIT = 1e-4  # of the range of forces


def measured_drive(model: mujoco.MjModel, episode: Rollout) -> Array:
    """Control that each servo acted on at the joint samples, [S, nu], in units of the control.

        force = gain u + b0 + b1 q + b2 v   at the beginning of the physics step that ends at the sample

    Raises:
        UserError: If an actuator's force is not of this form.
    """
    before = episode.time - model.opt.timestep
    out, columns = np.empty_like(episode.force), columns_of(model, "qpos")
    for i in range(episode.force.shape[1]):
        joint, gear = model.actuator_trnid[i, 0], model.actuator_gear[i, 0]
        linear = model.actuator_gaintype[i] == int(mujoco.mjtGain.mjGAIN_FIXED)
        at_joint = model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT)
        if not at_joint or not linear or int(model.jnt_qposadr[joint]) not in columns:
            name = model.actuator(i).name
            raise UserError(f"actuator {name!r}: diagnose --run needs motors or servos with a fixed gain at a joint.")
        column = columns.index(int(model.jnt_qposadr[joint]))
        q, v = (gear * np.interp(before, episode.time, x[:, column]) for x in (episode.q, episode.v))
        b = model.actuator_biasprm[i]
        out[:, i] = (episode.force[:, i] - b[0] - b[1] * q - b[2] * v) / model.actuator_gainprm[i, 0]
    return out


def saturated(model: mujoco.MjModel, episode: Rollout) -> NDArray[np.bool_]:
    """Where a servo gave all the force that it can, so that its control is not told by it, [S, nu]."""
    low, high = model.actuator_forcerange.T
    beyond = (episode.force <= low + AT_LIMIT * (high - low)) | (episode.force >= high - AT_LIMIT * (high - low))
    return beyond & (model.actuator_forcelimited == 1)


class ServoCommands:
    """What the interface sends to the servos for the actions of all episodes.

    Args:
        task: The nominal task.
        episodes: With E episodes of at most T steps.
    """

    def __init__(self, task: AbstractTask, episodes: Sequence[Rollout]):
        self.task = task
        self.substeps = whole_steps(task.control_dt, task.sim_dt)
        longest = max(len(e.action) for e in episodes)
        self.action = np.stack([_padded(e.action, longest) for e in episodes], 1)  # [T, E, A]
        self.seen = np.stack([_padded(e.observation[:-1], longest) for e in episodes], 1)  # [T, E, O]
        model, columns = task.spec().compile(), joint_columns(task, "qpos")
        driven = [columns.index(int(model.jnt_qposadr[joint])) for joint in model.actuator_trnid[:, 0]]
        self.first = np.stack([e.q[0, driven] for e in episodes])  # [E, nu]

    @property
    def times(self) -> Array:
        """Ends of all physics steps since the start [s], [T N]."""
        return self.task.sim_dt * np.arange(1, len(self.action) * self.substeps + 1, dtype=float)

    def drive(self, changes: Sequence[Sequence[Effect]]) -> Array:
        """Control at the servos in every physics step if some effects are there, [K, E, T N, nu] of K sets."""
        corners = self._corners(changes)
        ramp = np.arange(1, self.substeps + 1)[:, None] / self.substeps
        steps = corners[:, :, :-1, None] + ramp * (corners[:, :, 1:] - corners[:, :, :-1])[:, :, :, None]
        out = steps.reshape(*corners.shape[:2], -1, corners.shape[3])
        for k, effects in enumerate(changes):
            first = corners[k, :, :1]
            for effect in effects:
                if isinstance(effect, ActuatorDelay):
                    out[k] = _delayed(out[k], first, effect.delay / self.task.sim_dt)
                elif isinstance(effect, ActuatorLag) and effect.time_constant > MIN_LAG:
                    out[k] = _lagged(out[k], first, np.exp(-self.task.sim_dt / effect.time_constant))
        return out

    def _corners(self, changes: Sequence[Sequence[Effect]]) -> Array:
        """Control at the beginning and after each control step, before delay and lag, [K, E, T + 1, nu]."""
        count, size = len(changes), len(self.first)
        first = np.tile(self.first, (count, 1))
        target = self.task.hold(first)
        told = [self.task.ctrl(target, first)]
        for sent, seen in zip(self.action, self.seen, strict=True):
            realised = np.tile(sent, (count, 1))
            for k, effects in enumerate(changes):
                mine = slice(k * size, (k + 1) * size)
                for effect in effects:
                    realised[mine] = effect.command(realised[mine], self.task, seen)
            target = self.task.move(target, realised)
            told.append(self.task.ctrl(target, told[-1]))
        return np.stack(told, 1).reshape(count, size, len(told), -1)


def _padded(rows: Array, length: int) -> Array:
    return np.concatenate([rows, np.zeros((length - len(rows), rows.shape[1]))])


def _delayed(u: Array, first: Array, steps: float) -> Array:
    """Controls [E, T, nu] late by a number of steps, between whole steps interpolated; `first` [E, 1, nu] before."""
    whole = int(steps)
    part = steps - whole
    long = np.concatenate([np.repeat(first, whole + 1, 1), u], 1)
    return (1 - part) * long[:, 1 : 1 + u.shape[1]] + part * long[:, : u.shape[1]]


def _lagged(u: Array, first: Array, keep: float) -> Array:
    """First-order low pass of held controls [E, T, nu] that stood at `first` [E, 1, nu]; as MuJoCo's filterexact."""
    return np.asarray(lfilter([1 - keep], [1.0, -keep], u - first, axis=1)) + first
