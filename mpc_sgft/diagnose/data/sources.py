"""What recordings there are behind the paths that a person gives, and the tables in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data import lerobot, rosbag
from mpc_sgft.diagnose.data.mapping import Source, mapped
from mpc_sgft.diagnose.data.matching import Machine, matched
from mpc_sgft.diagnose.data.measured import Table, by_episode, read_table

SUFFIXES = (".csv", ".parquet", ".mcap", ".db3")
ALSO = "a ROS 2 bag or a LeRobotDataset"
ELSE = {
    ".bag": "a bag of ROS 1: `rosbags-convert --src X.bag --dst X` makes one of ROS 2",
    ".yaml": "give the folder, if this is a bag's metadata.yaml",
}


class Recording(NamedTuple):
    """One source.

    Attributes:
        words: What it says of itself beyond its tables, in lines; empty if nothing.
        tables: f(columns that a mapping takes positions from, joints of the model) -> its tables under their own names.
    """

    words: str
    tables: Callable[[Iterable[str], Sequence[str]], list[Table]]


def sources(data: Sequence[str | Path]) -> list[Path]:
    """The recordings named by paths and folders, in order: files, and folders that are one recording.

    Raises:
        UserError: If a path is absent, a folder holds no recording, or a file has another ending.
    """
    found: list[Path] = []
    for item in map(Path, data):
        if _is_one(item):
            found.append(item)
        elif item.is_dir():
            inside = sorted(p for p in item.iterdir() if _is_one(p))
            if not inside:
                raise UserError(
                    f"{item}: no episodes in this folder. Episodes are {', '.join(SUFFIXES)} files, {ALSO}."
                )
            found += inside
        elif not item.exists():
            raise UserError(f"{item}: no such file or folder. Give the episodes' files, or the folder that holds them.")
        else:
            suffix = item.suffix.lower()
            why = ELSE.get(suffix, f"episodes are {', '.join(SUFFIXES)} files, {ALSO}")
            raise UserError(f"{item}: unknown ending {item.suffix!r}: {why}.")
    if not found:
        raise UserError("no data given: name at least one episode file or folder (--data).")
    return found


def opened(path: Path) -> Recording:
    """A source.

    Raises:
        UserError: If it cannot be read.
    """
    if lerobot.is_dataset(path):
        return Recording(lerobot.describe(path), lambda used, joints: lerobot.read_dataset(path))
    if rosbag.is_bag(path):
        bag = rosbag.read_bag(path)
        return Recording(rosbag.describe_bag(bag), lambda used, joints: [rosbag.table_of(bag, used, joints)])
    return Recording("", lambda used, joints: by_episode(read_table(path)))


def tables(recording: Recording, mapping: Mapping[str, Source], machine: Machine | None) -> list[Table]:
    """The tables of a source with the columns of a mapping in them.

    Raises:
        UserError: If a mapped column is absent, or it is not clear whose clock to take.
    """
    used = [source.column for name, source in mapping.items() if name.startswith("qpos/")]
    return [mapped(table, mapping) for table in recording.tables(used, machine.joints if machine else ())]


def named(table: Table, machine: Machine) -> Table:
    """The table with what matches the model's names, from where all that is used of it has begun.

    Raises:
        UserError: If names leave a choice, or a command never begins.
    """
    table = matched(table, machine)
    kinds = ("ctrl/", "qpos/", "qvel/", "force/", "sensor/")
    late = {n: np.isfinite(table.columns[n]) for n in table.held if n.startswith(kinds)}
    never = [name for name, there in late.items() if not there.any()]
    if never:
        raise UserError(f"{table.name}: {never[0]} has no message before the last sample of the clock.")
    if all(there[0] and there[-1] for there in late.values()):
        return table
    count = len(table.columns["time"])
    first = max(int(there.argmax()) for there in late.values())
    last = count - max(int(there[::-1].argmax()) for there in late.values())
    gone = count - (last - first)
    note = f"{gone} samples before the first command, or outside of what is used, are left out"
    return replace(table, columns={n: x[first:last] for n, x in table.columns.items()}, notes=(*table.notes, note))


def _is_one(path: Path) -> bool:
    if path.is_dir():
        return lerobot.is_dataset(path) or rosbag.is_bag(path)
    return path.is_file() and path.suffix.lower() in SUFFIXES
