"""What a held command was on average between any two moments."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from mpc_sgft.diagnose.data.measured import Array

MIN_LAG = 1e-5  # [s] faster than this is no lag


def held_mean(u: Array, dt: float, edges: Array, lag: float = 0.0) -> Array:
    """Mean of a held command [T] over intervals [..., 2] of time since the first sample; constant beyond the ends.

    Args:
        u: The command.
        dt: Seconds for which each is held.
        edges: Beginning and end of the intervals [s].
        lag: Time constant of a first-order low pass that it goes through, exactly [s].
    """
    total = np.concatenate([[0.0], np.cumsum(u)]) * dt
    x = edges / dt
    inside = np.interp(x, np.arange(len(total)), total)
    inside = inside + np.minimum(x, 0) * u[0] * dt + np.maximum(x - len(u), 0) * u[-1] * dt
    if lag > MIN_LAG:  # lag dy/dt = u - y
        keep = np.exp(-dt / lag)
        y, _ = lfilter([0.0, 1 - keep], [1.0, -keep], u, zi=[u[0]])  # at the samples
        k = np.clip(np.floor(x), 0, len(u) - 1).astype(int)
        inside = inside - lag * (u[k] + (y - u)[k] * np.exp(-np.maximum(edges - k * dt, 0) / lag))
    return (inside[..., 1] - inside[..., 0]) / (edges[..., 1] - edges[..., 0])
