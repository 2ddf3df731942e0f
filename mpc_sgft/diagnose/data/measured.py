"""Measured episodes, and the files that hold them: CSV, Parquet, and MCAP as deploy writes it.

Columns: `time` [s], `ctrl/<actuator>`, `qpos/<joint>`, and where measured `qvel/<joint>`, `force/<actuator>`,
`sensor/<name>`. Positions are rad or m. A command is held until the next sample: ctrl[k]
acts from time[k] to time[k + 1]. A column `episode`, or `episode_index`, says which of several a row belongs to.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.episode_file import read_episode

Array = NDArray[np.float64]
Index = NDArray[np.int_]
MIN_SAMPLES = 50  # fewer cannot fill three windows
EPISODE = ("episode", "episode_index")


class Offer(NamedTuple):
    """A column under a name of its own that may be one of ours.

    Attributes:
        column: Its name.
        kind: `qpos`, `qvel` or `ctrl`.
        joint: What the recording calls the joint; empty if it names none.
        quantity: What a command asks for, `position`, `velocity` or `effort`; empty if the recording does not say.
    """

    column: str
    kind: str
    joint: str
    quantity: str = ""


@dataclass(frozen=True)
class Table:
    """One recording as it was read.

    Attributes:
        name: Of the file or the episode.
        columns: By name, each [T].
        lost: What was lost of it, None if nothing.
        notes: What was decided while reading, in words.
        offers: Columns that may be ours under another name.
        held: Columns that were read on another clock than their own: nan where they had not begun yet.
    """

    name: str
    columns: dict[str, Array]
    lost: str | None = None
    notes: tuple[str, ...] = ()
    offers: tuple[Offer, ...] = ()
    held: tuple[str, ...] = ()


@dataclass(frozen=True)
class Episode:
    """One uninterrupted recording on an even clock.

    Attributes:
        name: Of the file, with a number for each piece if it had gaps.
        dt: Seconds between samples.
        ctrl: Commands in the model's order, [T, nu].
        signals: `qpos/…`, `qvel/…`, `force/…`, `sensor/…` -> [T].
        notes: What was noticed while reading, in words.
        off_tick: Seconds after its tick at which each sample was read, negative before, [T] or a number; nan: unknown.
        piece: Whether pauses cut it out of a longer recording.
    """

    name: str
    dt: float
    ctrl: Array
    signals: dict[str, Array]
    notes: tuple[str, ...] = field(default=())
    off_tick: Array | float = 0.0
    piece: bool = False

    @property
    def seconds(self) -> float:
        return len(self.ctrl) * self.dt


def read_table(path: Path) -> Table:
    """Read one file into columns.

    Raises:
        UserError: If it is empty or not what its ending says.
    """
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        return _read_mcap(path)
    columns = _read_parquet(path) if suffix == ".parquet" else _read_csv(path)
    return Table(path.stem, columns)


def by_episode(table: Table) -> list[Table]:
    """A table for each number in its column of episodes, in the order of their first rows; itself if it has none.

    Raises:
        UserError: If some rows are of no episode.
    """
    name = next((name for name in EPISODE if name in table.columns), None)
    if name is None:
        return [table]
    columns = {key: values for key, values in table.columns.items() if key != name}
    which = table.columns[name]
    if not np.isfinite(which).all():
        row = int(np.flatnonzero(~np.isfinite(which))[0])
        raise UserError(f"{table.name}: {name} is not a number in row {row}. Say of every row which episode it is of.")
    numbers, first = np.unique(which, return_index=True)
    rows = {number: which == number for number in numbers[np.argsort(first)]}
    return [
        replace(table, name=f"{table.name}-{_short(number)}", columns={key: x[mine] for key, x in columns.items()})
        for number, mine in rows.items()
    ]


def _short(number: float) -> str:
    return str(int(number)) if number == int(number) else repr(float(number))


def _read_csv(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            header = [name.strip() for name in next(rows, [])]
            body = [row for row in rows if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: not a CSV file in UTF-8 ({error}). Save it as comma-separated text.") from error
    if not header or not body:
        raise UserError(f"{path}: empty. A CSV episode has a header line and one row per sample.")
    if twice := sorted({name for name in header if header.count(name) > 1}):
        raise UserError(f"{path}: the column {twice[0]!r} is there {header.count(twice[0])} times; keep one of them.")
    for i, row in enumerate(body):
        if len(row) != len(header):
            raise UserError(f"{path}: line {i + 2} has {len(row)} values, the header names {len(header)} columns.")
    try:
        values = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in body])
    except ValueError as error:
        raise UserError(f"{path}: {error}. All columns must be numbers.") from error
    return {name: values[:, i] for i, name in enumerate(header)}


def _read_parquet(path: Path) -> dict[str, Array]:
    import pyarrow.parquet
    from pyarrow.lib import ArrowException

    try:
        table = pyarrow.parquet.read_table(path)
        columns = {name: np.asarray(table[name].to_numpy(), float) for name in table.column_names}
    except (ArrowException, ValueError, TypeError) as error:
        raise UserError(f"{path}: cannot be read as Parquet with numeric columns ({error}).") from error
    if not table.num_rows or not columns:
        raise UserError(f"{path}: empty. A Parquet episode has one row per sample.")
    return columns


def _read_mcap(path: Path) -> Table:
    """An episode of `deploy`.

    A robot's backend names itself, and records with a state the command that it sends then. The simulator does not: it
    records with a state the command and force of the step that ends there, which are of the sample before.
    """
    try:
        episode = read_episode(path)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not episode.joints:
        raise UserError(f"{path}: no joint samples in it ({episode.lost or 'the backend recorded none'}).")
    late = 0 if "backend" in episode.metadata else 1
    count = len(episode.joints["time"]) - late
    columns: dict[str, Array] = {"time": episode.joints["time"][:count]}
    joints, actuators = episode.metadata.get("joint_names", []), episode.metadata.get("actuator_names", [])
    for kind, names in (("qpos", joints), ("qvel", joints), ("ctrl", actuators), ("force", actuators)):
        values, first = episode.joints.get(kind), late if kind in ("ctrl", "force") else 0
        for i, name in enumerate(names if values is not None else []):
            if i < values.shape[1]:  # pyright: ignore[reportOptionalMemberAccess]
                columns[f"{kind}/{name}"] = values[first : first + count, i]  # pyright: ignore[reportOptionalSubscript]
    told = "commands and forces of the simulator's record act in the step before their time: read one sample earlier"
    return Table(path.stem, columns, episode.lost, (told,) if late else ())


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as a CSV episode."""
    header = ",".join(columns)
    np.savetxt(path, np.stack(list(columns.values()), 1), delimiter=",", header=header, comments="", fmt="%.10g")
