"""Velocity, acceleration and noise of measured positions, by local cubic fits of the best width."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter

from mpc_sgft.diagnose.record import Array, Episode

HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40)  # samples


class Smooth(NamedTuple):
    """Per joint, [T, nj] and [nj].

    Attributes:
        q, v, a: Position, velocity and acceleration at the samples.
        noise: Standard deviation of the position noise.
        q_sd, v_sd: How uncertain q [nj] and v [T, nj] are, but for the ends; more where the velocity has corners.
        half: Samples at either end of the episode where they are more uncertain, a number.
    """

    q: Array
    v: Array
    a: Array
    noise: Array
    q_sd: Array
    v_sd: Array
    half: int


def noise_of(x: Array) -> float:
    """Standard deviation of white noise on a smooth signal [T], at least that of its quantisation.

    A cubic through five neighbours leaves the noise and next to nothing of the signal; the median over the recording
    is deaf to the few places where the signal has corners.
    """
    difference = np.diff(x, 4)
    plain = float(np.median(np.abs(difference))) / 0.6745 / np.sqrt(70.0)
    steps = np.abs(np.diff(x))
    moving = steps[steps > 0]
    if len(moving) and np.median(np.abs(moving / moving.min() - np.round(moving / moving.min()))) < 1e-3:
        plain = max(plain, float(moving.min()) / np.sqrt(12.0))
    return max(plain, 1e-12 * float(np.ptp(x)), 1e-15)


def smooth(episode: Episode, joints: Sequence[str]) -> Smooth:
    """Smooth every joint of an episode; measured velocities are used where they are better than derived ones."""
    columns = [_one(episode.signals[f"qpos/{j}"], episode.signals.get(f"qvel/{j}"), episode.dt) for j in joints]
    q, v, a, noise, q_sd, v_sd, half = (np.stack(parts, -1) for parts in zip(*columns, strict=True))
    return Smooth(q, v, a, noise, q_sd, v_sd, int(half.max()))


def _one(q: Array, measured_v: Array | None, dt: float) -> tuple[Array, ...]:
    noise = noise_of(q)
    best = None
    previous = None
    for half in (h for h in HALF_WIDTHS if 2 * h + 1 < len(q) // 2):
        width = 2 * half + 1
        v = np.asarray(savgol_filter(q, width, 3, deriv=1, delta=dt), float)
        spread = noise * float(np.linalg.norm(savgol_coeffs(width, 3, deriv=1, delta=dt)))
        bias = np.zeros(len(q)) if previous is None else v - previous
        error = np.hypot(spread, float(np.sqrt(np.mean(bias**2))))
        if best is None or error < best[0]:
            best = (error, width, v, np.maximum(error, np.hypot(spread, _nearby(bias, width))))
        previous = v
    assert best is not None, ("too few samples to smooth", len(q))
    error, width, v, v_sd = best
    wide = min(2 * width + 1, (len(q) // 2) * 2 - 1)
    a = np.asarray(savgol_filter(q, max(wide, 5), 3, deriv=2, delta=dt), float)
    level = np.asarray(savgol_filter(q, width, 3), float)
    q_sd = noise * float(np.linalg.norm(savgol_coeffs(width, 3)))
    if measured_v is not None:
        own = noise_of(measured_v)
        lag = float(np.clip(np.sum((v - measured_v) * a) / max(np.sum(a * a), 1e-30), -dt, dt))
        if own < error:
            v, v_sd = measured_v + lag * a, np.full(len(q), own)
    return level, v, a, np.array(noise), np.array(q_sd), v_sd, np.array(width // 2)


def _nearby(x: Array, width: int) -> Array:
    """Root mean square of [T] within a width of each sample."""
    return np.sqrt(np.maximum(uniform_filter1d(x**2, width, mode="nearest"), 0.0))
