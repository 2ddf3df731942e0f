"""An object that nobody looks at: its pose is given once and is taken for true."""

import time
from collections.abc import Sequence

import numpy as np

from envs.perception.base import Detection


class Fixed:
    """The same pose at all times. For a first try of the arm without cameras; the task will not see what it does.

    Args:
        position: Of the object in the robot's base frame, [3] m.

    Raises:
        ValueError: If it is not three finite numbers.
    """

    def __init__(self, position: Sequence[float]):
        self.position = np.array(position, float)
        if self.position.shape != (3,) or not np.isfinite(self.position).all():
            raise ValueError(
                f"position={list(position)}; three numbers in metres are needed, in the robot's base frame"
            )

    def read(self) -> Detection:
        """The given pose, as of now."""
        return Detection(self.position, time.monotonic())

    def close(self) -> None:
        """Nothing is open."""
