"""LeRobotDataset folders, v3 and v2: one table an episode, a column for each number that was recorded.

    meta/info.json                          fps, features with the names of their entries, data_path
    meta/episodes/chunk-*/file-*.parquet    v3: where each episode is; v2: meta/episodes.jsonl
    data/chunk-*/file-*.parquet             v3: rows of several episodes; v2: a file each

`observation.state` [J] becomes `observation.state/<name>`. Action k was sent after observation k was read. The format
knows no units. Images and words are left out.

Source: huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Array, Offer, Table

if TYPE_CHECKING:
    import pyarrow

INFO = "meta/info.json"
BOOKS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
QUANTITIES = {"": "", "pos": "position", "vel": "velocity", "torque": "effort", "effort": "effort"}
STAMP = 1e-3  # [s] by which a stamp may differ from frame/fps and still be the same, rounded


class Info(NamedTuple):
    """What meta/info.json says: version 2 or 3, as it is spelled, frames a second, features, where rows are, chunks.

    A chunk is a folder of so many episodes, in v2.
    """

    version: int
    spelled: str
    fps: float
    features: dict[str, dict[str, Any]]
    data_path: str
    chunk: int


def is_dataset(path: Path) -> bool:
    return (path / INFO).is_file()


def read_dataset(folder: Path) -> list[Table]:
    """All episodes of a dataset.

    Raises:
        UserError: If the version is another, a file is absent or broken, or an episode is not as long as it should be.
    """
    info = read_info(folder)
    files: dict[Path, list[tuple[int, int]]] = {}
    for path, episode, length in _episodes(folder, info):
        files.setdefault(path, []).append((episode, length))
    return [table for path, inside in files.items() for table in _tables(folder, info, path, inside)]


def describe(folder: Path) -> str:
    """Version, rate and features, in lines."""
    info = read_info(folder)
    lines = [f"{folder}: LeRobotDataset {info.spelled}, {info.fps:g} frames/s"]
    for key, feature in info.features.items():
        if key not in BOOKS:
            lines.append(f"  {key}: {feature.get('dtype')} {feature.get('shape')}")
    return "\n".join(lines)


def read_info(folder: Path) -> Info:
    """What meta/info.json says.

    Raises:
        UserError: If it is broken or of another version.
    """
    path = folder / INFO
    try:
        said = json.loads(path.read_text())
        spelled, data_path, chunk = str(said["codebase_version"]), str(said["data_path"]), int(said["chunks_size"])
        fps, features = float(said["fps"]), {str(k): dict(v) for k, v in said["features"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not what LeRobot writes ({error!r}); fps, features, data_path, …") from error
    version = spelled.removeprefix("v").partition(".")[0]
    if version not in ("2", "3"):
        raise UserError(f"{path}: LeRobotDataset {spelled}; versions 2 and 3 can be read. LeRobot converts older ones.")
    if not (fps > 0 and chunk > 0):
        raise UserError(f"{path}: fps is {fps:g} and chunks_size {chunk}; both are above 0.")
    return Info(int(version), spelled, fps, features, data_path, chunk)


def _episodes(folder: Path, info: Info) -> list[tuple[Path, int, int]]:
    """File, number and length of each episode."""
    try:
        if info.version == 3:
            return _listed(folder, info)
        path = folder / "meta" / "episodes.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
        out = []
        for row in rows:
            k = int(row["episode_index"])
            out.append(
                (folder / info.data_path.format(episode_chunk=k // info.chunk, episode_index=k), k, int(row["length"]))
            )
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: not there, so the dataset is incomplete.") from error
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise UserError(
            f"{folder}: the list of episodes is not what LeRobot {info.spelled} writes ({error!r})."
        ) from error
    return _some(folder, out)


def _listed(folder: Path, info: Info) -> list[tuple[Path, int, int]]:
    keys, out = ["episode_index", "length", "data/chunk_index", "data/file_index"], []
    for path in sorted((folder / "meta" / "episodes").glob("chunk-*/file-*.parquet")):
        for episode, length, chunk, file in zip(*_parquet(path, keys).to_pydict().values(), strict=True):
            where = folder / info.data_path.format(chunk_index=int(chunk), file_index=int(file))
            out.append((where, int(episode), int(length)))
    return _some(folder, out)


def _some(folder: Path, found: list[tuple[Path, int, int]]) -> list[tuple[Path, int, int]]:
    if not found:
        raise UserError(f"{folder}: no episodes are listed in meta/. A recording ends with `dataset.finalize()`.")
    return found


def _parquet(path: Path, keys: list[str]) -> pyarrow.Table:
    import pyarrow.parquet
    from pyarrow.lib import ArrowException

    if not path.is_file():
        raise UserError(f"{path}: not there, so the dataset is incomplete.")
    try:
        has = pyarrow.parquet.read_schema(path).names
        if missing := [key for key in keys if key not in has]:
            raise UserError(f"{path}: no column {missing[0]!r}. It has: {', '.join(has)}.")
        return pyarrow.parquet.read_table(path, columns=keys)
    except (ArrowException, ValueError) as error:
        raise UserError(f"{path}: cannot be read as Parquet ({error}). Was the recording finished?") from error


def _tables(folder: Path, info: Info, path: Path, inside: list[tuple[int, int]]) -> list[Table]:
    """The episodes in one file."""
    kept = [key for key, feature in info.features.items() if key not in BOOKS and _numbers(feature)]
    rows = _parquet(path, ["timestamp", "frame_index", "episode_index", *kept])
    books = {key: rows[key].to_numpy() for key in ("timestamp", "frame_index", "episode_index")}
    columns: dict[str, Array] = {"time": _clock(books["timestamp"], books["frame_index"], info.fps)}
    offers: list[Offer] = []
    for key in kept:
        values = _matrix(path, key, rows[key])
        names = names_of(info.features[key], values.shape[1])
        for i, name in enumerate(names):
            column = f"{key}/{name}" if name else key
            columns[column] = values[:, i]
            offers += _offer(column, key, name)
    out = []
    for episode, length in sorted(inside):
        mine = np.flatnonzero(books["episode_index"] == episode)
        if len(mine) != length:
            raise UserError(f"{path}: {len(mine)} frames of episode {episode}, {length} are listed in meta/.")
        name = f"{folder.resolve().name}-{episode:06d}"
        out.append(Table(name, {n: x[mine] for n, x in columns.items()}, offers=tuple(offers)))
    return out


def _numbers(feature: dict[str, Any]) -> bool:
    kind = str(feature.get("dtype"))
    return kind.startswith(("float", "int", "uint", "bool")) and len(feature.get("shape") or ()) <= 1


def _matrix(path: Path, key: str, column: pyarrow.ChunkedArray) -> Array:
    """A feature's numbers, [T, size]; nan where there is none."""
    import pyarrow
    import pyarrow.compute

    array = column.combine_chunks()
    if not (pyarrow.types.is_list(array.type) or pyarrow.types.is_fixed_size_list(array.type)):
        return np.asarray(array.to_numpy(zero_copy_only=False), float)[:, None]
    sizes = set(pyarrow.compute.list_value_length(array).to_pylist())
    if array.null_count or len(sizes) != 1:
        found = ", ".join(str(size) for size in sizes)
        raise UserError(f"{path}: {key} has rows of {found} numbers; all need the same.")
    return np.asarray(array.flatten().to_numpy(zero_copy_only=False), float).reshape(len(array), -1)


