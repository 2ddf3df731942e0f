"""ROS 2 bags, written by rosbags' own writer, in both storages."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.mapping import parse_mapping
from mpc_sgft.diagnose.data.matching import Drive, Machine
from mpc_sgft.diagnose.data.measured import Table, write_csv
from mpc_sgft.diagnose.data.rosbag import is_bag, read_bag
from mpc_sgft.diagnose.data.sources import named, opened, sources, tables

pytest.importorskip("rosbags", reason="needs rosbags")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

STORE = get_typestore(Stores.ROS2_HUMBLE)
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint reference\n",
        "control_msgs/msg/JointTrajectoryControllerState",
    )
)
STORE.register(get_types_from_msg("float64 warmth\n", "my_msgs/msg/Heat"))
START = 1_700_000_000_000_000_000  # [ns]
EMPTY = np.zeros(0)
ARM = Machine(["a", "b"], {"a": Drive("a", "position"), "b_servo": Drive("b", "position")})


def _make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def _header(ns: int) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id="")


def joints(ns: int, names: str, position: Any = (), velocity: Any = (), effort: Any = ()) -> Any:
    """A JointState of joints with names of one letter, stamped unless ns is 0."""
    numbers = {"position": position, "velocity": velocity, "effort": effort}
    arrays = {key: np.array(x, float) for key, x in numbers.items()}
    return _make("sensor_msgs/msg/JointState", header=_header(ns), name=list(names), **arrays)


def array(*numbers: float) -> Any:
    layout = _make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return _make("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(numbers, float))


def point(seconds: float, *positions: float) -> Any:
    ns = round(1e9 * seconds)
    since = _make("builtin_interfaces/msg/Duration", sec=ns // 10**9, nanosec=ns % 10**9)
    others = {"velocities": EMPTY, "accelerations": EMPTY, "effort": EMPTY}
    return _make(POINT, positions=np.array(positions, float), time_from_start=since, **others)


def trajectory(ns: int, names: str, *points: Any) -> Any:
    kind = "trajectory_msgs/msg/JointTrajectory"
    return _make(kind, header=_header(ns), joint_names=list(names), points=list(points))


def write_bag(path: Path, messages: list[tuple[str, int, Any]], storage: str = "MCAP", packed: str = "NONE") -> Path:
    """(topic, when it was recorded [ns after START], message) -> a bag."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, ns, message in sorted(messages, key=lambda row: row[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], START + ns, STORE.serialize_cdr(message, kind))
    return path


def states(topic: str = "/joint_states", names: str = "ab", count: int = 60, step: int = 10_000_000) -> list:
    """The joints at k and -k, stamped every 10 ms, recorded 1 ms later."""
    rows = []
    for k in range(count):
        position = [k * (-1.0) ** "ab".index(n) if n in "ab" else k for n in names]
        rows.append((topic, k * step + 1_000_000, joints(START + k * step, names, position)))
    return rows


def read(path: Path, machine: Machine | None = None, **mapping: str) -> Table:
    told = parse_mapping({name.replace("__", "/"): text for name, text in mapping.items()})
    (table,) = tables(opened(path), told, machine)
    return table if machine is None else named(table, machine)


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_states_and_commands_on_one_clock(storage: str, tmp_path: Path) -> None:
    commands = [
        ("/arm/cmd", 15_000_000, joints(0, "ba", [7.0, 5.0])),
        ("/arm/cmd", 40_000_000, joints(0, "ba", [8, 6])),
    ]
    bag = write_bag(tmp_path / "bags" / "run", states() + commands, storage)
    assert sources([tmp_path / "bags"]) == sources([bag]) == [bag]
    table = read(bag, ARM)
    assert list(table.columns) == ["time", "qpos/a", "qpos/b", "ctrl/a", "ctrl/b_servo"]
    k = np.arange(2, 60)  # the first command came after the second sample
    np.testing.assert_allclose(table.columns["time"], 0.01 * k, atol=1e-12)
    np.testing.assert_array_equal(table.columns["qpos/a"], k)
    np.testing.assert_array_equal(table.columns["qpos/b"], -k)
    np.testing.assert_array_equal(table.columns["ctrl/a"], np.where(k < 4, 5, 6))  # not before it came
    np.testing.assert_array_equal(table.columns["ctrl/b_servo"], np.where(k < 4, 7, 8))
    notes = " ".join(table.notes)
    assert "2 samples before the first command" in notes and "clock of the recorder" in notes
    assert "qpos/a is /joint_states/a.position" in notes
    (file,) = (p for p in bag.iterdir() if p.name != "metadata.yaml")
    alone = read(file, ARM)
    np.testing.assert_array_equal(alone.columns["ctrl/a"], table.columns["ctrl/a"])


