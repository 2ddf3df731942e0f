"""Kinematics of the FR3 from its Denavit-Hartenberg chain, batched over robots on NumPy arrays.

This is the robot controller's own model. It takes joint angles alone, so it serves the simulator and a real arm alike,
and it does not know of any effect that the simulated reality hides.
"""

import numpy as np
from numpy.typing import NDArray

from envs.fr3 import DH_A, DH_ALPHA, DH_D, FLANGE, Q_MAX, Q_MIN

Array = NDArray[np.float64]
MAX_STEP = 0.1  # [m] one iteration of the inverse moves the tip no further, so the linearisation holds


def chain(q: Array, tool_length: float) -> tuple[Array, Array, Array]:
    """Joint axes and tool of the arm, in the frame of its base.

    Args:
        q: Joint angles, [N, 7], rad.
        tool_length: From the flange to the tip, [m].

    Returns:
        origins [N, 7, 3] of the joint frames in m, axes [N, 7, 3] (z of each joint frame), tip [N, 3] in m.

    Source: Craig's convention, T_i = Rx(alpha) Tx(a) Rz(q) Tz(d).
    """
    n = len(q)
    x, y, z = (np.broadcast_to(row, (n, 3)) for row in np.eye(3))  # axes of the current frame
    position = np.zeros((n, 3))
    origins, axes = np.empty((n, 7, 3)), np.empty((n, 7, 3))
    cos, sin = np.cos(q)[..., None], np.sin(q)[..., None]
    for i in range(7):
        ca, sa = np.cos(DH_ALPHA[i]), np.sin(DH_ALPHA[i])
        tilted, z = ca * y + sa * z, ca * z - sa * y  # Rx(alpha)
        position = position + DH_A[i] * x + DH_D[i] * z
        x, y = cos[:, i] * x + sin[:, i] * tilted, cos[:, i] * tilted - sin[:, i] * x  # Rz(q)
        origins[:, i], axes[:, i] = position, z
    return origins, axes, position + (FLANGE + tool_length) * z


def tip_position(q: Array, tool_length: float) -> Array:
    """Position of the tool's tip in the base frame, [N, 3] m, for joint angles q [N, 7] rad."""
    return chain(q, tool_length)[2]


def inverse(
    q: Array,
    target: Array,
    rest: Array,
    tool_length: float,
    *,
    upright: float = 0.015,
    posture: float = 0.002,
    damping: float = 1e-3,
    iterations: int = 3,
) -> Array:
    """Joint angles that bring the tip to a target, tool downwards as far as the reach allows.

        min_dq  |J_p dq - e_p|^2 + upright^2 |J_o dq - e_o|^2 + posture^2 |q + dq - rest|^2 + damping^2 |dq|^2

    Damped least squares, started from q; the tip's position has by far the largest weight, so the tool tilts rather
    than miss its target near the edge of the workspace. Three iterations leave the tip within 0.5 mm of a target that
    is one control step away. The result stays within the joint range.

    Args:
        q: Joint angles to start from, [N, 7] rad.
        target: Where the tip should be, base frame, [N, 3] m.
        rest: Posture to prefer, [7] rad.
        tool_length: From the flange to the tip, [m].
    """
    eye = np.eye(7) * (posture**2 + damping**2)
    down = np.array([0.0, 0.0, -1.0])
    for _ in range(iterations):
        origins, axes, tip = chain(q, tool_length)
        tool = axes[:, -1:]
        jac = np.concatenate([_cross(axes, tip[:, None] - origins), upright * _cross(axes, tool)], 2)  # [N, 7, 6]
        error_p = target - tip
        far = np.linalg.norm(error_p, axis=1, keepdims=True)
        error_p = error_p * np.minimum(1.0, MAX_STEP / np.maximum(far, 1e-12))
        error = np.concatenate([error_p, upright * (down - tool[:, 0])], 1)[..., None]  # [N, 6, 1]
        pull = jac @ error + posture**2 * (rest - q)[..., None]
        q = np.clip(q + np.linalg.solve(jac @ jac.transpose(0, 2, 1) + eye, pull)[..., 0], Q_MIN, Q_MAX)
    return q


def _cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; np.cross takes three times as long."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
