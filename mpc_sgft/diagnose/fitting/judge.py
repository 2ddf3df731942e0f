"""Is one structure credibly better than another? Errors per window, compared in pairs, resampled by windows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from mpc_sgft.diagnose.data.measured import Array

RESAMPLES = 1000
GAIN_LEVEL = 0.98  # a larger structure must be better with this confidence ...
TIE_LEVEL = 0.90  # ... while a rival of the same size must be worse with this one, or it ties
TIE_ODDS = 20.0  # ... or, where what is left is noise, be so much less likely
SURE_ODDS = 1000.0  # so much likelier, where what is left is noise, needs no confidence: a few windows give none
FEW = 12  # windows
MIN_SHARE = 0.05  # of the error in log(1 + e): a gain below is not worth a name
NEAR = 1.0  # in squares of noise: less above it is not much, whatever its share
ELSEWHERE = 0.4  # of the gain that matters, left without the best window: one window may have gone wrong by itself


class Interval(NamedTuple):
    mean: float
    low: float
    high: float


def gain(worse: Array, better: Array, level: float, rng: np.random.Generator) -> Interval:
    """Mean drop of the error from one structure to another with its interval (two-sided `level`).

    The bootstrap's, which knows that gains are not normal: an effect may show in a few windows only. Where windows are
    few, it is widened to Student's.

    Args:
        worse, better: Errors of the same windows, [W].
    """
    d = worse - better
    mean = float(d.mean())
    if len(d) < 2 or np.ptp(d) == 0:
        return Interval(mean, mean, mean)
    means = d[rng.integers(0, len(d), (RESAMPLES, len(d)))].mean(1)
    low, high = np.quantile(means, [0.5 - level / 2, 0.5 + level / 2])
    if len(d) >= FEW:
        return Interval(mean, float(low), float(high))
    half = float(stats.t.ppf(0.5 + level / 2, len(d) - 1) * d.std(ddof=1) / np.sqrt(len(d)))
    return Interval(mean, min(float(low), mean - half), max(float(high), mean + half))


def least_gain(error: float) -> float:
    """The smallest drop of an error, in log(1 + e), that is worth a name."""
    return MIN_SHARE * error


def leaves_much(error: float, nominal: float, share: float) -> bool:
    """Whether a set leaves more than this share of the nominal model's squared error above noise, and enough to matter.

    Args:
        error, nominal: Of the set and of the nominal model, in log(1 + e).
        share: 0…1.
    """
    return bool(np.expm1(error) - 1 > max(NEAR, share * (np.expm1(nominal) - 1)))


def credible(
    worse: Array,
    better: Array,
    rng: np.random.Generator,
    parts: int = 1,
    one_window: bool = False,
    log_odds: float | None = None,
) -> bool:
    """Whether the gain is real, in more than one window, and large enough to matter.

    Args:
        worse, better: Errors of the same parts of the same windows, [W parts].
        rng: For the bootstrap.
        parts: Of each window.
        one_window: Whether several parts of one window will do.
        log_odds: Logarithm of how much likelier the data are with the better one; None where that is not known.
    """
    g = gain(worse, better, 2 * GAIN_LEVEL - 1, rng)
    drops = (worse - better).reshape(-1, 1 if one_window else parts).mean(1)
    elsewhere = (drops.sum() - drops.max()) / max(len(drops) - 1, 1)
    least = least_gain(float(worse.mean()))
    real = g.low > 0 or log_odds is not None and log_odds > np.log(SURE_ODDS)
    return real and g.mean > least and bool(elsewhere > ELSEWHERE * least)


def ruled_out(rival: Array, best: Array, rng: np.random.Generator, log_odds: float | None = None) -> bool:
    """Whether a rival of the same size can be ruled out.

    Args:
        rival, best: Errors of the same parts of windows, [W].
        rng: For the bootstrap.
        log_odds: Logarithm of how much likelier the data are with the best; None where that is not known.
    """
    g = gain(rival, best, 2 * TIE_LEVEL - 1, rng)
    return bool(g.low > 0 if log_odds is None else log_odds > np.log(TIE_ODDS))


def win_shares(errors: Array, complexity: Array, rng: np.random.Generator, points: int) -> Array:
    """How often each structure has the lowest penalised error when windows are resampled, [M].

    The penalty is that of BIC, with the best structure's error as the variance.

    Args:
        errors: [M, W].
        complexity: Parameters of each, [M].
        points: Residuals per window.
    """
    count = errors.shape[1]
    best = float(errors.mean(1).min())
    penalty = best * complexity * np.log(count * points) / (count * points)
    picks = rng.integers(0, count, (RESAMPLES, count))
    means = errors[:, picks].mean(2) + penalty[:, None]
    return np.bincount(means.argmin(0), minlength=len(errors)) / RESAMPLES
