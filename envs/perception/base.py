"""Where the object is: what a camera, a stand-in or a fixed pose answers, in one form."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


class PerceptionError(Exception):
    """A camera or another source of poses cannot be used. The message says why and what to do next."""


class Detection(NamedTuple):
    """One sight of the object.

    Attributes:
        position: Of the object's centre in the robot's base frame, [3] m.
        time: When the frame was captured, on the clock of time.monotonic(), [s]. Never when it was asked for.
    """

    position: Array
    time: float


class Perception(Protocol):
    """A source of object poses. `read` never blocks for longer than a few milliseconds and never repeats a pose under a
    new time: a lost object shows as None or as an old `time`, and the backend's watchdog does the rest."""

    def read(self) -> Detection | None:
        """The newest detection; None if the newest frame does not show the object."""
        ...

    def close(self) -> None:
        """Let go of the camera or the connection; a second call does nothing."""
        ...