def test_without_stamps_the_recorders_time_counts(tmp_path: Path) -> None:
    rows = [("/joint_states", 7_000_000 * k, joints(0, "a", [k])) for k in range(60)]
    table = read(write_bag(tmp_path / "run", rows))
    np.testing.assert_allclose(table.columns["time"], 0.007 * np.arange(60), atol=1e-12)
    assert read_bag(tmp_path / "run").streams[0].stamped is False


@pytest.mark.parametrize(
    ("stamp_of_states", "command"),
    [
        (lambda ns: 10**9 + ns, array(3.0)),  # simulated time, no header
        (lambda ns: 10**9 + ns, joints(START + 204_000_000, "a", [3.0])),  # each by a clock of its own
        (
            lambda ns: ns - 1_000_000,
            joints(10**10, "a", [3.0]),
        ),  # the first stamp is 0, which says nothing; a board's clock
    ],
)
def test_clocks_that_are_apart_are_not_mixed(stamp_of_states: Callable, command: Any, tmp_path: Path) -> None:
    rows = [(t, ns, joints(stamp_of_states(ns), "a", [k])) for k, (t, ns, _) in enumerate(states())]
    bag = write_bag(tmp_path / "run", [*rows, ("/cmd", 205_000_000, command)])
    table = read(bag, Machine(["a"], {"a": Drive("a", "position")}))
    assert table.columns["qpos/a"][0] == 21 and len(table.columns["time"]) == 39
    assert any("all times are those of the recorder" in note for note in table.notes)


def test_one_clock_that_is_not_the_recorders_is_kept(tmp_path: Path) -> None:
    rows = [(t, ns, joints(10**9 + ns, "a", [k])) for k, (t, ns, _) in enumerate(states())]
    bag = write_bag(tmp_path / "run", [*rows, ("/cmd", 400_000_000, joints(10**9 + 205_000_000, "a", [3.0]))])
    table = read(bag, Machine(["a"], {"a": Drive("a", "position")}))
    assert table.columns["qpos/a"][0] == 21 and not any("recorder: " in note for note in table.notes)


def test_speeds_are_taken_and_efforts_only_when_asked_for(tmp_path: Path) -> None:
    rows = [("/joint_states", 10_000_000 * k, joints(0, "a", [k], [3.0], [4.0])) for k in range(60)]
    bag = write_bag(tmp_path / "run", rows)
    alone = Machine(["a"], {})
    assert {"qpos/a", "qvel/a", "/joint_states/a.effort"} <= set(read(bag, alone).columns)
    asked = read(
        bag,
        Machine(["a"], {"m": Drive("a", "effort")}),
        force__m="/joint_states/a.effort",
        ctrl__m="/joint_states/a.effort",
    )
    np.testing.assert_array_equal(asked.columns["force/m"], 4.0)