def _clock(stamps: np.ndarray, frames: np.ndarray, fps: float) -> Array:
    """Time of each frame [s]: frame/fps where the stamps, which are rounded to float32, say the same."""
    even, stamps = np.asarray(frames, float) / fps, np.asarray(stamps, float)
    return even if np.abs(stamps - even).max(initial=0.0) < STAMP else stamps


def names_of(feature: dict[str, Any], size: int) -> list[str]:
    """A name for each entry of a feature; numbers if it has none that fit, and "" if it is a single one."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}, or {name: its place}
        places = all(isinstance(value, int) for value in names.values())
        names = sorted(names, key=names.__getitem__) if places else [n for v in names.values() if v for n in v]
    if isinstance(names, list) and len(names) == size and len({str(n) for n in names}) == size:
        return [str(name) for name in names]
    return [str(i) for i in range(size)] if size > 1 else [""]


def _offer(column: str, key: str, name: str) -> list[Offer]:
    joint, dot, suffix = name.rpartition(".")
    if suffix not in QUANTITIES or not dot:
        joint, suffix = name, ""
    quantity = QUANTITIES[suffix]
    if key == "action":
        return [Offer(column, "ctrl", joint, quantity)]
    if key == "observation.state" and quantity in ("", "position"):
        return [Offer(column, "qpos", joint, "position")]
    return []
