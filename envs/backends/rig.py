"""An arm under watch, with what sees the object: begin, follow a path, look, end, recover. It knows no task."""

import logging
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from envs.backends.arm import Arm, ArmState
from envs.backends.base import BackendError
from envs.backends.clock import make_clock
from envs.backends.gripper import Gripper
from envs.backends.safety import Gate, NotSafe, Retries, Unseen, doubt, unseen
from envs.backends.stream import Stream
from envs.kinematics import tip_position
from envs.perception.base import Detection, Perception

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Place = Callable[[NDArray[np.floating]], None]
KEEPS_UP = 0.95  # share of real time below which a stand-in's motions are no longer to be trusted


class Rig:
    """One arm, one object.

    Args:
        arm: Not yet connected.
        look: Opens what sees the object, when the robot is connected; with it what puts the object somewhere, [3] m in
            the base frame, or asks somebody to (None leaves the object where it is).
        gate: What may be sent.
        gripper: What holds the tool, not yet connected.
        clock: "wall", or "robot" to count periods on the robot's clock: for a stand-in that cannot keep up with time.
        patience: How long the arm holds and waits for a lost object before it stops, [s].
        dry_run: Everything but moving: nothing is streamed, nobody is asked to place anything.
    """

    def __init__(
        self,
        arm: Arm,
        look: Callable[[], tuple[Perception, Place | None]],
        gate: Gate,
        *,
        gripper: Gripper,
        clock: str,
        patience: float,
        dry_run: bool,
    ):
        if not isinstance(patience, int | float) or not 0 <= patience < np.inf:
            raise ValueError(f"patience={patience}; it must be a number of seconds, 0 or more")
        self.arm, self.gate, self.patience, self.dry_run = arm, gate, patience, dry_run
        self.gripper = gripper
        self.clock = make_clock(clock, arm)
        self.retries = Retries(gate.limits.retries)
        self.running: Stream | None = None
        self.waits = 0  # times that the object was lost for a moment
        self.elapsed = np.zeros(2)  # [s] that the arm was streamed to: on its own clock, and in real time
        self._look_with = look
        self._perception: Perception | None = None
        self._place: Place | None = None
        self._warned = False
        self.asked: Callable[[], str] = lambda: ""  # why a person wants the arm to stop, empty if nobody does
        self.by_person = False  # the last doubt was a person's wish
        self.seen: Detection | None = None  # newest sight

    def open(self) -> None:
        """Connect if need be, hold the tool, and stand ready.

        Raises:
            BackendError: Why not, and what to check.
        """
        if self._perception is None:
            self._perception, self._place = self._look_with()
        if self.arm.robot is None:
            self.arm.connect()
            if not self.dry_run:
                self.arm.recover()
        self.gripper.hold(self.arm.ip, moves=not self.dry_run)

    @property
    def stream(self) -> Stream:
        """What moves the arm.

        Raises:
            BackendError: If the arm is at rest.
        """
        if self.running is None:
            raise BackendError("the arm is at rest: reset first")
        return self.running

    def begin(self) -> None:
        """Hold the arm where it is, under watch."""
        self.end()

        def watch(state: ArmState, age: float, told: Array) -> str:
            told = state.q if self.dry_run else told
            tip = tip_position(state.q[None], self.gate.tool_length)[0]
            limits = self.gate.limits
            if wish := self.asked():
                self.by_person = True
                return wish
            return doubt(limits, state_age=age, mode=state.mode, q=state.q, told=told, dq=state.dq, tip=tip)

        self.running = Stream(self.arm, self.clock, self.gate, doubt=watch, moves=not self.dry_run)

    def follow(self, path: Array) -> None:
        """Play a path to its end.

        Raises:
            NotSafe: If the gate refuses it, or a doubt ended it.
        """
        self.stream.play(path)
        while self.stream.playing:
            time.sleep(self.gate.sample_dt)
        self.check()

    def check(self) -> None:
        """Raise NotSafe with the doubt that stopped the arm, if one did."""
        if self.stream.stopped.is_set():
            raise NotSafe(self.stream.doubt)

    def place(self, position: Array) -> None:
        """Have the object put somewhere, [3] m, where anybody can; meanwhile the arm rests without a controller."""
        if self._place is not None and not self.dry_run:
            self.end()
            self._place(position)
            self.begin()

    def sight(self) -> Detection:
        """A sight of the object that is new enough; while there is none, the arm holds and waits a while.

        A picture without the object says nothing: the sight before it counts until it is too old.

        Raises:
            Unseen: If none comes.
            NotSafe: If the arm was stopped.
        """
        deadline, waiting = time.monotonic() + self.patience, False
        while True:
            self.check()
            seen = self._newest()
            why = unseen(self.gate.limits, None if seen is None else time.monotonic() - seen.time)
            if seen is not None and not why:
                return seen
            if time.monotonic() > deadline:
                raise Unseen(why)
            if not waiting:
                self.stream.hold()
                waiting = True
                self.waits += 1
                log.warning("%s; the arm holds", why)
            time.sleep(0.01)

    def look_on(self) -> tuple[ArmState, Detection | None]:
        """The arm while nothing is sent to it, and the object if it is seen now."""
        seen = self._newest()
        lost = unseen(self.gate.limits, None if seen is None else time.monotonic() - seen.time)
        return self.arm.read(), None if lost else seen

    def _newest(self) -> Detection | None:
        seen = None if self._perception is None else self._perception.read()
        self.seen = self.seen if seen is None else seen
        return self.seen

    def end(self) -> str:
        """Bring the arm to rest; what the robot said about it, if anything."""
        if self.running is None:
            return ""
        stream, self.running = self.running, None
        self.elapsed += stream.elapsed
        if self.rate < KEEPS_UP and not self._warned:
            self._warned = True
            log.warning(
                "the robot's clock runs at %.2f of real time: this computer is too busy for the stand-in",
                self.rate,
            )
        return stream.close()

    @property
    def rate(self) -> float:
        """Seconds on the robot's clock for each second of real time: 1, but for a stand-in that cannot keep up."""
        return float(self.elapsed[0] / self.elapsed[1]) if self.elapsed[1] > 1.0 else 1.0

    def recover(self, reason: str) -> None:
        """Clear a fault; connect again if the connection is gone. A person's wish is no fault.

        Raises:
            BackendError: If that does not succeed, or it was one fault in a row too many.
        """
        try:
            if not self.by_person:
                self.retries.failed(reason)
            self.by_person = False
        except NotSafe as error:
            raise BackendError(f"the session ends after {error}. The arm is at rest.") from error
        try:
            self.arm.recover()
        except BackendError:
            self.arm.close()
            self.gripper.close()
            self.open()

    def close(self) -> None:
        """Stop the arm and disconnect."""
        self.end()
        self.arm.close()
        self.gripper.close()
        if self._perception is not None:
            self._perception.close()
            self._perception = None
