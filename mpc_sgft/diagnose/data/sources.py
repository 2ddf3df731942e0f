"""What recordings there are behind the paths that a person gives, and the tables in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data import lerobot
from mpc_sgft.diagnose.data.mapping import Source, mapped
from mpc_sgft.diagnose.data.matching import Machine, matched
from mpc_sgft.diagnose.data.measured import Table, read_table

SUFFIXES = (".csv", ".parquet", ".mcap")
ALSO = "or the folder of a LeRobotDataset"


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
                    f"{item}: no episodes in this folder. One episode is one {', '.join(SUFFIXES)} file, {ALSO}."
                )
            found += inside
        elif not item.exists():
            raise UserError(f"{item}: no such file or folder. Give the episodes' files, or the folder that holds them.")
        else:
            raise UserError(
                f"{item}: unknown ending {item.suffix!r}. Episodes are {', '.join(SUFFIXES)} files, {ALSO}."
            )
    if not found:
        raise UserError("no data given: name at least one episode file or folder (--data).")
    return found


def tables(path: Path) -> list[Table]:
    """The recordings in one source, under their own names.

    Raises:
        UserError: If it cannot be read.
    """
    return lerobot.read_dataset(path) if path.is_dir() else [read_table(path)]


def named(table: Table, mapping: Mapping[str, Source], machine: Machine) -> Table:
    """The table with our columns: those of the mapping, and what matches the model's names.

    Raises:
        UserError: If a mapped column is absent, or names leave a choice.
    """
    return matched(mapped(table, mapping), machine)


def describe(path: Path) -> str:
    """What a source says of itself beyond its tables, in lines; empty if nothing."""
    return lerobot.describe(path) if path.is_dir() else ""


def _is_one(path: Path) -> bool:
    return lerobot.is_dataset(path) if path.is_dir() else path.is_file() and path.suffix.lower() in SUFFIXES
