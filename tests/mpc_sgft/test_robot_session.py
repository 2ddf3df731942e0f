"""Whole sessions on the stand-in, through the command: a dry run, and one that is killed in mid-motion and goes on."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mpc_sgft.record import read_episode

pytest.importorskip("franky", reason="needs pip install mpc_sgft[franka]")
pytest.importorskip("franky_sim", reason="needs pip install mpc_sgft[franka-sim]")
pytestmark = pytest.mark.slow
DEPLOY = [sys.executable, "-m", "mpc_sgft.deploy"]
STEPS = 8
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
    moved = recording.joints["qpos"].max(0) - recording.joints["qpos"].min(0)
    assert (moved < 0.01).all() and (abs(recording.transitions["action"]) > 0.1).any()  # [rad]


def test_a_killed_session_loses_no_row_and_goes_on(tmp_path: Path) -> None:
    first = tmp_path / "episodes" / "0001.mcap"
    process = subprocess.Popen([*DEPLOY, *ROBOT, "rollouts=2", f"run_dir={tmp_path}"])
    deadline = time.monotonic() + 200
    while not (first.exists() and len(read_episode(first).transitions.get("step", [])) >= 3):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = read_episode(first)
    assert not kept.complete and 3 <= len(kept.transitions["step"]) < STEPS
    done = subprocess.run([*DEPLOY, "--quiet", "--resume", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path)
    assert found["real_rollouts"] == 2 and found["aborted_rollouts"] == 1
    assert found["robot"]["faults"] == 0 and found["robot"]["periods"] == STEPS
    assert list(read_episode(first).transitions["step"]) == list(kept.transitions["step"])
