"""Simulations in which dry friction follows the load of the actuators, which no field of MJCF does."""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.plant import FORCE, Change, Plant, joint_of


class JointActuator(NamedTuple):
    """An actuator at a joint: what its force becomes when its command changes at once.

    Attributes:
        joint: Index of its joint.
        sensor, ctrl: Where its force and its command are.
        gear, gain: Force of the joint per force of the actuator, and that per command.
        force, command: Lowest and highest of either.
    """

    joint: int
    sensor: int
    ctrl: int
    gear: float
    gain: float
    force: tuple[float, float]
    command: tuple[float, float]

    @classmethod
    def of(cls, m: mujoco.MjModel, name: str, joint: int) -> JointActuator:
        a = m.actuator(name)
        force = _limits(m.actuator_forcelimited[a.id], m.actuator_forcerange[a.id])
        command = _limits(m.actuator_ctrllimited[a.id], m.actuator_ctrlrange[a.id])
        direct = m.actuator_dyntype[a.id] == mujoco.mjtDyn.mjDYN_NONE
        gain = float(a.gainprm[0]) if direct and m.actuator_gaintype[a.id] == mujoco.mjtGain.mjGAIN_FIXED else 0.0
        at = int(m.sensor(f"{FORCE}{name}").adr[0])
        return cls(joint, at, int(a.id), float(a.gear[0]), gain, force, command)

    def load(self, felt: Array, then: Array, now: Array) -> Array:
        """Force on the joint under the command `now`, from what was felt under the command `then`, [...] each.

        What is at its limit stays there.
        """
        low, high = self.force
        change = np.clip(now, *self.command) - np.clip(then, *self.command)
        return self.gear * np.where((felt <= low) | (felt >= high), felt, np.clip(felt + self.gain * change, low, high))


def _limits(limited: int, given: Array) -> tuple[float, float]:
    return (float(given[0]), float(given[1])) if limited else (-np.inf, np.inf)


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
    drives = [JointActuator.of(m, a, plant.joints.index(j)) for a in plant.actuators if (j := joint_of(plant, a))]
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
        load = still.copy()
        for d in drives:
            load[:, d.joint] += d.load(felt[:, d.sensor], then[:, d.ctrl], now[:, d.ctrl])
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
