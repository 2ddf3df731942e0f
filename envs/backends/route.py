"""The way to an episode's start: up, over to a safe posture, down; never through the table."""

import numpy as np
from numpy.typing import NDArray

from envs.fr3 import DQ_MAX
from envs.kinematics import inverse, tip_position

Array = NDArray[np.float64]
RISE = 0.01  # [m] of the tip between two solutions of the inverse kinematics


def reset_route(
    q: Array, start: Array, *, safe_tip: Array, rest: Array, tool_length: float, speed: float, sample_dt: float
) -> tuple[Array, Array]:
    """Paths from where the arm is to a safe posture, and from there down to the start.

    The tip first goes straight up, and outward where it is nearer to the base than the safe point, since close to the
    base the arm cannot rise without folding beyond its range. Each leg begins and ends at rest (minimum jerk), and its
    fastest joint reaches `speed` times its greatest speed.

    Args:
        q, start: Joint angles now and at the episode's start, [7] rad.
        safe_tip: Where the tip is in the safe posture, base frame, [3] m.
        rest: Posture to prefer, [7] rad.
        tool_length: From the flange to the tip, [m].
        speed: Share of the joints' greatest speed.
        sample_dt: Time between targets, [s].

    Returns:
        To the safe posture [S1, 7] and down [S2, 7], rad.
    """
    tip = tip_position(q[None], tool_length)[0]
    lifted = np.array([max(tip[0], safe_tip[0]), tip[1], max(tip[2], safe_tip[2])])
    up, down = (_line(a, b, rest, tool_length) for a, b in ((q, lifted), (start, safe_tip)))
    away = [_timed(leg, speed, sample_dt) for leg in (up, np.stack([up[-1], down[-1]]))]
    return np.concatenate(away), _timed(down[::-1], speed, sample_dt)


def _line(q: Array, goal: Array, rest: Array, tool_length: float) -> Array:
    """Postures [K, 7] that bring the tip straight to a point [3]."""
    tip = tip_position(q[None], tool_length)[0]
    postures = [q]
    for share in np.linspace(0, 1, max(2, round(float(np.linalg.norm(goal - tip)) / RISE) + 1))[1:]:
        postures.append(inverse(postures[-1][None], (tip + share * (goal - tip))[None], rest, tool_length)[0])
    return np.stack(postures)


def _timed(postures: Array, speed: float, sample_dt: float) -> Array:
    """Targets every sample_dt along a polyline of postures [K, 7], from rest to rest, [S, 7]."""
    length = np.concatenate([[0], np.cumsum((np.abs(np.diff(postures, axis=0)) / DQ_MAX).max(1))])  # [s] at full speed
    samples = max(1, int(np.ceil(1.875 * length[-1] / speed / sample_dt)))  # minimum jerk peaks at 1.875 times the mean
    t = np.linspace(0, 1, samples + 1)
    s = length[-1] * (10 * t**3 - 15 * t**4 + 6 * t**5)
    return np.stack([np.interp(s, length, postures[:, j]) for j in range(7)], 1)
