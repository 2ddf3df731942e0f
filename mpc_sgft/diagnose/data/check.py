"""From columns to episodes: names, time and numbers are checked, gaps split, jitter evened out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import isotonic_regression

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import MIN_SAMPLES, Array, Episode, Index, Table
from mpc_sgft.diagnose.data.units import Axis, check_order, check_speeds, check_units

KINDS = ("qpos", "qvel", "force", "sensor")
GAP = 3.5  # a pause longer than this many sample times starts a new episode
JITTER = 0.01  # of a sample time; more is interpolated away
STRAY = 0.02  # share of stamps that may be off an even clock by more than half a sample
FOLLOW = 0.05  # of what a stamp is off by which the phase of ticks follows it
RECOUNTS = 10  # of the ticks, on a clock that was laid through the last count


def check_settings(window: float | None, seed: int, max_effects: int) -> None:
    """Numbers that no data could save.

    Raises:
        UserError: Which, and what is allowed.
    """
    if window is not None and not (np.isfinite(window) and window > 0):
        raise UserError(f"--window {window:g}: the length of a simulated window is a number above 0 [s].")
    if seed < 0:
        raise UserError(f"--seed {seed}: a whole number from 0 on is needed.")
    if max_effects < 1:
        raise UserError(f"--max-effects {max_effects}: at least one effect must be allowed.")


def episodes(
    table: Table,
    actuators: Sequence[str],
    joints: Mapping[str, Axis],
    servos: Mapping[str, str] | None = None,
    clock: float | None = None,
) -> list[Episode]:
    """The uninterrupted pieces of one file.

    Args:
        table: What was read.
        actuators: The model's actuators.
        joints: The model's hinges and slides.
        servos: Actuators whose command is where a joint shall be -> that joint.
        clock: Sample time [s] to read it at; None: its own.

    Raises:
        UserError: If a column is missing or misnamed, time is not increasing, a number is not finite, units do not
            fit the model or one another, a command comes after what it commands, nothing moves, or there are too few
            samples.
    """
    columns = table.columns
    strange = _names(table, actuators, list(joints))
    time = columns["time"]
    bad = [name for name, values in columns.items() if _known(name) and not np.isfinite(values).all()]
    if bad:
        row = int(np.flatnonzero(~np.isfinite(columns[bad[0]]))[0])
        raise UserError(f"{table.name}: {bad[0]} is not a number in row {row}. Cut or fill such rows first.")
    if len(time) < MIN_SAMPLES:
        raise UserError(f"{table.name}: {len(time)} samples; at least {MIN_SAMPLES} are needed.")
    steps = np.diff(time)
    if (steps <= 0).any():
        row = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise UserError(
            f"{table.name}: time does not increase at row {row} ({time[row - 1]:g} to {time[row]:g} s). If another "
            "episode begins there, say so in a column `episode` (0, 1, …), or write it to a file of its own."
        )
    dt = float(np.median(steps))
    if dt > 0.2:
        raise UserError(f"{table.name}: one sample every {dt:g} s. `time` is in seconds; is this milliseconds?")
    check_units(table, joints)
    _moves(table, actuators, list(joints))
    check_speeds(table, joints)
    check_order(table, servos or {})
    notes = tuple(f"{table.name}: {what}" for what in (table.lost, *table.notes, strange) if what)
    if actuators and all(np.ptp(columns[f"ctrl/{a}"]) == 0 for a in actuators):
        notes += (f"{table.name}: the commands are constant: what acts on commands cannot show here",)
    cuts = np.flatnonzero(steps > GAP * dt) + 1
    pieces = [p for p in np.split(np.arange(len(time)), cuts) if len(p) >= MIN_SAMPLES]
    if not pieces:
        raise UserError(
            f"{table.name}: {len(cuts)} pauses in the recording, and no piece between them has {MIN_SAMPLES} samples. "
            "Record without pauses, or leave it out."
        )
    if len(cuts):
        lost = len(time) - sum(map(len, pieces))
        short = f"; {lost} samples in pieces shorter than {MIN_SAMPLES} were left out" if lost else ""
        notes += (f"{table.name}: {len(cuts)} pauses in the recording; read as {len(pieces)} episodes{short}",)
    if clock is not None:
        notes += (f"{table.name}: read at a sample every {clock:g} s, as the first recording has",)
    built = []
    for k, rows in enumerate(pieces):
        name = table.name if len(pieces) == 1 else f"{table.name}#{k}"
        built.append(_even(name, columns, rows, dt, clock, actuators, list(joints), notes if k == 0 else ()))
    if len(pieces) > 1:
        built = [replace(episode, piece=True) for episode in built]
    return built


def _known(name: str) -> bool:
    return name == "time" or name.split("/")[0] in ("ctrl", *KINDS)


def _names(table: Table, actuators: Sequence[str], joints: Sequence[str]) -> str:
    """Every actuator and every joint of the model needs its column; no ctrl column may be strange to the model.

    Returns:
        Which columns mean nothing here, in words; empty if all are known.
    """
    has = list(table.columns)
    wanted = ["time", *(f"ctrl/{a}" for a in actuators), *(f"qpos/{j}" for j in joints)]
    missing = [name for name in wanted if name not in has]
    if missing:
        near = {name: get_close_matches(name, has, 1, 0.5) for name in missing}
        hints = [f"{name} (nearest: {match[0]})" if match else name for name, match in near.items()]
        raise UserError(
            f"{table.name}: columns missing: {', '.join(hints)}. The file has: {', '.join(has)}. "
            f"The model has the actuators {', '.join(actuators) or '(none)'} and the joints {', '.join(joints)}."
        )
    for kind, known in (("ctrl", actuators), ("force", actuators), ("qvel", joints)):
        for name in has:
            if name.startswith(f"{kind}/") and name.split("/", 1)[1] not in known:
                what = "joint" if kind == "qvel" else "actuator"
                raise UserError(f"{table.name}: {name}: the model has no such {what}. It has: {', '.join(known)}.")
    possible = [*wanted, *(f"force/{a}" for a in actuators), *(f"qvel/{j}" for j in joints)]
    strange = [n for n in has if n not in possible and not n.startswith("sensor/")]
    near = [get_close_matches(n, [p for p in possible if p not in has], 1, 0.6) for n in strange]
    words = [f"{n} (is it {m[0]}?)" if m else n for n, m in zip(strange, near, strict=True)]
    return f"columns that mean nothing here and were not used: {', '.join(words)}" if words else ""


def _moves(table: Table, actuators: Sequence[str], joints: Sequence[str]) -> None:
    still = all(np.ptp(table.columns[f"qpos/{j}"]) == 0 for j in joints)
    if still:
        constant = all(np.ptp(table.columns[f"ctrl/{a}"]) == 0 for a in actuators)
        what = "and the commands are constant too" if constant else "although the commands change"
        raise UserError(f"{table.name}: no joint moves, {what}. Record motion: nothing can be learned from this.")


def _even(
    name: str,
    columns: dict[str, Array],
    rows: Index,
    dt: float,
    clock: float | None,
    actuators: Sequence[str],
    joints: Sequence[str],
    notes: tuple[str, ...],
) -> Episode:
    """One piece on an even clock: positions by cubic interpolation.

    Stamps that scatter around an even clock by less than half a sample, but for a few, are taken for scattered readings
    of a controller that ticks evenly: the command of a row acts from its tick on, and a force that was read before
    shows the command before. Otherwise commands act from the row's own time on, and a note says so. Then, on another
    clock, and where a stamp is off by more, nobody knows which of two a force shows.
    """
    time = columns["time"][rows]
    ticks, even_dt, first = _clock(time, dt)
    strays = float((np.abs(time - first - even_dt * ticks) >= 0.5 * even_dt).mean())
    ticking = strays <= STRAY
    if not ticking:
        notes += (
            f"{name}: {strays:.0%} of the stamps are off an even clock by more than half a sample: each command acts "
            "from its row's own time on. Where the controller ticks evenly, record the times of its ticks",
        )
    came = first + even_dt * ticks if ticking else time  # from when on commands act
    ticking = ticking and clock is None
    if ticking:
        even = first + even_dt * np.arange(ticks[-1] + 1)
    else:
        even_dt = clock or dt
        even = came[0] + even_dt * np.arange(int((came[-1] - came[0]) / even_dt + 1e-6) + 1)
    jitter = len(even) != len(time) or bool(np.abs(time - even).max() > JITTER * dt)
    held = np.clip(np.searchsorted(came, even + 1e-9, side="right") - 1, 0, len(time) - 1)
    off = time[held] - even
    own = np.abs(off) < even_dt / 2  # ticks with a row of their own
    off_tick = np.where(own & ticking, np.where(np.abs(off) > JITTER * dt, off, 0.0), np.nan)

    def smooth(name: str) -> Array:
        values = columns[name][rows]
        if jitter and ticking and name.startswith("force/"):  # it jumps with its command
            return np.interp(even, even[own], values[held[own]])
        return CubicSpline(time, values)(even) if jitter else values

    ctrl = np.stack([columns[f"ctrl/{a}"][rows][held] for a in actuators], 1) if actuators else np.zeros((len(even), 0))
    wanted = [n for n in columns if n.split("/")[0] in KINDS]
    wanted = [n for n in wanted if not n.startswith("qpos/") or n.split("/", 1)[1] in joints]
    return Episode(name, even_dt, ctrl, {n: smooth(n) for n in wanted}, notes, off_tick if jitter else 0.0)


def _clock(time: Array, dt: float) -> tuple[Index, float, float]:
    """The tick of each row of [T], from 0 on, and the even clock's sample time [s] and start [s].

    Steps that are rounded one by one do not add up, so that a phase is carried along. It and dt, which is not quite
    known, follow the stamps slowly. Then each row gets the nearest tick of the clock, and each another: a stamp that is
    nearest to the tick of its neighbour gets the free one beside it.
    """
    at, tick, ticks, row = float(time[0]), 0, np.zeros(len(time), int), np.arange(len(time))
    for i, t in enumerate(time.tolist()):
        n = round((t - at) / dt)
        at += n * dt
        late = t - at
        at += FOLLOW * late
        dt += FOLLOW**2 / 2 * late
        tick = ticks[i] = tick + n
    for _ in range(RECOUNTS):
        even_dt, first = _line(ticks, time)
        counted, ticks = ticks, row + np.round(isotonic_regression((time - first) / even_dt - row).x).astype(int)
        first += even_dt * ticks[0]
        ticks -= ticks[0]
        if (ticks == counted).all():
            break
    return ticks, even_dt, first


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Slope and value at 0 of the line with the least absolute distance, by reweighted least squares."""
    weights = np.ones(len(x))
    for _ in range(20):
        slope, start = np.polyfit(x, y, 1, w=np.sqrt(weights))
        weights = 1 / np.maximum(np.abs(y - start - slope * x), 1e-9)
    return float(slope), float(start)
