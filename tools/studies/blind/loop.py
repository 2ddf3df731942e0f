"""A machine in closed loop as it would be in a laboratory, or driven by recorded commands; many machines at once.

Every tick the controller reads the sample before, and sends a command that holds until the next tick. The encoder is
read near the tick (time jitter), is noisy and counts in steps.
"""

from typing import NamedTuple, Protocol

import numpy as np

from tools.studies.blind.integrate import Integrator, State, start
from tools.studies.blind.plants import Array, Plant, Rows

H = 0.0002  # [s] a tenth of the solver's time step
JITTER_STEPS = 1  # a sample is read at most this many H before or after its tick


class Sensor(NamedTuple):
    """What the encoders add; None for ideal ones.

    Attributes:
        noise: Added to positions [m or rad], [R, T, n].
        count: Width of an encoder step [m or rad], [R, n].
        early: Steps of H by which a sample comes late (negative: early), [R, T] of -1, 0, 1.
    """

    noise: Array
    count: Array
    early: Array


class Record(NamedTuple):
    """What was measured, and what was true; time from 0 in steps of the tick.

    Attributes:
        time: When each sample was really taken [s], [R, T].
        ctrl: Command in force from the tick on, [R, T, n].
        qpos: Position as measured, [R, T, n].
        clean: The same without noise and encoder steps (but with gain, offset and delay of the sensor).
        clean_speed: Its derivative, [R, T, n].
        force: Force of the drive, [R, T, n].
        state: The true state at the ticks: y [T, 5, R, n] and s [T, R, n].
    """

    time: Array
    ctrl: Array
    qpos: Array
    clean: Array
    clean_speed: Array
    force: Array
    state: State


class Controller(Protocol):
    """Commands [R, n] at tick k from the newest measured positions [R, n]."""

    def __call__(self, k: int, measured: Array) -> Array: ...


def simulate(
    plant: Plant,
    p: Rows,
    first: State,
    ticks: int,
    per_tick: int,
    *,
    commands: Array | Controller,
    sensor: Sensor | None = None,
    time: float = 0.0,
) -> Record:
    """Run R machines for a number of ticks.

    Args:
        plant: Their kind.
        p: Their parameters, R rows.
        first: Where they start.
        ticks: T.
        per_tick: Steps of H in a tick.
        commands: [R, T, n], or a controller that closes the loop.
        sensor: Noise, steps and jitter of the encoders.
        time: Clock at the first tick [s], for what drifts.
    """
    rows, n = first.y.shape[1:]
    integrator, chain, reading = Integrator(plant, p, H), _Drive(p, ticks, per_tick), _Reading(p)
    shape = (rows, ticks, n)
    qpos, clean, speed, force = (np.zeros(shape) for _ in range(4))
    ys, ss = np.zeros((ticks, 5, rows, n)), np.zeros((ticks, rows, n))
    late = np.zeros((rows, ticks), int) if sensor is None else sensor.early.astype(int)
    jitters = bool(late.any())
    reading.push(first.y)
    measured = reading.now()[0]
    if sensor is not None:
        measured = _count(measured + sensor.noise[:, 0], sensor.count)
    state, steps = first, ticks * per_tick
    for i in range(steps + 1):
        k, phase = divmod(i, per_tick)
        if phase == 0 and k < ticks:
            ys[k], ss[k] = state
            chain.sent[:, k] = commands(k, measured) if callable(commands) else commands[:, k]
        near = ((k, phase), (k + 1, phase - per_tick)) if jitters else ((k, phase),)
        for tick, shift in near:
            if abs(shift) <= JITTER_STEPS and tick < ticks:
                who = late[:, tick] == shift
                if tick == 0:
                    who = np.full(rows, shift == 0)
                    late[:, 0] = 0
                if who.any():
                    clean[who, tick], speed[who, tick] = (x[who] for x in reading.now())
                    w = chain.now(i)
                    force[who, tick] = integrator.forces.drive(w, state.y[3], state.y[4], time + i * H)[who]
                    if sensor is not None:
                        noisy = clean[who, tick] + sensor.noise[who, tick]
                        qpos[who, tick] = _count(noisy, sensor.count[who])
                    else:
                        qpos[who, tick] = clean[who, tick]
                    if shift == 0 or jitters:
                        measured = measured.copy()
                        measured[who] = qpos[who, tick]
        if i < steps:
            state = integrator.step(state, chain.next(i), time + i * H)
            reading.push(state.y)
    stamps = (np.arange(ticks)[None] * per_tick + late) * H
    return Record(stamps, chain.sent, qpos, clean, speed, force, State(ys, ss))


def _count(x: Array, step: Array) -> Array:
    return np.round(x / step) * step


