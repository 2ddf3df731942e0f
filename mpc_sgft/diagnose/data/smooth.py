"""Velocity, acceleration and noise of measured positions, by local cubic fits of the best width."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter

from mpc_sgft.diagnose.data.measured import Array, Episode, Index

HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40)  # samples


class Smooth(NamedTuple):
    """Per joint, [T, nj] and [nj].

    Attributes:
        q, v, a: Position, velocity and acceleration at the samples.
        noise: Standard deviation of the position noise.
        q_sd, v_sd: How uncertain q and v are, [T, nj], but for the ends; more where the motion has corners.
        half: Samples at either end of the episode where they are more uncertain, a number.
        spread: Samples of the true acceleration that each `a` is a mean of, [nj], odd.
    """

    q: Array
    v: Array
    a: Array
    noise: Array
    q_sd: Array
    v_sd: Array
    half: int
    spread: Index


def noise_of(x: Array) -> float:
    """Standard deviation of white noise on a smooth signal [T], at least that of its quantisation.

    A cubic through five neighbours leaves the noise and next to nothing of the signal; the median over the recording
    is deaf to the few places where the signal has corners.
    """
    difference = np.diff(x, 4)
    plain = float(np.median(np.abs(difference))) / 0.6745 / np.sqrt(70.0)
    return max(plain, quantum(x) / np.sqrt(12.0), 1e-12 * float(np.ptp(x)), 1e-15)


def quantum(x: Array) -> float:
    """The step of a signal [T] all of whose steps are multiples of one; 0 if they are not."""
    steps = np.abs(np.diff(x))
    moving = steps[steps > 0]
    if not len(moving) or np.median(np.abs(moving / moving.min() - np.round(moving / moving.min()))) >= 1e-3:
        return 0.0
    return float(moving.min())


def smooth(episode: Episode, joints: Sequence[str]) -> Smooth:
    """Smooth every joint of an episode; measured velocities are used where they are better than derived ones."""
    columns = [_one(episode.signals[f"qpos/{j}"], episode.signals.get(f"qvel/{j}"), episode.dt) for j in joints]
    q, v, a, noise, q_sd, v_sd, half, wide = (np.stack(parts, -1) for parts in zip(*columns, strict=True))
    return Smooth(q, v, a, noise, q_sd, v_sd, int(half.max()), wide)


def averaged(force: Array, spread: int) -> Array:
    """A force [T] as `Smooth.a` of that spread shows the acceleration that it makes.

    The second derivative of a local cubic is a weighted mean of the true one: its coefficients, summed up twice.
    """
    kernel = np.cumsum(np.cumsum(savgol_coeffs(spread, 3, deriv=2)))[:-2]
    return np.convolve(np.pad(force, len(kernel) // 2, mode="edge"), kernel, mode="valid")


def _one(q: Array, measured_v: Array | None, dt: float) -> tuple[Array, ...]:
    noise = noise_of(q)
    level, q_sd, _ = _best(q, noise, dt, 0)
    v, v_sd, width = _best(q, noise, dt, 1)
    wide = min(2 * width + 1, (len(q) // 2) * 2 - 1)
    wide = max(wide, 5)
    a = np.asarray(savgol_filter(q, wide, 3, deriv=2, delta=dt), float)
    if measured_v is not None:
        own = noise_of(measured_v)
        lag = float(np.clip(np.sum((v - measured_v) * a) / max(np.sum(a * a), 1e-30), -dt, dt))
        if own < np.sqrt(np.mean(v_sd**2)):
            v, v_sd = measured_v + lag * a, np.full(len(q), own)
    return level, v, a, np.array(noise), q_sd, v_sd, np.array(width // 2), np.array(wide)


def _best(q: Array, noise: float, dt: float, order: int) -> tuple[Array, Array, int]:
    """A derivative of [T] by the width whose error is least, how uncertain it is [T], and the width.

    How much a width bends the motion shows against the next narrower one, and for the narrowest against the next wider.
    """
    widths = [2 * half + 1 for half in HALF_WIDTHS if 2 * half + 1 < len(q) // 2]
    assert widths, ("too few samples to smooth", len(q))
    x = [np.asarray(savgol_filter(q, w, 3, deriv=order, delta=dt), float) for w in widths]
    spread = [noise * float(np.linalg.norm(savgol_coeffs(w, 3, deriv=order, delta=dt))) for w in widths]
    bent = [np.zeros(len(q)), *np.diff(x, axis=0)]
    error = [float(np.hypot(s, np.sqrt(np.mean(b**2)))) for s, b in zip(spread, bent, strict=True)]
    best = int(np.argmin(error))
    nearby = _nearby(bent[max(best, min(1, len(widths) - 1))], widths[best])
    return x[best], np.maximum(error[best], np.hypot(spread[best], nearby)), widths[best]


def _nearby(x: Array, width: int) -> Array:
    """Root mean square of [T] within a width of each sample."""
    return np.sqrt(np.maximum(uniform_filter1d(x**2, width, mode="nearest"), 0.0))
