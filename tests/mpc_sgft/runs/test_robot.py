"""What a user can get wrong with --backend franka: one line each, before anything is started."""

from pathlib import Path

import pytest

from mpc_sgft import deploy
from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build, robot
from mpc_sgft.storage import checkpoint


def config(*given: str):
    overrides = [compose.normalise(text) for text in ("backend=franka", *given)]
    compose.check("deploy", overrides, sweep=False)
    return compose.compose("deploy", overrides, given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((), "needs --robot-ip"),
        (("robot-ip=stand-in", "rollouts=0"), "rollouts=0: on a robot its rollouts are all that is measured"),
        (("robot-ip=10.0.0.1",), "sees the stand-in's scene alone"),
        (("robot-ip=stand-in", "perception=fixed"), "no camera"),
        (("robot-ip=10.0.0.1", "perception=fixed", "backend.clock=robot"), "needs real time"),
        (("robot-ip=stand-in", "task=pendulum"), "pendulum cannot run on the robot"),
        (("robot-ip=stand-in", "gap=turned"), "a gap is what a simulator lacks"),
        (("robot-ip=stand-in", "backend.limits.low=[0.9,-0.3,-0.2]"), "inside out along x"),
        (("robot-ip=stand-in", "backend.limits.joint_margin=9"), "joint_margin"),
        (("robot-ip=stand-in", "backend.gripper.width=-0.02"), "backend.gripper: width=-0.02; above 0"),
    ],
)
def test_one_line_for_each_mistake(given: tuple[str, ...], words: str) -> None:
    with pytest.raises(UserError) as error:
        robot.make_env(config(*given))
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("backend.arm.interface=torque", "allowed: joint, cartesian"),
        ("backend.arm.realtime=yes", "allowed: ignore, enforce"),
        ("backend.clock=sun", "allowed: wall, robot"),
        ("backend.limits.low=[0.3,-0.36,-0.195]", "the task's start"),
        ("backend.reset_speed=0.9", "reset_speed"),
    ],
)
def test_numbers_that_need_the_client(given: str, words: str) -> None:
    pytest.importorskip("franky", reason="needs the robot's client")
    with pytest.raises(UserError, match=words):
        robot.make_env(config("robot-ip=stand-in", given))


def test_the_missing_client_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "franky", None)
    with pytest.raises(UserError, match=r"pip install 'mpc_sgft\[franka\]'"):
        robot.make_env(config("robot-ip=stand-in"))


def test_a_checkpoint_of_another_task_is_refused_before_anything_connects(tmp_path: Path, capsys) -> None:
    """Nobody is at the address: an attempt to connect would say so instead."""
    whole = checkpoint.load(build.shipped("push"))
    other = tmp_path / "pendulum.safetensors"
    checkpoint.save(other, whole.model, {**whole.meta, "task": "pendulum"})
    args = ["--backend", "franka", "--robot-ip", "127.77.77.77", "perception=fixed", "--checkpoint", str(other)]
    assert deploy.main([*args, f"run_dir={tmp_path / 'run'}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1, error
    assert "expected task='push', found task='pendulum'" in error and str(other) in error
    assert not (tmp_path / "run").exists()