def test_an_array_is_the_command_of_a_single_actuator(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", states() + [("/effort_controller/commands", 0, array(3.0))])
    table = read(bag, Machine(["a", "b"], {"m": Drive("a", "effort")}))
    np.testing.assert_array_equal(table.columns["ctrl/m"], 3.0)
    warm = [("/motor/temperature", 0, array(31.0))]
    both = write_bag(tmp_path / "warm", states() + warm + [("/effort_controller/commands", 0, array(3.0))])
    np.testing.assert_array_equal(read(both, Machine(["a", "b"], {"m": Drive("a", "effort")})).columns["ctrl/m"], 3.0)
    with pytest.raises(UserError, match="ctrl/m=COLUMN.*It has: .*/effort_controller/commands/0"):
        read(bag, Machine(["a", "b"], {"m": Drive("a", "position")}))
    two = Machine(["a", "b"], {"m": Drive("a", "effort"), "n": Drive("b", "effort")})
    with pytest.raises(UserError, match="nothing is called as in the model: ctrl/m, ctrl/n"):
        read(bag, two)
    commands = {"ctrl__m": "/effort_controller/commands/0", "ctrl__n": "-2*/effort_controller/commands/0"}
    np.testing.assert_array_equal(read(bag, two, **commands).columns["ctrl/n"], -6.0)


def test_trajectories_are_lines_between_their_points(tmp_path: Path) -> None:
    topic = "/arm_controller/joint_trajectory"
    told = [
        (topic, 0, trajectory(START, "ab", point(0.1, 1.0, 0.0), point(0.2, 3.0, 0.0))),
        (topic, 150_000_000, trajectory(START + 150_000_000, "ab", point(0.1, 0.0, 0.0))),  # replaces the rest
        (topic, 300_000_000, trajectory(0, "ab", point(0.0, 9.0, 0.0))),  # a step, now
    ]
    table = read(write_bag(tmp_path / "run", states() + told))
    time, command = table.columns["time"], table.columns[f"{topic}/a.position"]
    knots = [0.1, 0.15, 0.25, 0.3 - 1e-9, 0.3, 0.6], [1, 2, 0, 0, 9, 9]
    expected = np.where(time < 0.1 - 1e-9, np.nan, np.interp(time, *knots))
    np.testing.assert_allclose(command, expected, atol=1e-6)


def test_what_a_controller_asks_for_is_a_command(tmp_path: Path) -> None:
    kind, topic = "control_msgs/msg/JointTrajectoryControllerState", "/arm_controller/controller_state"
    told = [
        (topic, ns, _make(kind, header=_header(START + ns), joint_names=["b", "a"], reference=point(0, ns * 1e-9, 5.0)))
        for ns in range(0, 600_000_000, 5_000_000)
    ]
    table = read(write_bag(tmp_path / "run", states() + told), ARM)
    np.testing.assert_array_equal(table.columns["ctrl/a"], 5.0)
    np.testing.assert_allclose(table.columns["ctrl/b_servo"], table.columns["time"], atol=1e-9)


def test_two_topics_of_states_are_told_apart(tmp_path: Path) -> None:
    gripper = states("/gripper/joint_states", "c", step=20_000_000)
    bag = write_bag(tmp_path / "run", states() + gripper)
    words = (
        r"2 topics of measured joints. It holds /joint_states \(sensor_msgs/msg/JointState: a.position, b.position\)"
    )
    with pytest.raises(
        UserError, match=words + r"; /gripper/joint_states .*--map 'qpos/JOINT=/joint_states/a.position'"
    ):
        read(bag)
    assert "qpos/a" in read(bag, Machine(["a", "b"], {})).columns  # only one has them all
    both = read(
        bag, Machine(["a", "c"], {}), qpos__a="/joint_states/a.position", qpos__c="/gripper/joint_states/c.position"
    )
    np.testing.assert_allclose(both.columns["qpos/c"], both.columns["time"] / 0.02, atol=1e-9)  # on straight lines
    assert any("straight lines between its messages" in note for note in both.notes)
    twice = write_bag(tmp_path / "twice", states() + states("/sim/joint_states"))
    with pytest.raises(UserError, match="2 topics of measured joints"):
        read(twice, Machine(["a", "b"], {}))


def test_two_commands_are_asked_about(tmp_path: Path) -> None:
    rows = states() + [(f"/{n}/cmd", 0, joints(0, "ab", [1.0, 2.0])) for n in ("left", "right")]
    with pytest.raises(
        UserError, match="ctrl/a may be /left/cmd/a.position or /right/cmd/a.position. Say which: --map"
    ):
        read(write_bag(tmp_path / "run", rows), ARM)


def test_bags_that_cannot_be_read(tmp_path: Path) -> None:
    for name, storage in (("m", "MCAP"), ("s", "SQLITE3")):
        bag = write_bag(tmp_path / name, states(), storage)
        (file,) = (p for p in bag.iterdir() if p.name != "metadata.yaml")
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        with pytest.raises(UserError, match=f"{name}: cannot be read as a ROS 2 bag"):
            read_bag(bag)
    (bag / "metadata.yaml").write_text("nothing: of the kind\n")
    with pytest.raises(UserError, match="cannot be read as a ROS 2 bag"):
        read_bag(bag)
    with pytest.raises(UserError, match=r"no message of joints or commands in it. It holds nothing"):
        read_bag(write_bag(tmp_path / "empty", []))
    heat = [("/heat", 0, _make("my_msgs/msg/Heat", warmth=3.0))]
    with pytest.raises(UserError, match=r"It holds /heat \(my_msgs/msg/Heat\); sensor_msgs/msg/JointState, "):
        read_bag(write_bag(tmp_path / "heat", heat))
    with pytest.raises(UserError, match="no sensor_msgs/msg/JointState topic that is no command. It holds /cmd"):
        read(write_bag(tmp_path / "only", [("/cmd", 0, array(1.0))]))
    uneven = [("/joint_states", 0, joints(0, "ab", [1.0]))]
    with pytest.raises(UserError, match="/joint_states: a message of 2 joints and 1 numbers of position"):
        read_bag(write_bag(tmp_path / "uneven", uneven))
    mixed = states(names="a") + [("/joint_states", 5_000_000, joints(0, "ab", [1.0, 2.0]))]
    with pytest.raises(UserError, match="2 topics of measured joints|speak of different joints"):
        read(write_bag(tmp_path / "mixed", mixed))
    with pytest.raises(UserError, match="unknown ending '.bag': a bag of ROS 1"):
        (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
        sources([tmp_path / "old.bag"])


PACKED = [("MCAP", "NONE"), ("MCAP", "STORAGE"), ("SQLITE3", "NONE"), ("SQLITE3", "MESSAGE"), ("SQLITE3", "FILE")]


@pytest.mark.parametrize(("storage", "packed"), PACKED)
def test_packed_bags_hold_the_same(storage: str, packed: str, tmp_path: Path) -> None:
    table = read(write_bag(tmp_path / "run", states(), storage, packed))
    np.testing.assert_array_equal(table.columns["/joint_states/b.position"], -np.arange(60))


@pytest.mark.parametrize(("storage", "packed"), PACKED)
def test_changed_bytes_end_in_one_line_or_nothing(storage: str, packed: str, tmp_path: Path) -> None:
    bag, rng = write_bag(tmp_path / "run", states(count=20), storage, packed), np.random.default_rng(0)
    (file,) = (p for p in bag.iterdir() if p.name != "metadata.yaml")
    whole, told = np.frombuffer(file.read_bytes(), np.uint8), 0
    for _ in range(50):
        changed = whole.copy()
        changed[rng.integers(len(whole), size=3)] = rng.integers(256, size=3)
        file.write_bytes(changed.tobytes())
        try:
            read_bag(bag)
        except UserError:
            told += 1
    assert told > 3


def test_our_own_mcap_is_not_taken_for_a_bag(tmp_path: Path) -> None:
    from mpc_sgft.storage.episode_file import EpisodeWriter

    with EpisodeWriter(tmp_path / "a.mcap", {"joint_names": ["ros2"]}) as writer:
        writer.close({})
    assert not is_bag(tmp_path / "a.mcap")


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_bag(tmp_path / "run", states())
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(UserError, match=r"pip install 'mpc_sgft\[ros\]'"):
        read_bag(bag)


def slide_bag(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """The slide's episode: its joint stamped, its command just before the sample from which it acts."""
    rows: list[tuple[str, int, Any]] = []
    for t, u, q in zip(columns["time"], columns["ctrl/motor"], columns["qpos/x"], strict=True):
        ns = round(1e9 * t)
        rows.append(("/effort_controller/commands", ns - 100_000 + 10**6, array(u)))
        rows.append(("/joint_states", ns + 10**6, joints(START + ns + 10**6, "x", [q])))
    return write_bag(path, rows)


def test_the_same_answer_as_from_csv(
    moved: Callable, slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    columns = moved(4.0, coulomb=2.0)
    bag = slide_bag(tmp_path / "drive", columns)
    write_csv(tmp_path / "drive.csv", columns)
    assert main(["--inspect", str(bag), "--model", str(slide)]) == 0
    said = capsys.readouterr().out
    assert "/joint_states: sensor_msgs/msg/JointState, 1000 messages, 250 Hz, state, clock of the header" in said
    assert "diagnose can use it" in said and "ctrl/motor" in said
    reports = []
    for k, data in enumerate((bag, tmp_path / "drive.csv")):
        given = ["--model", str(slide), "--data", str(data), "--out", str(tmp_path / f"out{k}")]
        assert main([*given, "--effects", "coulomb_friction,viscous_friction"]) == 0
        reports.append(json.loads((tmp_path / f"out{k}" / "report.json").read_text()))
    a, b = (r["effects"][0]["parameters"]["torque"] for r in reports)
    assert a["value"] == pytest.approx(b["value"], rel=1e-6)
    assert any("/effort_controller/commands" in note for note in reports[0]["notes"])


def test_an_ambiguous_bag_is_described_and_not_diagnosed(
    slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    bag = write_bag(tmp_path / "run", states(names="a") + states("/other/joint_states"))
    assert main(["--inspect", str(bag), "--model", str(slide)]) == 0
    said = capsys.readouterr().out
    assert "diagnose would stop" in said and "/other/joint_states: sensor_msgs/msg/JointState, 60 messages" in said
    assert main(["--model", str(slide), "--data", str(bag)]) == 2
    assert "topics of measured joints" in capsys.readouterr().err


def test_a_measured_number_that_is_none_is_told(slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rows = [("/joint_states", 10_000_000 * k, joints(0, "x", [np.nan if k == 9 else k])) for k in range(60)]
    rows += [("/cmd", 0, array(1.0))]
    bag = write_bag(tmp_path / "run", rows)
    assert main(["--model", str(slide), "--data", str(bag)]) == 2
    assert "qpos/x is not a number in row 9" in capsys.readouterr().err
