"""Short stretches of the measurement, each with its measured start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpc_sgft.diagnose.data.measured import Array, Episode, Index
from mpc_sgft.diagnose.data.smooth import Smooth

MOMENT = 1e-5  # [s]
BEFORE, AFTER, EITHER = (-MOMENT, 0.0), (0.0, MOMENT), (-MOMENT, MOMENT)


class Windows(NamedTuple):
    """W windows of n + 1 samples.

    Attributes:
        episode: Index of each window's episode, [W].
        start: Index of its first sample, [W].
        samples: n, predicted samples after the start.
        measured: Signals at these samples, [W, n, S].
        q0, v0, a0, j0: Measured start of each joint, to the third derivative of its position, [W, nj].
        acting: From when to when after its tick the command acts whose force a sample shows [s], [W, n, 2].
    """

    episode: Index
    start: Index
    samples: int
    measured: Array
    q0: Array
    v0: Array
    a0: Array
    j0: Array
    acting: Array


def cut(episodes: Sequence[Episode], smoothed: Sequence[Smooth], signals: Sequence[str], n: int) -> Windows:
    """Windows of n samples, one after the other; the first where smoothing the start has samples on both sides."""
    starts = [np.arange(s.half, len(e.ctrl) - n, n) for e, s in zip(episodes, smoothed, strict=True)]
    episode = np.repeat(np.arange(len(episodes)), [len(s) for s in starts])
    return at(episodes, smoothed, signals, episode, np.concatenate(starts), n)


def at(
    episodes: Sequence[Episode],
    smoothed: Sequence[Smooth],
    signals: Sequence[str],
    episode: Index,
    start: Index,
    n: int,
) -> Windows:
    """Windows of n samples after these starts.

    Args:
        episodes, smoothed: What was measured, and its joints' motion without noise.
        signals: To be compared.
        episode, start: Of each window, [W].
        n: Samples.
    """
    rows = [(i, np.arange(s + 1, s + n + 1)) for i, s in zip(episode, start, strict=True)]
    measured = np.array([[episodes[i].signals[name][r] for name in signals] for i, r in rows])

    def at_start(what: str) -> Array:
        return np.array([getattr(smoothed[i], what)[s] for i, s in zip(episode, start, strict=True)])

    jerk = [np.gradient(s.a, e.dt, axis=0) for s, e in zip(smoothed, episodes, strict=True)]
    off = np.array([np.broadcast_to(episodes[i].off_tick, len(episodes[i].ctrl))[r] for i, r in rows])
    known = np.isfinite(off)[..., None]
    return Windows(
        episode,
        start,
        n,
        np.moveaxis(measured, 1, 2),
        at_start("q"),
        at_start("v"),
        at_start("a"),
        np.array([jerk[i][s] for i, s in zip(episode, start, strict=True)]),
        np.where(known, np.nan_to_num(off)[..., None] + AFTER, EITHER),
    )
