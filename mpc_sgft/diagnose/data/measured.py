"""Measured episodes, from CSV, Parquet or MCAP, checked against the model they claim to belong to.

Columns: `time` [s], `ctrl/<actuator>`, `qpos/<joint>`, and where measured `qvel/<joint>`, `force/<actuator>`,
`sensor/<name>`. Positions are rad or m. A command is held until the next sample: ctrl[k]
acts from time[k] to time[k + 1].
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.episode_file import read_episode

Array = NDArray[np.float64]
Index = NDArray[np.int_]
SUFFIXES = (".csv", ".parquet", ".mcap")
MIN_SAMPLES = 50  # fewer cannot fill three windows


@dataclass(frozen=True)
class Table:
    """One file as it was read: columns by name, each [T], and what was lost of it (None if nothing)."""

    name: str
    columns: dict[str, Array]
    lost: str | None = None


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
    """

    name: str
    dt: float
    ctrl: Array
    signals: dict[str, Array]
    notes: tuple[str, ...] = field(default=())
    off_tick: Array | float = 0.0

    @property
    def seconds(self) -> float:
        return len(self.ctrl) * self.dt


def files(data: Sequence[str | Path]) -> list[Path]:
    """The episode files named by paths and folders, in order.

    Raises:
        UserError: If a path is absent, a folder holds no episode, or a file has another ending.
    """
    found: list[Path] = []
    for item in map(Path, data):
        if item.is_dir():
            inside = sorted(p for p in item.iterdir() if p.suffix.lower() in SUFFIXES)
            if not inside:
                raise UserError(f"{item}: no episodes in this folder. One episode is one {', '.join(SUFFIXES)} file.")
            found += inside
        elif not item.exists():
            raise UserError(f"{item}: no such file or folder. Give the episodes' files, or the folder that holds them.")
        elif item.suffix.lower() not in SUFFIXES:
            raise UserError(f"{item}: unknown ending {item.suffix!r}. Episodes are {', '.join(SUFFIXES)} files.")
        else:
            found.append(item)
    if not found:
        raise UserError("no data given: name at least one episode file or folder (--data).")
    return found


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
        return {name: np.asarray(table[name].to_numpy(), float) for name in table.column_names}
    except (ArrowException, ValueError) as error:
        raise UserError(f"{path}: cannot be read as Parquet with numeric columns ({error}).") from error


def _read_mcap(path: Path) -> Table:
    try:
        episode = read_episode(path)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not episode.joints:
        raise UserError(f"{path}: no joint samples in it ({episode.lost or 'the backend recorded none'}).")
    columns: dict[str, Array] = {"time": episode.joints["time"]}
    joints, actuators = episode.metadata.get("joint_names", []), episode.metadata.get("actuator_names", [])
    for kind, names in (("qpos", joints), ("qvel", joints), ("ctrl", actuators), ("force", actuators)):
        values = episode.joints.get(kind)
        for i, name in enumerate(names if values is not None else []):
            if i < values.shape[1]:  # pyright: ignore[reportOptionalMemberAccess]
                columns[f"{kind}/{name}"] = values[:, i]  # pyright: ignore[reportOptionalSubscript]
    return Table(path.stem, columns, episode.lost)


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as a CSV episode."""
    header = ",".join(columns)
    np.savetxt(path, np.stack(list(columns.values()), 1), delimiter=",", header=header, comments="", fmt="%.10g")
