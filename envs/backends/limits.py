"""What a robot may do, in numbers that make sense."""

from dataclasses import dataclass

import numpy as np

from envs.fr3 import Q_MAX, Q_MIN


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the robot may do.

    Attributes:
        low, high: Corners of the box for the tool's tip, base frame, [3] m.
        body_height: Every joint from the elbow on stays this far above the floor of the box, [m].
        joint_margin: Distance kept from the ends of each joint's range, [rad].
        speed: Share of each joint's greatest speed that a target may ask for, 0…1.
        step: Farthest that one control period may move the tip's target, [m].
        state_age: Oldest state of the robot that still counts as known, [s].
        detection_age: Oldest sight of the object that still counts as seen, [s].
        retries: Episodes in a row that may end by a fault before the session ends.

    Raises:
        ValueError: If the box is inside out, or a number is not what it must be.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    body_height: float
    joint_margin: float
    speed: float
    step: float
    state_age: float
    detection_age: float
    retries: int

    def __post_init__(self) -> None:
        for name, a, b in zip("xyz", self.low, self.high, strict=True):
            if not (np.isfinite([a, b]).all() and a < b):
                raise ValueError(f"the workspace box is inside out along {name}: low {a} m is not below high {b} m")
        if not 0 <= self.joint_margin < float(np.min(Q_MAX - Q_MIN)) / 2:
            raise ValueError(f"joint_margin={self.joint_margin} rad leaves a joint no range")
        if not 0 < self.speed <= 1:
            raise ValueError(f"speed={self.speed}; it is a share of the joints' greatest speed, above 0, at most 1")
        if not 0 <= self.body_height < np.inf:
            raise ValueError(f"body_height={self.body_height} m; it must be 0 or more")
        for name in ("step", "state_age", "detection_age"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}={getattr(self, name)}; it must be above 0")
        if self.retries < 0:
            raise ValueError(f"retries={self.retries}; it must be 0 or more")
