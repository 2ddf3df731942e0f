"""Which time a control period is counted in: the wall's, or the robot's own."""

import threading
import time
from typing import Protocol

from envs.backends.arm import Arm


class Clock(Protocol):
    """Time in seconds, and waiting for it."""

    def now(self) -> float:
        """Seconds since some moment in the past."""
        ...

    def wait(self, until: float, stop: threading.Event) -> None:
        """Return at a time, or as soon as `stop` is set."""
        ...


class WallClock:
    """Real time. What a robot needs."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, until: float, stop: threading.Event) -> None:
        stop.wait(max(0.0, until - time.monotonic()))


class RobotClock:
    """The robot's own time, for rehearsing with a stand-in on a computer that cannot simulate as fast as time passes.

    Args:
        arm: Whose newest state tells the time; somebody must be reading it.
    """

    def __init__(self, arm: Arm):
        self.arm = arm

    def now(self) -> float:
        return self.arm.newest_time

    def wait(self, until: float, stop: threading.Event) -> None:
        while self.now() < until and not stop.is_set():
            time.sleep(1e-3)


def make_clock(name: str, arm: Arm) -> Clock:
    """The clock of a name.

    Raises:
        ValueError: For an unknown name.
    """
    if name not in ("wall", "robot"):
        raise ValueError(f"clock={name!r}; allowed: wall, robot")
    return WallClock() if name == "wall" else RobotClock(arm)
