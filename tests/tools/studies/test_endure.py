"""The tool on the stand-in: what it counts, and that a failure is a failure. The hundred resets are run by hand."""

import json
from pathlib import Path

import mujoco
import pytest

from tools.studies import endure, nightly_franka_sim


@pytest.mark.slow
def test_resets_and_steps_are_counted(tmp_path: Path, capsys) -> None:
    pytest.importorskip("franky", reason="needs the robot's client")
    pytest.importorskip("franky_sim", reason="needs the robot's client")
    out = tmp_path / "new" / "endure.json"
    assert endure.main(["--resets", "2", "--steps", "5", "--out", str(out)]) == 0
    found = json.loads(out.read_text())
    assert (found["resets"], found["steps"], found["aborts"], found["periods"]) == (2, 5, [], 5)
    assert "2 resets, 5 steps, 0 aborts" in capsys.readouterr().out


@pytest.mark.slow
def test_an_abort_is_named_and_ends_with_1(tmp_path: Path) -> None:
    """An object that is always too old to count as seen: no episode can begin, and it gives up."""
    pytest.importorskip("franky", reason="needs the robot's client")
    pytest.importorskip("franky_sim", reason="needs the robot's client")
    out = tmp_path / "endure.json"
    blind = ["--set", "backend.limits.detection_age=1e-9", "backend.patience=0.01", "backend.reset_speed=0.4"]
    assert endure.main(["--resets", "5", "--steps", "5", "--out", str(out), *blind]) == 1
    found = json.loads(out.read_text())
    assert found["resets"] == found["steps"] == 0 and len(found["aborts"]) == endure.GIVE_UP
    assert all("last seen" in abort["why"] and abort["step"] == 0 for abort in found["aborts"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--resets", "0"], "--resets must be above 0"),
        (["--resets", "1", "--steps", "1000"], "More --resets"),
        (["--robot-ip", "127.77.77.77"], "sees the stand-in's scene alone"),
        (["--robot-ip", "127.77.77.77", "--set", "perception=fixed"], "no robot answers at 127.77.77.77"),
        (["--set", "backend.gripper.width=0"], "backend.gripper: width=0"),
    ],
)
def test_what_cannot_be_is_one_line_and_2(words: list[str], said: str, tmp_path: Path, capsys) -> None:
    pytest.importorskip("franky", reason="needs the robot's client")
    assert endure.main([*words, "--out", str(tmp_path / "x.json")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "x.json").exists(), error


def test_the_arm_for_franka_sim_is_seven_joints_that_touch_nothing() -> None:
    model = mujoco.MjModel.from_xml_string(nightly_franka_sim.arm_alone())
    assert [model.joint(j).name for j in range(model.njnt)] == [f"joint{i}" for i in range(1, 8)]
    assert model.nu == 0 and not (model.geom_contype | model.geom_conaffinity).any()
    assert len(nightly_franka_sim.start_posture()) == 7
