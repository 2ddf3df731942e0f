"""A whole session on the stand-in with a person at a real terminal: keys typed into it, a page drawn on it."""

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mpc_sgft.storage.episode_file import read_episode

pytest.importorskip("franky", reason="needs the robot's client")
pytest.importorskip("franky_sim", reason="needs the robot's client")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
STEPS = 8
PATIENT = ["backend.limits.state_age=5", "backend.limits.detection_age=5", "backend.patience=5"]  # on a busy computer
ROBOT = ["--backend", "franka", "--robot-ip", "stand-in", "planner=policy", "method.updates=5", "rollouts=3"]
ROBOT += [f"task.env.episode_steps={STEPS}", "log.rerun=false", "log.tensorboard=false", *PATIENT]


class Terminal:
    """A pseudo-terminal with `python -m mpc_sgft.deploy` in it."""

    def __init__(self, *words: str):
        self.pid, self.fd = pty.fork()
        if not self.pid:
            os.execv(sys.executable, [sys.executable, "-m", "mpc_sgft.deploy", *words])
        fcntl.ioctl(self.fd, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 150, 0, 0))
        self.settings, self.screen = termios.tcgetattr(self.fd), ""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while True:
            try:
                select.select([self.fd], [], [])
                self.screen += os.read(self.fd, 4096).decode(errors="ignore")
            except OSError:
                return

    def type(self, keys: str) -> None:
        os.write(self.fd, keys.encode())

    def wait(self, until: Callable[[], object], seconds: float = 200) -> None:
        deadline = time.monotonic() + seconds
        while not until():
            if os.waitpid(self.pid, os.WNOHANG)[0] or time.monotonic() > deadline:
                raise AssertionError(self.screen[-4000:])
            time.sleep(0.02)

    def end(self, seconds: float = 120) -> int:
        """Wait for the program's end; its exit code."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.05)
        os.kill(self.pid, signal.SIGKILL)
        raise AssertionError(self.screen[-4000:])


def test_a_person_runs_a_session(tmp_path: Path) -> None:
    def steps(number: int, kind: str = "transitions") -> int:
        path = tmp_path / "episodes" / f"{number:04d}.mcap"
        found = getattr(read_episode(path), kind) if path.exists() else {}
        return len(found.get("time", ()))

    terminal = Terminal(*ROBOT, f"run_dir={tmp_path}")
    terminal.wait(lambda: steps(1) >= 2)
    terminal.type("s")
    terminal.wait(lambda: steps(2) >= 2)
    terminal.type("t")
    terminal.wait(lambda: steps(2, "guided") >= 20)
    time.sleep(1.1)  # sooner it would be the same key, held down
    terminal.type("t")
    terminal.wait(lambda: "paused: p goes on" in terminal.screen)
    terminal.type("p")
    terminal.wait(lambda: steps(3) >= 2)
    terminal.type("r")
    terminal.wait(lambda: (tmp_path / "episodes" / "0003.rerecorded1.mcap").exists() and steps(3) >= 2)
    assert termios.tcgetattr(terminal.fd)[3] & termios.ICANON == 0
    terminal.type(" ")
    assert terminal.end() == 130
    assert f"--resume {tmp_path}" in terminal.screen.replace("\r\n", "")
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.screen)
    for words in ("Move", "running, step", "resetting", "seen 0.", "take over / hand back", "1 of 1", "1 taken over"):
        assert words in plain, words

    marked, taken, again = (read_episode(tmp_path / "episodes" / f"000{n}.mcap") for n in (1, 2, 3))
    assert [k["key"] for k in marked.keys] == ["success"] and 0 < marked.keys[0]["time"] < 60
    assert marked.outcome and marked.outcome["success"] and marked.outcome["task_success"] is False
    assert len(marked.transitions["step"]) == STEPS and len(marked.joints["time"]) > 100
    assert taken.outcome and taken.outcome["intervened"] and "taken over by a person" in taken.outcome["aborted"]
    assert [k["key"] for k in taken.keys] == ["takeover", "takeover", "pause"] and taken.guided["qpos"].shape[1] == 7
    assert (np.diff(taken.guided["time"]) >= 0).all() and taken.guided["time"][0] >= taken.joints["time"][-1]
    assert again.outcome and "pressed stop" in again.outcome["aborted"]

    line = [sys.executable, "-m", "mpc_sgft.deploy", "--quiet", "--resume", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "summary.json").read_text())
    assert (found["real_rollouts"], found["aborted_rollouts"]) == (3, 2)
    assert (found["interventions"], found["rerecorded"]) == (1, 1)
    assert found["final_success"] == pytest.approx(1 / 3)
    assert found["robot"]["faults"] == 0
