"""The thread between the 5 Hz above and the 1 kHz below: plays gated paths, records joints, watches."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.backends.arm import Arm, ArmState
from envs.backends.base import BackendError
from envs.backends.clock import Clock
from envs.backends.safety import Gate

Array = NDArray[np.float64]
SAMPLE_DT = 0.008  # [s] between streamed targets and between joint samples: 125 Hz


class Sample(NamedTuple):
    """One row of the joint record: when [s, stream's clock], measured q, dq, torque and the target in force, [7]."""

    time: float
    q: Array
    dq: Array
    torque: Array
    told: Array


class Stream:
    """Plays paths at a fixed rate; on the first doubt it freezes the target and says so, and plays nothing more.

    Args:
        arm: Connected.
        clock: Which the rate is counted on.
        gate: Asked about every path once more, from the target in force on.
        doubt: (state, its age [s], target) -> why the arm must not go on, empty if it may.
        moves: Whether targets are really sent; a dry run asks the gate, reads and records alone.
    """

    def __init__(
        self, arm: Arm, clock: Clock, gate: Gate, *, doubt: Callable[[ArmState, float, Array], str], moves: bool
    ):
        self.arm, self.clock, self.gate, self._doubt, self.moves = arm, clock, gate, doubt, moves
        self.lock = threading.Lock()
        self.stopped = threading.Event()  # set on the first doubt, and by close
        self.doubt, self.doubt_time = "", 0.0
        self.state = arm.read()
        self.seen = self.began = time.monotonic()  # when the state last changed
        self.began_time = self.state.time
        self.told = self.state.q.copy()
        self.samples: list[Sample] = []
        self._noted = float("-inf")  # time of the last sample
        self._path, self._at = self.told[None], 0
        self._ending = False
        if moves:
            arm.track()
        self._thread = threading.Thread(target=self._run, name="robot stream", daemon=True)
        self._thread.start()

    def play(self, path: Array) -> None:
        """Replace what is being played by a path [S, 7].

        Raises:
            NotSafe: If the gate does not let it through, the way from the target in force included; that one stays.
        """
        with self.lock:
            self.gate.route(np.concatenate([self.told[None], path]))
            self._path, self._at = path if self.moves else path[-1:], 0

    def hold(self) -> Array:
        """Stay at the target in force, and return it, [7] rad."""
        with self.lock:
            self._path, self._at = self.told[None].copy(), 0
            return self.told.copy()

    @property
    def playing(self) -> bool:
        """Whether targets are left to play."""
        return self._at < len(self._path) and not self.stopped.is_set()

    @property
    def elapsed(self) -> tuple[float, float]:
        """How long this stream has heard of the robot: [s] on the robot's clock, and in real time."""
        return self.state.time - self.began_time, self.seen - self.began

    def take_samples(self) -> list[Sample]:
        """What was recorded since the last call."""
        with self.lock:
            taken, self.samples = self.samples, []
        return taken

    def close(self) -> str:
        """End the thread and bring the arm to rest; what the robot said about its end, if anything."""
        self._ending = True
        self._thread.join(5.0)
        self.stopped.set()
        return self.arm.stop()

    def _run(self) -> None:
        due, dt = self.clock.now(), self.gate.sample_dt
        while not self._ending and not self.stopped.is_set():
            try:
                state = self.arm.read()
                if state.time != self.state.time:
                    self.state, self.seen = state, time.monotonic()
                if self.clock.now() >= due:
                    self._tick()
                    due = max(due + dt, self.clock.now() - 5 * dt)  # a short delay is made up
            except BackendError as error:
                self._stop(str(error))
            time.sleep(min(max(due - self.clock.now(), 5e-4), dt / 4))

    def _tick(self) -> None:
        """Look for doubts; if there is none, send the next target. Note the sample."""
        state = self.state
        with self.lock:
            if self.moves and not self.arm.in_control:
                self._stop(self._doubt(state, 0.0, self.told) or "the robot ended the motion")
            elif why := self._doubt(state, time.monotonic() - self.seen, self.told):
                self._stop(why)
            elif self._at < len(self._path):
                self.told = self._path[self._at]
                self._at += 1
                if self.moves:
                    self.arm.aim(self.told)
            self._note(Sample(self.clock.now(), state.q, state.dq, state.torque, self.told))

    def _note(self, sample: Sample) -> None:
        """Keep a sample; of several at one time (a delay is made up while the robot's clock stands) the last."""
        if sample.time > self._noted:
            self._noted = sample.time
            self.samples.append(sample)
        elif self.samples:
            self.samples[-1] = sample._replace(time=self._noted)

    def _stop(self, why: str) -> None:
        self.doubt, self.doubt_time = why, time.monotonic()
        self.stopped.set()
