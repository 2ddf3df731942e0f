"""How sure the parameters of a set are: what the data's scatter leaves open, and what else may be wrong with the model.

The first is statistical and shrinks with the data. A model's other flaws do not: they move an estimate by as much as
its own effect could make up for. Where the user says what prediction error does not matter, intervals also hold the
parameters that differ by less than that, the others moving along: nothing could tell them apart but errors that the
user does not care about.

Source: calibration with a model discrepancy, Kennedy and O'Hagan 2001 (10.1111/1467-9868.00294); that it cannot be told
from the parameters without prior knowledge of it, Brynjarsdottir and O'Hagan 2014 (10.1088/0266-5611/30/11/114007).
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.verdict.tolerance import Tolerance

WIDER = 1.3  # of intervals: what windows that begin at each other's ends share; set on development seeds
STEP = 0.02  # in typical sizes, of the parameter that moves most, to see how predictions move
Interval = tuple[Array, Array]  # low and high of each parameter of one effect


def standard_deviations(e: Hypothesis) -> list[Array]:
    """Standard deviations of each term's parameters: the wider of the model's and the windows' own scatter.

    The first takes residuals as white, the second (a sandwich over windows) lets each window have its own error.
    """
    f = e.fit
    if not f.J.shape[-1]:
        return []
    inverse = _covariance(f)
    white = np.diag(inverse) * max(1.0, float(f.weights @ (f.r**2).mean(1) / f.weights.sum()))
    scores = np.einsum("w,wmp,wm->wp", f.weights, f.J, f.r, optimize=True)
    windows = np.diag(inverse @ (scores.T @ scores) @ inverse)
    return _by_term(f, WIDER * np.sqrt(np.maximum(white, windows)))


def intervals(e: Hypothesis, level: float = 0.90) -> list[Interval]:
    """Low and high of each effect's parameters, as the data's scatter has them."""
    return _around(e, [_half(e, level) * sd for sd in standard_deviations(e)])


def tolerant_intervals(e: Hypothesis, tolerance: Tolerance, told: Array, level: float = 0.90) -> list[Interval]:
    """`intervals`, and with them what differs by no more than the user tolerates, as squares add up.

    Args:
        e: The set.
        tolerance: Prediction errors that do not matter; if the user gave none, the intervals are `intervals`.
        told: Weights of windows, [W].
        level: Of the statistical part.
    """
    if not (tolerance.asked and e.effects):
        return intervals(e, level)
    reach = _by_term(e.fit, indistinct(e.fit, tolerance, told))
    statistical = (_half(e, level) * sd for sd in standard_deviations(e))
    return _around(e, [np.hypot(s, r) for s, r in zip(statistical, reach, strict=True)])


def indistinct(f: Fit, tolerance: Tolerance, told: Array) -> Array:
    """How far each parameter can go, in typical sizes, until predictions differ by the tolerance, [P].

    The other parameters go along so that the predictions differ least: along a column of the inverse of J'J. To first
    order, from one step of each.
    """
    inverse = _covariance(f)
    sizes = np.concatenate([t.size for t in f.terms])
    ways = inverse / np.abs(inverse).max(0)  # column i: the move of all for one of the i-th
    low, high = (np.concatenate([getattr(t, end) for t in f.terms]) for end in ("low", "high"))
    here, moved, went = np.concatenate(f.values), [], []
    for i, way in enumerate(ways.T):
        ahead, back = (np.clip(here + sign * STEP * way * sizes, low, high) for sign in (1, -1))
        there = max((ahead, back), key=lambda x, i=i: abs(x[i] - here[i]))  # away from a bound
        moved.append(f._replace(values=tuple(np.split(there, np.cumsum([len(t.size) for t in f.terms])[:-1]))))
        went.append(abs(there[i] - here[i]) / sizes[i])
    return np.array(went) / np.maximum(tolerance.shares([f, *moved], told), 1e-12)


def _covariance(f: Fit) -> Array:
    """Inverse of J'J, of windows as they were weighed, in typical sizes."""
    A = np.einsum("w,wmp,wmq->pq", f.weights, f.J, f.J, optimize=True)
    return np.linalg.pinv(A + 1e-12 * np.eye(len(A)) * max(float(np.trace(A)), 1e-30))


def _half(e: Hypothesis, level: float) -> float:
    """Half the width of an interval in standard deviations."""
    return float(stats.t.ppf(0.5 + level / 2, max(len(e.fit.r) - 1, 1)))


def _by_term(f: Fit, x: Array) -> list[Array]:
    """Numbers of all parameters in typical sizes -> in their own units, term by term."""
    ends = np.cumsum([len(t.size) for t in f.terms])
    return [part * t.size for part, t in zip(np.split(x, ends[:-1]), f.terms, strict=True)]


def _around(e: Hypothesis, half: list[Array]) -> list[Interval]:
    """Intervals of the effects, of so much to each side, within what their parameters can be."""
    rows = zip(e.fit.terms, e.fit.values, half, strict=True) if e.fit.terms else ()
    bounds = [(np.maximum(v - h, t.low), np.minimum(v + h, t.high)) for t, v, h in rows]
    return bounds[len(e.fit.terms) - e.effects :]
