"""Whole sessions on the stand-in, through the command: a dry run, and one that is killed in mid-motion and goes on."""

import json
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from envs.kinematics import tip_position
from mpc_sgft.storage.episode_file import read_episode

pytest.importorskip("franky", reason="needs the robot's client")
pytest.importorskip("franky_sim", reason="needs the robot's client")
pytestmark = pytest.mark.slow
DEPLOY = [sys.executable, "-m", "mpc_sgft.deploy"]
STEPS = 8
TOOL = 0.15  # [m] from the flange to the tip
PATIENT = ["backend.limits.state_age=5", "backend.limits.detection_age=5", "backend.patience=5"]  # on a busy computer
ROBOT = ["--backend", "franka", "--robot-ip", "stand-in", "--quiet", "planner=policy", "method=zero_shot"]
ROBOT += [f"task.env.episode_steps={STEPS}", "log.rerun=false", *PATIENT]


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_a_dry_run_does_everything_but_move(tmp_path: Path) -> None:
    done = subprocess.run([*DEPLOY, *ROBOT, "--dry-run", f"run_dir={tmp_path}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found, recording = summary(tmp_path), read_episode(tmp_path / "episodes" / "dry_run.mcap")
    assert found["dry_run"] and found["aborted"] is None and found["steps"] == STEPS
    time, sampled = recording.transitions["time"], recording.joints["time"]
    assert (np.diff(time) > 0).all() and time[-1] == pytest.approx(sampled[-1], abs=1e-6)  # one clock for both
    moved = recording.joints["qpos"].max(0) - recording.joints["qpos"].min(0)
    assert (moved < 0.01).all() and (abs(recording.transitions["action"]) > 0.1).any()  # [rad]


def recorded(path: Path) -> int:
    """Whole steps of an episode that is being written."""
    return len(read_episode(path).transitions.get("step", [])) if path.exists() else 0


def wait_for_steps(process: subprocess.Popen, path: Path) -> None:
    deadline = time.monotonic() + 200
    while recorded(path) < 3:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)


def test_a_disk_that_fills_up_ends_the_session_with_a_line_and_it_goes_on(tmp_path: Path) -> None:
    first = tmp_path / "episodes" / "0001.mcap"
    process = subprocess.Popen(
        [*DEPLOY, *ROBOT, "rollouts=1", f"run_dir={tmp_path}"], stderr=subprocess.PIPE, text=True
    )
    wait_for_steps(process, first)
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (first.stat().st_size, hard))
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 2 and "Traceback" not in said, said
    assert re.search(r"error: .*0001.mcap: .*Make room\. .* saved after 0 rollouts\. Go on: .*--resume ", said), said
    kept = recorded(first)
    assert 3 <= kept < STEPS
    done = subprocess.run([*DEPLOY, "--quiet", "--resume", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path)
    assert found["real_rollouts"] == found["aborted_rollouts"] == 1 and recorded(first) == kept


def test_a_killed_session_loses_no_row_and_goes_on(tmp_path: Path) -> None:
    first = tmp_path / "episodes" / "0001.mcap"
    process = subprocess.Popen([*DEPLOY, *ROBOT, "rollouts=2", f"run_dir={tmp_path}"])
    wait_for_steps(process, first)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = read_episode(first)
    assert not kept.complete and 3 <= len(kept.transitions["step"]) < STEPS
    done = subprocess.run([*DEPLOY, "--quiet", "--resume", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path)
    assert found["real_rollouts"] == 2 and found["aborted_rollouts"] == 1
    assert found["robot"]["faults"] == 0 and found["robot"]["periods"] == STEPS
    assert found["robot_before"] == []  # the session that was killed had saved nothing
    assert list(read_episode(first).transitions["step"]) == list(kept.transitions["step"])


def test_the_cartesian_controller_follows_the_targets(tmp_path: Path) -> None:
    """Its lag is a few centimetres behind a tip that moves at a quarter of a metre a second."""
    words = [*ROBOT, "backend.arm.interface=cartesian", "rollouts=2", f"run_dir={tmp_path}"]
    done = subprocess.run([*DEPLOY, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path)
    assert found["real_rollouts"] == 2 and found["aborted_rollouts"] == found["robot"]["faults"] == 0
    for number in (1, 2):
        joints = read_episode(tmp_path / "episodes" / f"{number:04d}.mcap").joints
        tip, told = (tip_position(joints[key], TOOL) for key in ("qpos", "ctrl"))
        assert np.ptp(told, axis=0).max() > 0.1 and np.ptp(tip, axis=0).max() > 0.1  # [m]
        assert np.median(np.linalg.norm(tip - told, axis=1)) < 0.04
        assert abs(tip - told)[:, 2].max() < 0.015  # it stays above the table
