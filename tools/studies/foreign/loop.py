"""One machine in closed loop, or driven by recorded commands, in whatever engine; times of the command are exact.

Every tick the controller reads the newest sample and sends a command, which passes gain, offset, dead band and delay
(here), then lag, drive and limit (in the engine).
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np

from tools.studies.blind.plants import Array


class Unable(ValueError):
    """What an engine has no way to do."""


class Engine(Protocol):
    """A machine that some physics engine moves.

    Attributes:
        step: Delays come in multiples of this [s]; 0 if any time will do.
        drives: How many there are, a.
        q, v: Position and speed of the links now, [n].
    """

    step: float
    drives: int

    @property
    def q(self) -> Array: ...
    @property
    def v(self) -> Array: ...
    def force(self, command: Array) -> Array:
        """What the drives exert now under this command, [a]."""
        ...

    def reset(self, q: Array, v: Array, command: Array) -> None:
        """Put it there, with a command that has been in force for long, [a]."""
        ...

    def advance(self, command: Array, seconds: float) -> None:
        """Let it move under one command, [a]."""
        ...


class Sensor(NamedTuple):
    """Noise [T, n] and width of a count [n] of the encoders."""

    noise: Array
    count: Array


class Record(NamedTuple):
    """Samples at the ticks: command in force from then on [T, a], what was read, and what was true, [T, n].

    `clean` and `clean_speed` are what a sensor with its gain, offset and delay, but without noise and counts, reads.
    """

    ctrl: Array
    read: Array
    q: Array
    v: Array
    clean: Array
    clean_speed: Array
    force: Array


Commands = Array | Callable[[int, Array], Array]


def simulate(
    engine: Engine,
    p: Mapping[str, Array],
    first: tuple[Array, Array],
    ticks: int,
    dt: float,
    commands: Commands,
    sensor: Sensor | None = None,
) -> Record:
    """Run one machine.

    Args:
        engine: It; its drives and sensors are those of `p`.
        p: One row of `truths.rows`.
        first: Position and speed at the start, [n] each.
        ticks: T.
        dt: [s] of a tick.
        commands: [T, a], or a controller (tick, what was read [n]) -> command [a].
        sensor: Of the encoders; None if they are ideal.
    """
    n, a = len(first[0]), engine.drives
    sent, force = np.zeros((ticks, a)), np.zeros((ticks, a))
    read, q, v, clean, speed = (np.zeros((ticks, n)) for _ in range(5))
    late = [float(x) for x in p["delay"][0, :a]]
    back = [int((x + 1e-9) // dt) for x in late]
    rest = [max(x - k * dt, 0.0) for x, k in zip(late, back, strict=True)]
    edges = sorted({0.0, dt, *(r for r in rest if r > 1e-9)})
    for k in range(ticks):
        q[k], v[k] = first if k == 0 else (engine.q, engine.v)
        clean[k], speed[k] = _sensed(p, q[: k + 1], v[: k + 1], dt)
        read[k] = clean[k] if sensor is None else np.round((clean[k] + sensor.noise[k]) / sensor.count) * sensor.count
        sent[k] = commands(k, read[k]) if callable(commands) else commands[k]
        if k == 0:
            engine.reset(*first, reaching(p, sent[0]))
        for begin, end in zip(edges, edges[1:], strict=False):
            which = [max(k - b - (r > begin + 1e-9), 0) for b, r in zip(back, rest, strict=True)]
            command = reaching(p, sent[which, range(a)])
            if begin == 0.0:
                force[k] = engine.force(command)
            engine.advance(command, end - begin)
    return Record(sent, read, q, v, clean, speed, force)


def reaching(p: Mapping[str, Array], sent: Array) -> Array:
    """What is left of a command on its way to the drive, [a]."""
    raw = sent * p["gain"][0, : len(sent)] + p["offset"][0, : len(sent)]
    dead = p["deadband"][0, : len(sent)]
    return raw - np.clip(raw, -dead, dead)


def _sensed(p: Mapping[str, Array], q: Array, v: Array, dt: float) -> tuple[Array, Array]:
    """Newest position and speed as the sensors see them, [n] each; between ticks by cubic Hermite."""
    if not p["sensor_delay"].any():
        return q[-1] * p["sensor_gain"][0] + p["sensor_offset"][0], v[-1] * p["sensor_gain"][0]
    late = p["sensor_delay"][0] / dt
    whole = np.floor(late + 1e-9).astype(int)
    x, j, newest = np.maximum(late - whole, 0.0), np.arange(q.shape[1]), len(q) - 1
    near, far = np.maximum(newest - whole, 0), np.maximum(newest - whole - 1, 0)
    a, b, s, e = q[near, j], q[far, j], -dt * v[near, j], -dt * v[far, j]  # backward in time from `near` to `far`
    s, e = (np.where(near == far, 0.0, z) for z in (s, e))
    seen = a + x * (s + x * (3 * (b - a) - 2 * s - e + x * (2 * (a - b) + s + e)))
    rate = (1 - x) * v[near, j] + x * v[far, j]
    return seen * p["sensor_gain"][0] + p["sensor_offset"][0], rate * p["sensor_gain"][0]
