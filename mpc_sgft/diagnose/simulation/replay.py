"""Short windows of the measurement, simulated from their measured starts under the measured commands.

Semi-implicit Euler is a leapfrog whose velocities live half a step earlier: windows start with v(t0 - h/2), and each
step gets the mean of the command over the half steps around it. This makes the simulator's own error second order.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from envs.effects import bend_bristles, bristles, place_rotors
from envs.effects.base import ROTOR
from mpc_sgft.diagnose.data import windows
from mpc_sgft.diagnose.data.held_commands import held_mean
from mpc_sgft.diagnose.data.measured import Array, Episode, Index
from mpc_sgft.diagnose.data.smooth import smooth
from mpc_sgft.diagnose.simulation.load_friction import Drives, roll_with_load_friction
from mpc_sgft.diagnose.simulation.plant import Change, Plant

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
FORCED = CTRL | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
THREADS = int(os.environ.get("OMP_NUM_THREADS", len(os.sched_getaffinity(0))))
NOTHING = mujoco.MjSpec().compile()
SIZES = [n for n in dir(NOTHING) if n[0] == "n" and isinstance(getattr(NOTHING, n), int)]  # of all arrays of a model
LEAD = 0.6  # [s] before a window, to find how rotors lean and bristles bend at its start
STIFF = 0.2  # of a joint's inertia
EXPLODED = 1e6  # predictions are clipped here, so that an unstable candidate is bad, not infinite


class Replayer:
    """Simulates changed models over all windows at once.

    Args:
        plant: The nominal scene.
        episodes: What was measured, all with the same time step.
        window: Length of a window [s]. The first starts where smoothing the start has samples on both sides.
        signals: Names of the compared signals; `qpos/…` and `qvel/…` of joints, `force/…` of actuators.
    """

    def __init__(self, plant: Plant, episodes: Sequence[Episode], window: float, signals: Sequence[str]):
        self.plant, self.episodes, self.signals = plant, list(episodes), list(signals)
        self.dt = episodes[0].dt
        self.smooth = [smooth(e, plant.joints) for e in self.episodes]
        self.windows = windows.cut(self.episodes, self.smooth, self.signals, max(2, round(window / self.dt)))
        first = np.array([self.smooth[i].half for i in self.windows.episode], int)
        most = min(round(LEAD / self.dt), self.windows.samples)
        self.ahead = np.minimum(most, self.windows.start - first)  # samples that lead to each window
        self._nominal_ctrl: Array | None = None
        self.simulations = 0

    @property
    def h(self) -> float:
        """Physics step [s]."""
        return float(self.plant.model.opt.timestep)

    @property
    def half(self) -> float:
        """By how much velocities live before positions [s]."""
        leap = [int(getattr(mujoco.mjtIntegrator, f"mjINT_{k}")) for k in ("EULER", "IMPLICIT", "IMPLICITFAST")]
        return self.h / 2 if self.plant.model.opt.integrator in leap else 0.0

    def simulate(
        self,
        changes: Sequence[Change],
        pick: Index | None = None,
        shift: Array | None = None,
        force: Array | None = None,
    ) -> Array:
        """Predictions of K changed models, [K, W, n, S].

        Args:
            changes: One each model.
            pick: Windows to simulate; all if None.
            shift: Added to the start, [K, 2 nj] (positions, then velocities); 0 if None.
            force: Generalised force on the joints at every physics step, [K, W, N, nj]; 0 if None.
        """
        w = self.windows
        pick = np.arange(len(w.start), dtype=np.int_) if pick is None else pick
        models = [self._centred(self.plant.compile(c)) for c in changes]
        out = np.empty((len(changes), len(pick), w.samples, len(self.signals)))
        for group in _same_layout(models, changes):
            out[group] = self._roll(
                [models[k] for k in group],
                [changes[k] for k in group],
                pick,
                None if shift is None else shift[group],
                None if force is None else force[group],
            )
        self.simulations += len(changes) * len(pick)
        return np.clip(np.nan_to_num(out, nan=EXPLODED), -EXPLODED, EXPLODED)

    def _centred(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """A model whose joint damping acts at the mean of the speeds before and after a step, not at the one after.

        h d / 2 less armature does the same: (M - h d / 2) dv / h = F - d (v + dv) is M dv / h = F - d (v + dv / 2).
        Where that is much of the inertia, damping is stiff, and only part of it is done, for M to stay positive.
        """
        less = self.half * model.dof_damping
        if not less.any():
            return model
        less *= min(1.0, STIFF / float(less @ model.dof_invweight0))
        out = copy.copy(model)
        for inertia in (out.dof_armature, out.dof_M0):  # the latter is of joints whose inertia is constant
            inertia -= less
        return out

    def with_plant(self, plant: Plant) -> Replayer:
        """The same windows of another model of the scene."""
        other = copy.copy(self)
        other.plant, other._nominal_ctrl = plant, None
        return other

    def with_commands(self, change: Callable[[Array], Array]) -> Replayer:
        """The same starts under other commands: f(ctrl [T, nu]) -> [T, nu] of every episode."""
        other = copy.copy(self)
        other.episodes = [replace(e, ctrl=change(e.ctrl)) for e in self.episodes]
        other._nominal_ctrl = None
        return other

    def lead_up(self) -> Replayer:
        """Windows that end, or come by, where these begin; as early as smoothing lets them, at most by LEAD."""
        other, w, n = copy.copy(self), self.windows, int(self.ahead.max())
        other.windows = windows.at(self.episodes, self.smooth, self.signals, w.episode, w.start - self.ahead, n)
        other.ahead, other._nominal_ctrl = np.zeros_like(self.ahead), None
        return other

    def with_forces_read(self, acting: tuple[float, float]) -> Replayer:
        """The same windows with all forces read BEFORE or AFTER a sample's command is there."""
        other = copy.copy(self)
        other.windows = self.windows._replace(acting=np.broadcast_to(acting, self.windows.acting.shape))
        return other

    @property
    def steps(self) -> int:
        """Physics steps in a window, and those that a force at its last sample is read from."""
        return int(np.ceil(self.windows.samples * self.dt / self.h - 1e-6)) + 3

    def step_times(self) -> Array:
        """Time of each physics step of each window since its episode's start [s], [W, N]."""
        return self.windows.start[:, None] * self.dt + self.h * np.arange(self.steps)

    def _roll(
        self, models: list[mujoco.MjModel], changes: list[Change], pick: Index, shift: Array | None, force: Array | None
    ) -> Array:
        m = models[0]
        qadr, vadr = self.plant.addresses(m)
        state, a = self._begin(models, changes, pick, shift)
        inputs, states, sensed = self._advance(models, changes, pick, state, force)
        qpos, qvel = (
            np.concatenate([state[:, :, None, first + adr], states[..., first + adr]], 2)
            for first, adr in ((1, qadr), (1 + m.nq, vadr))
        )
        late = np.array([[c.late.get(joint, 0.0) for joint in self.plant.joints] for c in changes])
        felt = self._force_readings(models, changes, pick, sensed, inputs)
        out = self._read(qpos, qvel, sensed, felt, m, late, a)
        for k, change in enumerate(changes if any(c.reads for c in changes) else []):
            for i, name in enumerate(self.signals):
                out[k, ..., i] = change.read(out[k, ..., i], name)
        return out

    def _begin(
        self, models: list[mujoco.MjModel], changes: list[Change], pick: Index, shift: Array | None
    ) -> tuple[Array, Array]:
        """States at the windows' starts, [K, W, …], and the joints' accelerations there if readings are old."""
        m, w, nj, count = models[0], self.windows, len(self.plant.joints), len(pick)
        qadr, vadr = self.plant.addresses(m)
        data = mujoco.MjData(m)
        initial = np.zeros(mujoco.mj_stateSize(m, FULL))
        mujoco.mj_getState(m, data, initial, FULL)
        state = np.tile(initial, (len(models), count, 1))
        q = np.tile(w.q0[pick], (len(models), 1, 1))
        v = np.tile(w.v0[pick], (len(models), 1, 1))
        a = np.zeros_like(q)  # before the start, for readings that are older
        for k, change in enumerate(changes):
            for joint, late in change.late.items():
                i = self.plant.joints.index(joint)
                q[k, :, i], v[k, :, i], a[k, :, i] = self._start(i, late, pick)
        for k, change in enumerate(changes if any(c.reads for c in changes) else []):
            for i, joint in enumerate(self.plant.joints):
                q[k, :, i] = change.unread(q[k, :, i], f"qpos/{joint}")
                v[k, :, i] *= np.diff(change.unread(np.array([0.0, 1.0]), f"qpos/{joint}"))
        if shift is not None:
            q, v = q + shift[:, None, :nj], v + shift[:, None, nj:]
        state[:, :, 1 + qadr], state[:, :, 1 + m.nq + vadr] = q, v
        qacc, jerk = np.zeros((2, count, m.nv))
        qacc[:, vadr], jerk[:, vadr] = w.a0[pick], w.j0[pick]
        for model, rows in zip(models, state, strict=True):
            qpos, qvel, act = np.split(rows[:, 1 : 1 + m.nq + m.nv + m.na], [m.nq, m.nq + m.nv], 1)
            place_rotors(model, qpos, qvel, qacc, jerk)
            bend_bristles(model, qvel, act)
        rotors = [j for j in map(m.joint, range(m.njnt)) if j.name.startswith(ROTOR)]
        if self.ahead.any() and (rotors or bristles(m)):
            self._settle_memories(models, changes, pick, state, rotors)
        return state, a

    def _settle_memories(
        self, models: list[mujoco.MjModel], changes: list[Change], pick: Index, state: Array, rotors: list[Any]
    ) -> None:
        """Put rotors and bristles where they come to stand on the way to the windows' starts; in place."""
        m, before = models[0], self.lead_up()
        start, _ = before._begin(models, changes, pick, None)
        _, states, _ = before._advance(models, changes, pick, start, None)
        way = np.concatenate([start[:, :, None], states], 2)
        then = np.round(self.ahead[pick] * self.dt / self.h).astype(int)
        end = way[:, np.arange(len(pick)), then]
        bent = 1 + m.nq + m.nv + m.actuator_actadr[bristles(m)]
        state[..., bent] = end[..., bent]
        for rotor in rotors:
            joint = m.joint(rotor.name.removeprefix(ROTOR))
            for first, at, of in ((1, rotor.qposadr, joint.qposadr), (1 + m.nq, rotor.dofadr, joint.dofadr)):
                state[..., first + at] = state[..., first + of] + end[..., first + at] - end[..., first + of]

    def _advance(
        self,
        models: list[mujoco.MjModel],
        changes: list[Change],
        pick: Index,
        state: Array,
        force: Array | None,
    ) -> tuple[Array, Array, Array]:
        """Inputs of each physics step, states after it and what the sensors read, [K, W, N, …] each.

        Activations and speeds of the starts are set, in place.
        """
        m, count = models[0], len(pick)
        _, vadr = self.plant.addresses(m)
        nu, extra = len(self.plant.actuators), m.nu - len(self.plant.actuators)
        inputs = np.zeros((len(models), count, self.steps, m.nu + (m.nv if force is not None else 0)))
        order = [m.actuator(a).id for a in self.plant.actuators] if extra else list(range(nu))
        for k, change in enumerate(changes):
            inputs[k, :, :, order] = np.moveaxis(self._step_commands(change, pick), -1, 0)
        if force is not None:
            inputs[..., m.nu + vadr] = force
        filters = [i for i, column in enumerate(order) if m.actuator_actadr[column] >= 0]
        if filters:
            at = 1 + m.nq + m.nv + m.actuator_actadr[np.array(order)[filters]]
            state[:, :, at] = self._activations(m, changes, pick)[..., filters]
        rows = len(models) * count
        starts, driven = state.reshape(rows, -1), inputs.reshape(rows, self.steps, -1)
        control = CTRL if force is None else FORCED
        each = [x for x in models for _ in range(count)]
        workers = [mujoco.MjData(m) for _ in range(THREADS)]

        def go(driven: Array) -> tuple[Array, Array]:
            if changes[0].frictions:
                return roll_with_load_friction(
                    self.plant, models, changes, starts, driven, control, round(self.dt / self.h)
                )
            states, sensed = mujoco.rollout.rollout(each, workers, starts, driven, control_spec=control)
            return np.asarray(states, float), np.asarray(sensed, float)

        if self.half:  # a step from v(t0) gains twice what v(t0 - h / 2) lacks
            speeds = slice(1 + m.nq, 1 + m.nq + m.nv)
            starts[:, speeds] -= (go(driven[:, :1])[0][:, 0, speeds] - starts[:, speeds]) / 2
        states, sensed = go(driven)
        shape = (len(models), count, self.steps, -1)
        return inputs, states.reshape(shape), sensed.reshape(shape)

    def _activations(self, m: mujoco.MjModel, changes: list[Change], pick: Index) -> Array:
        """What filters of actuators have made of the commands up to the windows' starts, [K, W, nu]."""
        own = np.array([m.actuator_dynprm[m.actuator(a).id, 0] for a in self.plant.actuators])
        own *= [m.actuator_actadr[m.actuator(a).id] >= 0 for a in self.plant.actuators]
        edges = self.step_times()[pick, :1, None] + np.array(windows.AFTER)
        return np.stack([self._mean_commands(replace(c, lag=c.lag + own), pick, edges)[:, 0] for c in changes])

    def _start(self, joint: int, late: float, pick: Index) -> Array:
        """True position, velocity and acceleration of a joint at the windows' starts, [3, W], if readings are old."""
        w, out = self.windows, np.empty((3, len(pick)))
        for i, s in enumerate(self.smooth):
            mine = w.episode[pick] == i
            at = np.minimum(w.start[pick][mine] + late / self.dt, len(s.q) - 1)
            for row, values in enumerate((s.q, s.v, s.a)):
                out[row, mine] = np.interp(at, np.arange(len(values)), values[:, joint])
        return out

    def _force_readings(
        self, models: list[mujoco.MjModel], changes: list[Change], pick: Index, sensed: Array, inputs: Array
    ) -> dict[str, Array]:
        """Compared force signals -> what they read at the samples, [K, W, n].

        A step's force is that of its state under the mean of its commands; a reading shows the command that acts then.

        Args:
            sensed: Sensors, [K, W, N, …].
            inputs: Of each step, [K, W, N, …].
        """
        names = [name for name in self.signals if name.startswith("force/")]
        if not names:
            return {}
        w, at = self.windows, self.dt * np.arange(1, self.windows.samples + 1)[None] / self.h
        ticks = self.dt * (w.start[pick, None] + np.arange(1, w.samples + 1))[..., None]
        now = np.stack([self._mean_commands(c, pick, ticks + w.acting[pick]) for c in changes])  # [K, W, n, nu]
        out = {}
        for name in names:
            part = name.split("/", 1)[1]
            drives = [Drives.of(self.plant, m, [part]) for m in models]
            felt, then = _at(sensed[..., drives[0].sensor[0]], at), _at(inputs[..., drives[0].ctrl[0]], at)
            u = now[..., self.plant.actuators.index(part)]
            rows = (x[..., None] for x in (felt, then, u))
            out[name] = np.stack([d.load(*row)[..., 0] for d, *row in zip(drives, *rows, strict=True)])
        return out

    def _read(
        self,
        qpos: Array,
        qvel: Array,
        sensed: Array,
        felt: dict[str, Array],
        m: mujoco.MjModel,
        late: Array,
        a: Array,
    ) -> Array:
        """Signals at the samples' times from states at the steps' times, [K, W, n, S].

        Args:
            qpos, qvel: States, [K, W, N + 1, nj].
            sensed: Sensors, [K, W, N, …].
            felt: Force signals.
            m: Model that the sensors are of.
            late: Seconds by which readings are old, [K, nj].
            a: Acceleration before the start, [K, W, nj].
        """
        times = self.dt * np.arange(1, self.windows.samples + 1)[None]
        late = late if late.any() else late[:1]
        columns = []
        for name in self.signals:
            kind, part = name.split("/", 1)
            if kind == "qpos":
                i = self.plant.joints.index(part)
                then = times - late[:, i, None]
                bend = a[:, :, i, None] * np.minimum(then, 0)[:, None] ** 2 / 2
                columns.append(_at(qpos[..., i], then / self.h) + bend)
            elif kind == "qvel":
                i = self.plant.joints.index(part)
                columns.append(_at(qvel[..., i], (times + self.half - late[:, i, None]) / self.h))
            elif kind == "force":
                columns.append(felt[name])
            else:
                columns.append(_at(sensed[..., int(m.sensor(part).adr[0])], times / self.h))
        return np.stack(columns, -1)

    def _step_commands(self, change: Change, pick: Index) -> Array:
        """Mean command of each physics step of the picked windows, [W, N, nu]."""
        plain = not change.commands and not np.any(change.delay) and not np.any(change.lag)
        if plain and self._nominal_ctrl is not None:
            return self._nominal_ctrl[pick]
        every = np.arange(len(self.windows.start), dtype=np.int_) if plain else pick
        edges = self.step_times()[every][:, :, None] + np.array([-self.half, self.h - self.half])
        out = self._mean_commands(change, every, edges)
        if plain:
            self._nominal_ctrl = out
            return out[pick]
        return out

    def _mean_commands(self, change: Change, pick: Index, edges: Array) -> Array:
        """Mean commands of the picked windows over intervals of time since their episode's start, [W, N, 2 -> nu]."""
        size = len(self.plant.actuators)
        late, lag = (np.broadcast_to(np.asarray(x, float), (size,)) for x in (change.delay, change.lag))
        out = np.empty((*edges.shape[:2], size))
        for i, episode in enumerate(self.episodes):
            mine = np.flatnonzero(self.windows.episode[pick] == i)
            if not len(mine):
                continue
            ctrl = episode.ctrl
            for command in change.commands:
                ctrl = command(ctrl, episode.dt)
            for a in range(size):
                out[mine, :, a] = held_mean(ctrl[:, a], episode.dt, edges[mine] - late[a], lag[a])
        return out


def _same_layout(models: Sequence[mujoco.MjModel], changes: Sequence[Change]) -> list[list[int]]:
    """Indices of models of the same layout, all with loaded friction or none: these can be rolled out in one call.

    One whose arrays are larger than those of the first would be written beyond the end of its data.
    """
    groups: dict[tuple[int, ...], list[int]] = {}
    for k, (m, c) in enumerate(zip(models, changes, strict=True)):
        layout = tuple(getattr(m, n) for n in SIZES)
        groups.setdefault((*layout, bool(c.frictions)), []).append(k)
    return list(groups.values())


def _at(values: Array, position: NDArray[Any]) -> Array:
    """Linear interpolation of [K, W, N] at fractional indices [1 or K, n]; before the first, along the first step."""
    position = np.minimum(position, values.shape[2] - 1)
    low = np.clip(np.floor(position).astype(int), 0, values.shape[2] - 2)
    part = (position - low)[:, None]
    if len(low) == 1:
        return values[:, :, low[0]] * (1 - part) + values[:, :, low[0] + 1] * part
    rows = np.arange(len(values))[:, None]
    return np.moveaxis(values[rows, :, low], 2, 1) * (1 - part) + np.moveaxis(values[rows, :, low + 1], 2, 1) * part
