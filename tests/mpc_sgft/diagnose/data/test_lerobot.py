"""LeRobotDataset folders, written here in the layout that lerobot 0.4 was seen to write."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.lerobot import names_of, read_dataset
from mpc_sgft.diagnose.data.matching import Drive, Machine, matched
from mpc_sgft.diagnose.data.measured import Table, write_csv
from mpc_sgft.diagnose.data.sources import opened, sources, tables

LENGTHS = (80, 60, 70)
PATHS = {
    3: "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    2: "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
}
NAMES = {"observation.state": ["pan.pos", "lift.pos"], "action": ["pan.pos", "lift.pos"], "next.reward": None}
ARM = Machine(["pan", "lift"], {"pan": Drive("pan", "position"), "lift_servo": Drive("lift", "position")})


def numbers(length: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    vectors = {key: rng.normal(size=(length, 2)).astype(np.float32) for key in ("observation.state", "action")}
    return {**vectors, "next.reward": rng.normal(size=length).astype(np.float32)}


def write_dataset(
    folder: Path,
    episodes: list[dict[str, np.ndarray]],
    names: dict = NAMES,
    *,
    version: int = 3,
    fps: float = 50,
    files: tuple[int, ...] = (0, 0, 1),
    **changed: object,
) -> Path:
    """Episodes as rows of shared files (v3; `files` says in which each is) or in a file each (v2)."""
    (folder / "meta").mkdir(parents=True)
    features = {
        key: {"dtype": "float32", "shape": list(x.shape[1:]) or [1], "names": names[key]}
        for key, x in episodes[0].items()
    }
    features |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in ("frame_index", "episode_index")}
    features |= {"timestamp": {"dtype": "float32", "shape": [1], "names": None}}
    features |= {"observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": None}}
    info = {"codebase_version": f"v{version}.{'0' if version == 3 else '1'}", "fps": fps, "features": features}
    info |= {"data_path": PATHS.get(version, ""), "chunks_size": 1000, **changed}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    parts: dict[str, list[pa.Table]] = {}
    for k, columns in enumerate(episodes):
        length = len(columns["action"])
        arrays: dict[str, pa.Array] = {}
        for key, x in columns.items():
            arrays[key] = pa.array(x) if x.ndim == 1 else pa.FixedSizeListArray.from_arrays(x.ravel(), x.shape[1])
        frame = np.arange(length)
        arrays |= {"timestamp": pa.array((frame / fps).astype(np.float32)), "frame_index": pa.array(frame)}
        arrays |= {"episode_index": pa.array(np.full(length, k))}
        place = {"chunk_index": 0, "file_index": files[k]} if version == 3 else {"episode_chunk": 0, "episode_index": k}
        parts.setdefault(PATHS[version if version == 3 else 2].format(**place), []).append(pa.table(arrays))
    for path, inside in parts.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables(inside), folder / path)
    lengths = [len(e["action"]) for e in episodes]
    if version == 3:
        path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        path.parent.mkdir(parents=True)
        listed = {"episode_index": range(len(episodes)), "length": lengths, "data/chunk_index": [0] * len(episodes)}
        pq.write_table(
            pa.table({**{k: list(v) for k, v in listed.items()}, "data/file_index": list(files[: len(episodes)])}), path
        )
    else:
        lines = [json.dumps({"episode_index": k, "tasks": [], "length": n}) for k, n in enumerate(lengths)]
        (folder / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("version", [3, 2])
def test_each_episode_is_a_table_of_named_columns(version: int, tmp_path: Path) -> None:
    told = [numbers(n, seed) for seed, n in enumerate(LENGTHS)]
    write_dataset(tmp_path / "pick", told, version=version)
    assert sources([tmp_path]) == sources([tmp_path / "pick"]) == [tmp_path / "pick"]
    found = tables(opened(tmp_path / "pick"), {}, None)
    assert [t.name for t in found] == ["pick-000000", "pick-000001", "pick-000002"]
    for table, truth in zip(found, told, strict=True):
        np.testing.assert_array_equal(table.columns["time"], np.arange(len(truth["action"])) / 50)
        np.testing.assert_array_equal(table.columns["observation.state/lift.pos"], truth["observation.state"][:, 1])
        np.testing.assert_array_equal(table.columns["action/pan.pos"], truth["action"][:, 0])
        np.testing.assert_array_equal(table.columns["next.reward"], truth["next.reward"])
        assert not any("image" in name or "index" in name for name in table.columns)


def test_names_that_are_the_models_are_found(tmp_path: Path) -> None:
    (table,) = read_dataset(write_dataset(tmp_path / "d", [numbers(60, 0)]))
    found = matched(table, ARM)
    np.testing.assert_array_equal(found.columns["qpos/lift"], table.columns["observation.state/lift.pos"])
    np.testing.assert_array_equal(found.columns["ctrl/lift_servo"], table.columns["action/lift.pos"])
    assert "qpos/pan is observation.state/pan.pos" in found.notes[0]


def test_names_that_are_not_the_models_are_asked_for(tmp_path: Path) -> None:
    (table,) = read_dataset(write_dataset(tmp_path / "d", [numbers(60, 0)]))
    other = Machine(["pan", "lift_joint"], {"pan": Drive("pan", "effort")})
    with pytest.raises(
        UserError,
        match=r"--map 'qpos/lift_joint=observation.state/lift.pos,ctrl/pan=COLUMN'.*take effort, .* commands position",
    ):
        matched(table, other)


@pytest.mark.parametrize(
    ("names", "size", "expected"),
    [
        (["a", "b"], 2, ["a", "b"]),
        ({"motors": ["a", "b"]}, 2, ["a", "b"]),
        ({"b": 1, "a": 0}, 2, ["a", "b"]),
        (["state"], 2, ["0", "1"]),
        (["a", "a"], 2, ["0", "1"]),
        (None, 1, [""]),
    ],
)
def test_names_of_entries(names: object, size: int, expected: list[str]) -> None:
    assert names_of({"names": names}, size) == expected


def test_stamps_that_say_something_of_their_own_are_kept(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "d", [numbers(60, 0)])
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    rows = pq.read_table(path)
    late = rows["timestamp"].to_numpy() + np.where(np.arange(60) > 30, 0.5, 0.0)
    pq.write_table(rows.set_column(rows.column_names.index("timestamp"), "timestamp", pa.array(late)), path)
    (table,) = read_dataset(folder)
    np.testing.assert_allclose(table.columns["time"], late)


def broken(folder: Path, what: str) -> None:
    data = folder / "data" / "chunk-000" / "file-000.parquet"
    listed = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    info = folder / "meta" / "info.json"
    rows = pq.read_table(data)
    if what == "no file":
        data.unlink()
    elif what == "unfinished":
        data.write_bytes(data.read_bytes()[:-200])
    elif what == "no column":
        pq.write_table(rows.drop_columns("observation.state"), data)
    elif what == "short":
        pq.write_table(rows.slice(0, 50), data)
    elif what == "no list":
        listed.unlink()
    elif what == "no json":
        info.write_text("{")
    elif what == "ragged":
        ragged = pa.array([[1.0, 2.0]] * 59 + [[1.0]])
        pq.write_table(rows.set_column(rows.column_names.index("action"), "action", ragged), data)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("no file", r"file-000.parquet: not there, so the dataset is incomplete"),
        ("unfinished", r"cannot be read as Parquet .*Was the recording finished"),
        ("no column", r"no column 'observation.state'. It has: action"),
        ("short", r"50 frames of episode 0, 60 are listed"),
        ("no list", r"no episodes are listed in meta/.*finalize"),
        ("no json", r"info.json: not what LeRobot writes"),
        ("ragged", r"action has rows of [12], [12] numbers"),
    ],
)
def test_datasets_that_cannot_be_read(what: str, words: str, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "d", [numbers(60, 0)])
    broken(folder, what)
    with pytest.raises(UserError, match=words):
        read_dataset(folder)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"codebase_version": "v1.6"}, r"LeRobotDataset v1.6; versions 2 and 3"),
        ({"codebase_version": "v4.0"}, r"LeRobotDataset v4.0; versions 2 and 3"),
        ({"fps": -50}, "fps is -50 and"),
        ({"data_path": "data/{chapter}.parquet"}, "list of episodes is not what LeRobot v3.0 writes.*chapter"),
    ],
)
def test_what_info_may_not_say(changed: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words):
        read_dataset(write_dataset(tmp_path / "d", [numbers(60, 0)], **changed))


@pytest.fixture
def pushed(moved: Callable, tmp_path: Path) -> tuple[Path, list[Path]]:
    """The slide with a little friction, two episodes as a dataset and the same numbers as CSV."""
    told, csv = [], []
    for seed in (0, 1):
        columns = moved(4.0, coulomb=2.0, seed=seed)
        rows = {n: x.astype(np.float32) for n, x in columns.items()}
        state, action = rows["qpos/x"][:, None], rows["ctrl/motor"][:, None]
        told.append({"observation.state": state, "action": action})
        csv.append(tmp_path / f"{seed}.csv")
        write_csv(csv[-1], {n: rows[n].astype(float) if n != "time" else columns["time"] for n in rows})
    names = {"observation.state": ["x.pos"], "action": ["motor"]}
    return write_dataset(tmp_path / "slides", told, names, fps=250, files=(0, 0)), csv


def test_the_same_answer_as_from_csv(
    pushed: tuple[Path, list[Path]], slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder, csv = pushed
    given = ["--model", str(slide), "--effects", "coulomb_friction,viscous_friction"]
    assert main(["--inspect", str(folder), "--model", str(slide)]) == 0
    said = capsys.readouterr().out
    assert "LeRobotDataset v3.0, 250 frames/s" in said and said.count("diagnose can use it") == 2
    reports = []
    for k, data in enumerate([[folder], csv]):
        assert main([*given, "--data", *map(str, data), "--out", str(tmp_path / f"out{k}")]) == 0
        reports.append(json.loads((tmp_path / f"out{k}" / "report.json").read_text()))
    a, b = reports
    assert a["verdict"] == "effect" and [e["name"] for e in a["effects"]] == ["coulomb_friction"]
    assert any("by their names" in note for note in a["notes"])
    for row in (lambda r: r["held_out"], lambda r: r["effects"][0]["parameters"]["torque"]):
        left, right = ({k: v for k, v in row(r).items() if isinstance(v, float)} for r in (a, b))
        assert left == pytest.approx(right, rel=1e-3)
    folder.joinpath("data/chunk-000/file-000.parquet").rename(tmp_path / "gone")
    assert main([*given, "--data", str(folder)]) == 2
    assert "the dataset is incomplete" in capsys.readouterr().err


def test_a_number_that_is_none_is_told(slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    state = np.sin(np.arange(60.0, dtype=np.float32))[:, None]
    state[7] = np.nan
    names = {"observation.state": ["x.pos"], "action": ["motor"]}
    folder = write_dataset(
        tmp_path / "d", [{"observation.state": state, "action": state[::-1].copy()}], names, files=(0,)
    )
    assert main(["--model", str(slide), "--data", str(folder)]) == 2
    assert "is not a number in row" in capsys.readouterr().err


def test_a_table_without_offers_is_left_alone() -> None:
    table = Table("run", {"time": np.zeros(2)})
    assert matched(table, ARM) is table
