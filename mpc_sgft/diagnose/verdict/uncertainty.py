"""How sure the parameters of a set are: what the data's scatter leaves open, and what else may be wrong with the model.

The first is statistical and shrinks with the data. A model's other flaws do not: they move an estimate by as much as
its own effect could make up for. Where the user says what prediction error does not matter, intervals also hold the
parameters that differ by less than that, the others moving along: nothing could tell them apart but errors that the
user does not care about.

Source: calibration with a model discrepancy, Kennedy and O'Hagan 2001 (10.1111/1467-9868.00294); that it cannot be told
from the parameters without prior knowledge of it, Brynjarsdottir and O'Hagan 2014 (10.1088/0266-5611/30/11/114007).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.verdict.tolerance import Tolerance

WIDER = 1.3  # of intervals: what windows that begin at each other's ends share; set on development seeds
LADDER = 0.5 * 2 ** (0.5 * np.arange(27))  # standard deviations by derivatives that a comparison goes away: to 4096
RUNGS = 9  # of these that are looked at together
STEP = 0.02  # in typical sizes, of the parameter that moves most, to see how predictions move
Interval = tuple[Array, Array]  # low and high of each parameter of one effect


class Flat(NamedTuple):
    """The parameters of all terms of a fit in one row, [P]."""

    values: Array
    sizes: Array  # typical ones
    low: Array
    high: Array
    ends: list[int]  # where the next term begins

    @classmethod
    def of(cls, f: Fit) -> Flat:
        sizes, low, high = (np.concatenate([getattr(t, name) for t in f.terms]) for name in ("size", "low", "high"))
        return cls(np.concatenate(f.values), sizes, low, high, np.cumsum([len(t.size) for t in f.terms])[:-1].tolist())

    def moved(self, by: Array) -> Array:
        """The values, moved as far as bounds allow."""
        return np.clip(self.values + by, self.low, self.high)

    def by_term(self, x: Array) -> list[Array]:
        """A row, term by term."""
        return np.split(x, self.ends)


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
    flat = Flat.of(f)
    return flat.by_term(flat.sizes * WIDER * np.sqrt(np.maximum(white, windows)))


def intervals(e: Hypothesis, level: float = 0.90) -> list[Interval]:
    """Low and high of each effect's parameters, as the data's scatter has them."""
    half = float(stats.t.ppf(0.5 + level / 2, max(len(e.fit.r) - 1, 1)))
    rows = zip(e.fit.terms, e.fit.values, standard_deviations(e), strict=True) if e.fit.terms else ()
    bounds = [(np.maximum(v - half * sd, t.low), np.minimum(v + half * sd, t.high)) for t, v, sd in rows]
    return bounds[len(bounds) - e.effects :]


def compared(setup: Setup[Any], e: Hypothesis, level: float = 0.90) -> list[Interval]:
    """The parameters that data cannot tell from the best, by comparing errors window by window as sets are compared.

    Where contacts begin and end within windows, derivatives are noise, and so is what `intervals` makes of them. Here
    each parameter goes away from its best value by ever more, the others along as far as derivatives say, until the
    errors have credibly risen, by a paired t-test at this level.
    """
    if not e.effects:
        return []
    f, everything = e.fit, np.concatenate([setup.fitted, setup.held])
    inverse, flat = _covariance(f), Flat.of(f)

    def errors(points: list[Array]) -> Array:
        r = setup.problem.residuals(f.terms, [flat.by_term(x) for x in points], everything)
        return setup.judged((r**2).mean(-1))

    best = errors([flat.values])[0]
    enough = WIDER * float(stats.t.ppf(0.5 + level / 2, len(best) - 1)) / np.sqrt(len(best))

    def worse_from(i: int, way: Array) -> float:
        """Where the i-th parameter is when errors have risen."""
        for some in LADDER.reshape(-1, RUNGS):
            tries = [flat.moved(k * way) for k in some]
            rise = errors(tries) - best  # [K, W]
            risen = np.flatnonzero(rise.mean(-1) > enough * rise.std(-1, ddof=1))
            if len(risen):
                return float(tries[risen[0]][i])
        return float((flat.low, flat.high)[int(way[i] > 0)][i])

    sd = np.concatenate(standard_deviations(e))
    ways = inverse / np.diag(inverse) * flat.sizes[:, None] / flat.sizes * sd  # column i: for one sd of the i-th
    reach = np.array([[worse_from(i, sign * way) for i, way in enumerate(ways.T)] for sign in (-1, 1)])
    return [*zip(*(flat.by_term(r)[len(f.terms) - e.effects :] for r in reach), strict=True)]


def sure_intervals(setup: Setup[Any], e: Hypothesis, tolerance: Tolerance, told: Array) -> list[Interval]:
    """The 90 % intervals that a report shows: statistical, and as squares add up, what the user tolerates.

    Args:
        setup: Problem; where its residuals are rugged, the statistical part is `compared`, else `intervals`.
        e: The set.
        tolerance: Prediction errors that do not matter.
        told: Weights of windows, [W].
    """
    statistical = compared(setup, e) if setup.problem.pattern else intervals(e)
    if not (tolerance.asked and e.effects):
        return statistical
    flat = Flat.of(e.fit)
    reach = flat.by_term(flat.sizes * indistinct(e.fit, tolerance, told))[len(e.fit.terms) - e.effects :]
    rows = zip(e.terms, e.values, statistical, reach, strict=True)
    return [
        (np.maximum(v - np.hypot(v - low, r), t.low), np.minimum(v + np.hypot(high - v, r), t.high))
        for t, v, (low, high), r in rows
    ]


def indistinct(f: Fit, tolerance: Tolerance, told: Array) -> Array:
    """How far each parameter can go, in typical sizes, until predictions differ by the tolerance, [P].

    The other parameters go along so that the predictions differ least: along a column of the inverse of J'J. To first
    order, from one step of each.
    """
    inverse, flat = _covariance(f), Flat.of(f)
    ways = inverse / np.abs(inverse).max(0)  # column i: the move of all for one of the i-th
    moved, went = [], []
    for i, way in enumerate(ways.T):
        ahead, back = (flat.moved(sign * STEP * way * flat.sizes) for sign in (1, -1))
        there = max((ahead, back), key=lambda x, i=i: abs(x[i] - flat.values[i]))  # away from a bound
        moved.append(f._replace(values=tuple(flat.by_term(there))))
        went.append(abs(there[i] - flat.values[i]) / flat.sizes[i])
    return np.array(went) / np.maximum(tolerance.shares([f, *moved], told), 1e-12)


def _covariance(f: Fit) -> Array:
    """Inverse of J'J, of windows as they were weighed, in typical sizes."""
    A = np.einsum("w,wmp,wmq->pq", f.weights, f.J, f.J, optimize=True)
    return np.linalg.pinv(A + 1e-12 * np.eye(len(A)) * max(float(np.trace(A)), 1e-30))
