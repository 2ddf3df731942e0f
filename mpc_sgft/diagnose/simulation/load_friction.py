"""Simulations in which dry friction follows the load of the actuators, which no field of MJCF does."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.simulation.plant import FORCE, Change, Plant, joint_of


class Drives(NamedTuple):
    """Actuators at joints: what their forces become when their commands change at once. Arrays of D, one a drive.

    Attributes:
        sensor, ctrl: Where its force and its command are.
        gear, gain: Force of the joint per force of the actuator, and that per command.
        force, command: Lowest and highest of either, [2, D].
        to_joint: 1 where a drive acts on a joint, [D, nj].
    """

    sensor: Index
    ctrl: Index
    gear: Array
    gain: Array
    force: Array
    command: Array
    to_joint: Array

    @classmethod
    def of(cls, plant: Plant, m: mujoco.MjModel, names: Sequence[str] | None = None) -> Drives:
        """Those of a model, all that are at joints if no names are given."""
        at = {a: joint_of(plant, a) for a in plant.actuators}
        names = [a for a in at if at[a]] if names is None else names
        ids = np.array([m.actuator(a).id for a in names], int)
        direct = m.actuator_dyntype[ids] == mujoco.mjtDyn.mjDYN_NONE
        fixed = m.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_FIXED
        return cls(
            sensor=np.array([m.sensor(f"{FORCE}{a}").adr[0] for a in names], int),
            ctrl=ids,
            gear=m.actuator_gear[ids, 0],
            gain=np.where(direct & fixed, m.actuator_gainprm[ids, 0], 0.0),
            force=_limits(m.actuator_forcelimited[ids], m.actuator_forcerange[ids]),
            command=_limits(m.actuator_ctrllimited[ids], m.actuator_ctrlrange[ids]),
            to_joint=np.array([[float(j == at[a]) for j in plant.joints] for a in names]).reshape(
                -1, len(plant.joints)
            ),
        )

    def load(self, felt: Array, then: Array, now: Array) -> Array:
        """Forces on the joints under the commands `now`, from what was felt under the commands `then`, [..., D] each.

        What is at its limit stays there.
        """
        low, high = self.force
        change = _within(now, *self.command) - _within(then, *self.command)
        moved = _within(felt + self.gain * change, low, high)
        return self.gear * np.where((felt <= low) | (felt >= high), felt, moved)


def _within(x: Array, low: Array, high: Array) -> Array:
    return np.minimum(np.maximum(x, low), high)


def _limits(limited: Array, given: Array) -> Array:
    """Lowest and highest of each, [2, D]."""
    return np.where(limited[:, None] > 0, given, [-np.inf, np.inf]).T


def roll_with_load_friction(
    plant: Plant,
    models: list[mujoco.MjModel],
    changes: list[Change],
    state: Array,
    inputs: Array,
    control: int,
    sample: int,
) -> tuple[Array, Array]:
    """States and sensors where dry friction follows the actuators' load; its level is set anew for each sample.

    Args:
        plant: The nominal scene.
        models: One each change, [K].
        changes: What changes the friction, [K].
        state: Starts, [K W, …].
        inputs: Of every step, [K W, N, …].
        control: What the inputs are.
        sample: Steps in a sample.
    """
    each, count, m = len(state) // len(models), inputs.shape[1], models[0]
    own = [copy.copy(m) for m in models for _ in range(each)]
    data, roll = [mujoco.MjData(m)], mujoco.rollout.Rollout()
    _, vadr = plant.addresses(m)
    losses = [x.dof_frictionloss for x in own]
    before, still = np.array(losses)[:, vadr], np.zeros((len(own), len(vadr)))
    drives = Drives.of(plant, m)
    states = np.empty((len(own), count, state.shape[1]))
    sensed = np.empty((len(own), count, m.nsensordata))

    def advance(begin: int, end: int) -> None:
        out = np.empty((len(own), end - begin, state.shape[1])), np.empty((len(own), end - begin, m.nsensordata))
        first = np.ascontiguousarray(state if not begin else states[:, begin - 1])
        given = np.ascontiguousarray(inputs[:, begin:end])
        roll.rollout(
            own, data, first, given,
            control_spec=control, skip_checks=True, nstep=end - begin, state=out[0], sensordata=out[1],
        )  # fmt: skip
        states[:, begin:end], sensed[:, begin:end] = out

    def set_levels(felt: Array, then: Array, now: Array) -> None:
        load = drives.load(felt[:, drives.sensor], then[:, drives.ctrl], now[:, drives.ctrl]) @ drives.to_joint
        for k, change in enumerate(changes):
            mine = slice(k * each, (k + 1) * each)
            level = before[mine] + sum((f(load[mine]) for f in change.frictions), still[mine])
            for loss, row in zip(losses[mine], level, strict=True):
                loss[vadr] = row

    block = max(1, sample)
    advance(0, 1)  # only to feel the load at the start
    set_levels(sensed[:, 0], inputs[:, 0], inputs[:, 0])
    for begin in range(0, count, block):
        end = min(begin + block, count)
        advance(begin, end)
        if end < count:
            set_levels(sensed[:, end - 1], inputs[:, end - 1], inputs[:, min(end + block, count) - 1])
    roll.close()
    return states, sensed
