"""What is in recordings, before anything runs: columns and what they map to, clocks, gaps, ranges, excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.check import GAP, episodes
from mpc_sgft.diagnose.data.mapping import Source
from mpc_sgft.diagnose.data.measured import Array, Table
from mpc_sgft.diagnose.data.smooth import noise_of
from mpc_sgft.diagnose.data.sources import named, opened, sources, tables
from mpc_sgft.diagnose.simulation.plant import Plant, driven

ENOUGH = 100.0  # times the noise that a position must move for small effects to show
FEW = 4  # reversals, below which friction and play hardly show
OURS = ("time", "ctrl", "qpos", "qvel", "force", "sensor")


def inspect(data: Sequence[str | Path], plant: Plant | None = None, mapping: Mapping[str, Source] | None = None) -> str:
    """What a person wants to know of recordings, in lines.

    Args:
        data: Files and folders.
        plant: The model that they belong to; columns are only described if None.
        mapping: Columns of other names.

    Raises:
        UserError: If a file is not there or cannot be read at all.
    """
    parts: list[str] = []
    for path in sources(data):
        recording = opened(path)
        parts += [recording.words] if recording.words else []
        try:
            found = tables(recording, mapping or {}, None if plant is None else plant.machine())
        except UserError as error:
            if not recording.words:
                raise
            parts.append(f"  diagnose would stop: {error}")
        else:
            parts += [_table(table, plant) for table in found]
    return "\n\n".join(parts)


def _table(table: Table, plant: Plant | None) -> str:
    stop = ""
    if plant is not None:
        try:
            table = named(table, plant.machine())
            plant = driven(plant, [table])
        except UserError as error:
            stop = str(error)
    columns = table.columns
    lines = [_clock(table)]
    if table.lost:
        lines.append(f"  lost: {table.lost}")
    width = max(map(len, columns))
    lines += [f"  {name:<{width}}  {_means(name, plant):<12} {_range(name, x)}" for name, x in columns.items()]
    lines += [f"  {line}" for line in _missing(table, plant)]
    if stop:
        lines.append(f"  diagnose would stop: {stop}")
    elif plant is not None:
        try:
            found = episodes(table, plant.actuators, plant.axes(), plant.servos())
        except UserError as error:
            lines.append(f"  diagnose would stop: {error}")
        else:
            pieces = f" in {len(found)} pieces" if len(found) > 1 else ""
            lines.append(f"  diagnose can use it{pieces}")
            lines += [f"  note: {note}" for note in plant.notes]
            lines += [f"  note: {note.removeprefix(f'{table.name}: ')}" for e in found for note in e.notes]
    return "\n".join(lines)


def _clock(table: Table) -> str:
    time = table.columns.get("time")
    count = len(next(iter(table.columns.values())))
    if time is None:
        return f"{table.name}: {count} samples, no column `time`"
    steps = np.diff(time)
    if not len(steps) or not np.isfinite(steps).all() or (steps <= 0).any():
        return f"{table.name}: {count} samples, time does not always increase"
    dt = float(np.median(steps))
    jitter, gaps = float(np.std(steps[steps <= GAP * dt]) / dt), int((steps > GAP * dt).sum())
    pauses = f", {gaps} pauses, the longest {steps.max():.3g} s" if gaps else ""
    clock = f"{time[-1] - time[0]:.4g} s, {1 / dt:.4g} Hz, steps scatter by {jitter:.1%}{pauses}"
    return f"{table.name}: {count} samples, {clock}"


def _means(name: str, plant: Plant | None) -> str:
    kind, _, part = name.partition("/")
    if name != "time" and (kind not in OURS or not part):
        return "not used"
    if plant is None or name == "time":
        return kind
    known = {"ctrl": plant.actuators, "force": plant.actuators, "qpos": plant.joints, "qvel": plant.joints}
    return kind if part in known.get(kind, plant.sensors()) else "not in model"


def _range(name: str, x: Array) -> str:
    bad = int((~np.isfinite(x)).sum())
    if bad:
        return f"{bad} of {len(x)} values are no numbers"
    words = f"{x.min():.4g} to {x.max():.4g}"
    if name == "time":
        return words
    if not np.ptp(x):
        return f"constant, {x[0]:.4g}"
    kind = name.partition("/")[0]
    if kind == "ctrl":
        return f"{words}, {len(np.unique(x))} levels"
    if len(x) < 6:
        return words
    noise = noise_of(x)
    words += f", noise {noise:.2g}"
    if kind == "qpos":
        span, turns = float(np.ptp(x)) / max(noise, 1e-300), reversals(x, noise)
        words += f", moves {span:.3g} times that, {turns} reversals"
        if span < ENOUGH:
            words += ": too little for small effects"
        elif turns < FEW:
            words += ": friction and play hardly show"
    return words


def reversals(x: Array, noise: float) -> int:
    """How often a signal [T] turns back, by more than the noise."""
    turned, direction, extreme, least = 0, 0, x[0], 10 * noise
    for value in x:
        if direction >= 0 and value < extreme - least:
            turned, direction, extreme = turned + (direction > 0), -1, value
        elif direction <= 0 and value > extreme + least:
            turned, direction, extreme = turned + (direction < 0), 1, value
        elif direction and (value - extreme) * direction > 0:
            extreme = value
    return turned


def _missing(table: Table, plant: Plant | None) -> list[str]:
    """Columns that the model needs, with what may be meant."""
    wanted = ["time"] if plant is None else ["time", *(f"ctrl/{a}" for a in plant.actuators)]
    wanted += [] if plant is None else [f"qpos/{j}" for j in plant.joints]
    out = []
    for name in (n for n in wanted if n not in table.columns):
        free = [n for n in table.columns if n.partition("/")[0] not in OURS]
        near = get_close_matches(name.rpartition("/")[2], free, 1, 0.4)
        hint = f"; if it is {near[0]}: --map '{name}={near[0]}'" if near else ""
        out.append(f"missing: {name}{hint}")
    return out