class _Drive:
    """The command on its way to the drive: gain, offset, dead band, delay, lag."""

    def __init__(self, p: Rows, ticks: int, per_tick: int) -> None:
        self.p, self.dt = p, per_tick * H
        rows, n = p["gain"].shape
        self.sent = np.zeros((rows, ticks, n))
        self.plain = bool(np.all(p["delay"] == 0))
        self.lags = bool(np.any(p["lag"] > 0))
        tau = np.maximum(p["lag"], 1e-9)
        self.keep = [np.where(p["lag"] > 0, np.exp(-share * H / tau), 0.0) for share in (0.5, 1.0)]
        self.filtered: Array | None = None
        self.index = np.ogrid[:rows, :n]

    def now(self, i: int) -> Array:
        """What reaches the drive at step i."""
        arriving = self.arriving(i)
        return arriving if self.filtered is None else np.where(self.p["lag"] > 0, self.filtered, arriving)

    def arriving(self, i: int) -> Array:
        """The command before the lag, [R, n]."""
        k = i * H / self.dt
        if self.plain:
            raw = self.sent[:, min(int(k + 1e-6), self.sent.shape[1] - 1)]
        else:
            back = np.floor(k - self.p["delay"] / self.dt + 1e-6).astype(int)
            back = np.clip(back, 0, self.sent.shape[1] - 1)
            raw = self.sent[self.index[0], back, self.index[1]]
        raw = raw * self.p["gain"] + self.p["offset"]
        dead = self.p["deadband"]
        return raw - np.clip(raw, -dead, dead)

    def next(self, i: int) -> tuple[Array, Array, Array]:
        """At the start, in the middle and at the end of step i; moves the lag on."""
        target = self.arriving(i)
        if not self.lags:
            return target, target, target
        begin = target if self.filtered is None else self.filtered
        middle, self.filtered = (target + (begin - target) * keep for keep in self.keep)
        return np.where(self.p["lag"] > 0, begin, target), middle, self.filtered


class _Reading:
    """Position and velocity as the sensor sees them: gain, offset, and delay through a ring of past steps."""

    def __init__(self, p: Rows) -> None:
        self.p = p
        self.delay = p["sensor_delay"] / H
        self.size = int(np.ceil(self.delay.max())) + 2
        self.rotor = bool(np.any(p["encoder"] > 0))
        self.ring = np.zeros((self.size, 2, *self.delay.shape))
        self.count = 0  # steps pushed so far

    def push(self, y: Array) -> None:
        seen = y[:2]
        if self.rotor:
            seen = np.where(self.p["encoder"] > 0, y[3:5], seen)
        self.ring[self.count % self.size] = seen * self.p["sensor_gain"]
        self.count += 1

    def now(self) -> tuple[Array, Array]:
        newest = self.count - 1
        if self.size == 2:
            seen = self.ring[newest % 2]
        else:
            whole = self.delay.astype(int)
            part = self.delay - whole
            r, j = np.ogrid[: whole.shape[0], : whole.shape[1]]
            near = (newest - np.minimum(whole, newest)) % self.size
            far = (newest - np.minimum(whole + 1, newest)) % self.size
            seen = np.stack([(1 - part) * self.ring[near, a, r, j] + part * self.ring[far, a, r, j] for a in (0, 1)])
        return seen[0] + self.p["sensor_offset"], seen[1]


class Tracking:
    """The laboratory's controller: feed-forward and feedback through the nominal model; a servo gets the reference.

    Args:
        plant: The kind of machine.
        p: Nominal parameters (what the engineer believes).
        position: Reference, [R, T, n], of the driven joints; likewise `velocity` and `acceleration`.
        dt: Tick [s].
        bandwidth: [rad/s].
    """

    def __init__(
        self,
        plant: Plant,
        p: Rows,
        position: Array,
        velocity: Array,
        acceleration: Array,
        dt: float,
        bandwidth: float = 10.0,
    ) -> None:
        self.plant, self.p, self.dt, self.w = plant, p, dt, bandwidth
        self.position, self.velocity, self.acceleration = position, velocity, acceleration
        self.before: Array | None = None
        self.speed = np.zeros_like(position[:, 0])

    def __call__(self, k: int, measured: Array) -> Array:
        if self.plant.servo:
            return self.position[:, k]
        if self.before is not None:
            share = 1 - np.exp(-2 * np.pi * 25 * self.dt)
            self.speed = self.speed + share * ((measured - self.before) / self.dt - self.speed)
        self.before = measured
        pull = self.acceleration[:, k] + 2 * 0.8 * self.w * (self.velocity[:, k] - self.speed)
        pull = pull + self.w**2 * (self.position[:, k] - measured)
        inertia = np.einsum("rii->ri", self.plant.mass(measured, self.p))
        still = self.plant.bias(measured, np.zeros_like(measured), self.p)
        driven = self.p["gear"] > 0
        force = inertia * pull + still + self.p["b_pos"] * self.velocity[:, k]
        command = np.where(driven, force / np.where(driven, self.p["gear"], 1.0), 0.0)
        top = np.where(driven, self.p["limit"] / np.where(driven, self.p["gear"], 1.0), 0.0)
        return np.clip(command, -top, top)


__all__ = ["H", "Record", "Sensor", "Tracking", "simulate", "start"]
