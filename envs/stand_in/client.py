"""Starts the stand-in and ends it; its scene as a source of object poses, with a hand to put the object somewhere."""

import importlib.util
import json
import os
import select
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from envs.backends.base import BackendError
from envs.perception.base import Array, Detection
from envs.task import AbstractTask

INSTALL = "pip install 'mpc_sgft[franka,franka-sim]'"
START_TIMEOUT = 120.0  # [s] for importing and compiling, on a busy machine too


class StandIn:
    """A running stand-in, seen as a Perception: a child process that ends with this one, whatever ends it.

    Args:
        task: What stands in its scene.

    Attributes:
        ip: Where the robot answers.

    Raises:
        BackendError: If franky-sim is missing, or the process does not come up.
    """

    def __init__(self, task: AbstractTask):
        if importlib.util.find_spec("franky_sim") is None:
            raise BackendError(f"--robot-ip stand-in needs franky-sim, which is not installed. Install it: {INSTALL}")
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        self.process = subprocess.Popen(
            [sys.executable, "-m", "envs.stand_in.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C is for the deployment, which ends this process in its own order
        )
        assert self.process.stdin is not None and self.process.stdout is not None
        start_q = task.start(np.random.default_rng(0)).qpos[0, :7].tolist()
        spec = task.spec()
        spec.compile()
        asked = json.dumps({"scene": spec.to_xml(), "start_q": start_q})
        self.process.stdin.write(asked.encode() + b"\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], START_TIMEOUT)
        line = self.process.stdout.readline() if ready else b""
        if not line:
            self.close()
            raise BackendError(
                f"the stand-in did not start (exit code {self.process.returncode}); its messages are above"
            )
        where = json.loads(line)
        self.ip: str = where["robot"]
        self.scene = Scene(where["scene"])

    def read(self) -> Detection | None:
        """Where the object is, in the newest frame of the scene."""
        return self.scene.read()

    def close(self) -> None:
        """End the process; a second call does nothing."""
        if hasattr(self, "scene"):
            self.scene.close()
        if self.process.stdin is not None and not self.process.stdin.closed:
            self.process.stdin.close()
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Scene:
    """The stand-in's scene: a Perception, and a hand that puts the object somewhere.

    Args:
        port: Of its socket on 127.0.0.1.
    """

    def __init__(self, port: int):
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=10.0)
        self._socket.settimeout(None)
        self._newest: Detection | None = None
        threading.Thread(target=self._watch, name="stand-in scene", daemon=True).start()

    def read(self) -> Detection | None:
        """The newest frame."""
        return self._newest

    def place(self, position: Array) -> None:
        """Put the object's centre somewhere, [3] m in the base frame, at rest; back when it is seen there.

        Raises:
            BackendError: If it does not get there.
        """
        self.tell(place=[float(x) for x in position])
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            seen = self._newest
            if seen is not None and np.linalg.norm(seen.position[:2] - position[:2]) < 5e-3:
                return
            time.sleep(0.01)
        raise BackendError("the stand-in did not put the object in its place")

    def tell(self, **order: Any) -> None:
        """Send an order of envs/stand_in/server.py: place, fault, blind or silent.

        Raises:
            BackendError: If the stand-in is gone.
        """
        try:
            self._socket.sendall((json.dumps(order) + "\n").encode())
        except OSError as error:
            raise BackendError(f"the stand-in is gone ({error})") from error

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _watch(self) -> None:
        try:
            for line in self._socket.makefile():
                frame = json.loads(line)
                self._newest = Detection(np.array(frame["position"]), frame["time"])
        except (OSError, ValueError):
            return  # hung up in the middle of a line; the newest frame grows old, which the watchdog sees
