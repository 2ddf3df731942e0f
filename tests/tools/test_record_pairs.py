"""Pictures and poses, from a robot that speaks the real protocol and a recording by the camera's own SDK."""

import io
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs the camera's packages")
pytest.importorskip("pyrealsense2", reason="needs the camera's packages", exc_type=ImportError)
pytest.importorskip("franky", reason="needs the robot's client")
pytest.importorskip("franky_sim", reason="needs the robot's client")

from envs.kinematics import tip_position  # noqa: E402
from envs.stand_in.client import StandIn  # noqa: E402
from envs.tasks.push import Push  # noqa: E402
from tools.calibrate_camera import main  # noqa: E402

TESTS = Path(__file__).resolve().parents[1]
LENS = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
RED, GREEN = 200, 60  # of every picture; its blue is its number
HAND = 0.1034  # [m] from the flange to between the fingertips, where the robot's own O_T_EE is
SECONDS = 8  # of film


@pytest.fixture(scope="module")
def stand_in(robot_push: Push) -> Iterator[StandIn]:
    running = StandIn(robot_push)
    yield running
    running.close()


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("film")
    color = np.zeros((30 * SECONDS, LENS["height"], LENS["width"], 3), np.uint8)
    color[..., 0], color[..., 1], color[..., 2] = RED, GREEN, np.arange(len(color))[:, None, None]
    np.savez(folder / "film.npz", color=color)
    order = json.dumps({"path": str(folder / "77.db3"), "serial": "77", "lens": LENS, "late_ms": 0.0})
    line = [sys.executable, str(TESTS / "film.py"), str(folder / "film.npz")]
    done = subprocess.run(line, input=order, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return str(folder / "77.db3")


@pytest.fixture
def record(film: str, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """record(ip, folder, typed): exit code of the command with these keys typed."""

    def run(ip: str, folder: Path, typed: str) -> int:
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        return main(["record", "--robot-ip", ip, "--serial", "77", "--out", str(folder), "--recording", film])

    return run


def test_each_pair_is_a_new_picture_and_where_the_hand_was(
    record, robot_push: Push, stand_in: StandIn, tmp_path
) -> None:
    assert record(stand_in.ip, tmp_path / "pairs", "\n\n\nq\n") == 0
    found = json.loads((tmp_path / "pairs" / "pairs.json").read_text())
    assert found["serial"] == "77" and found["intrinsics"].items() >= LENS.items()
    assert [pair["image"] for pair in found["pairs"]] == ["00.png", "01.png", "02.png"]
    start = robot_push.start(np.random.default_rng(0)).qpos[:1, :7]
    numbers = []
    for pair in found["pairs"]:
        pose = np.array(pair["base_T_hand"])
        np.testing.assert_allclose(pose[:3, 3], tip_position(start, HAND)[0], atol=0.01)  # [m] the arm sags a little
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        picture = cv2.imread(str(tmp_path / "pairs" / pair["image"]))  # blue, green, red
        assert picture.shape == (48, 64, 3) and (picture[..., 1:] == [GREEN, RED]).all()
        numbers.append(int(picture[0, 0, 0]))
    assert numbers == sorted(set(numbers)), numbers


def test_what_is_there_is_kept_and_goes_on(record, stand_in: StandIn, tmp_path, capsys) -> None:
    file = tmp_path / "pairs" / "pairs.json"
    assert record(stand_in.ip, tmp_path / "pairs", "\n") == 0  # the input ended
    first = json.loads(file.read_text())["pairs"]
    assert record(stand_in.ip, tmp_path / "pairs", "\nq\n") == 0
    assert "1 pairs are there" in capsys.readouterr().out
    pairs = json.loads(file.read_text())["pairs"]
    assert pairs[:1] == first and [pair["image"] for pair in pairs] == ["00.png", "01.png"]
    file.write_text(json.dumps(json.loads(file.read_text()) | {"pairs": pairs[1:]}))  # the first was a bad one
    kept = (tmp_path / "pairs" / "01.png").read_bytes()
    assert record(stand_in.ip, tmp_path / "pairs", "\nq\n") == 0
    assert [pair["image"] for pair in json.loads(file.read_text())["pairs"]] == ["01.png", "02.png"]
    assert (tmp_path / "pairs" / "01.png").read_bytes() == kept


def test_a_robot_that_is_lost_costs_no_pair(record, robot_push: Push, tmp_path, monkeypatch, capsys) -> None:
    lost = StandIn(robot_push)
    keys = iter(["", "", "q"])

    def typed(ask: str) -> str:
        if "pair 1" in ask:
            lost.close()
        return next(keys)

    monkeypatch.setattr("builtins.input", typed)
    try:
        assert record(lost.ip, tmp_path / "pairs", "") == 2
    finally:
        lost.close()
    assert "does not answer any more" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "pairs" / "pairs.json").read_text())["pairs"]) == 1


def test_what_is_wrong_is_one_line_and_nothing_is_overwritten(record, tmp_path, capsys) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "pairs.json").write_text("mine")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "pairs.json").write_text('{"serial": "78", "pairs": []}')
    for ip, folder, words in (
        ("127.77.77.77", tmp_path / "full", "is not empty"),
        ("127.77.77.77", tmp_path / "other", "holds pairs of camera 78"),
        ("127.77.77.77", tmp_path / "new", "127.77.77.77 does not answer"),
    ):
        assert record(ip, folder, "\nq\n") == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1, error
    assert (tmp_path / "full" / "pairs.json").read_text() == "mine"
