"""Does an effect matter? Whether it is there is another question: with enough data the answer to that is always yes.

Every machine differs from its model in a hundred small ways. An effect is a trace if the other effects, fitted anew
without it, foretell about as well: if its share of the nominal model's squared error on windows that were not fitted,

    share_i = (E(S without i) - E(S)) / E(nominal) < MATTERS,

is small, and predictions do not change by more than SMALL of the motion for certain. E is in units of noise, noise
included: where the nominal model leaves noise alone, nothing can matter much. Where the user says what prediction error
does not matter, that alone decides. A trace is listed with its size, and is no second name, no tie and no `unknown`.

Sources: smallest effect size of interest, Lakens, Scheel, Isager 2018 (10.1177/2515245918770963); share of variance
explained (eta squared) and 0.01 as a small one of it, Cohen 1988, chapter 8.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.candidates.library import IDLE_WHILE_NEUTRAL, Term
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import OUTLYING
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, simpler, without_effect
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.verdict.tolerance import Tolerance
from mpc_sgft.diagnose.verdict.uncertainty import intervals

MATTERS = 0.01  # of the nominal model's squared error, a tenth of its root mean square: what is less is a trace


class Relevance(NamedTuple):
    """What one effect of a set does beyond the others, as a share of the nominal model's squared error.

    Attributes:
        term: The effect.
        value: Its parameters in the set.
        share: 0…1; less than 0 where the set foretells better without it.
        low, high: 90 % interval.
    """

    term: Term
    value: Array
    share: float
    low: float
    high: float


def what_matters(
    setup: Setup[Any],
    there: Hypothesis,
    hypotheses: list[Hypothesis],
    rng: np.random.Generator,
    tolerance: Tolerance,
) -> tuple[Hypothesis, list[Relevance]]:
    """The set of what matters, fitted by itself, and the traces that were left out of it, largest first.

    The least effect goes first, and the others are fitted anew without it. An effect makes way for a simpler one that
    it includes if that leaves no more that matters. Fitted sets join `hypotheses`.
    """
    best, traces, told = there, [], foretold(setup, there)
    spare = MATTERS * mean_error(setup, hypotheses[0], told)
    while best.effects:
        shares = shares_of(setup, best, there, hypotheses, rng)
        i = int(np.argmin([s.share for s in shares]))
        without = without_effect(setup, best, i, hypotheses)
        small = tolerance.asked or shares[i].share < MATTERS
        if small and tolerance.alike(without.fit, there.fit, by_window(told, setup), 1 / certain(best, i)):
            traces.append(shares[i])
            best = without
            continue
        less = simplest(setup, best, hypotheses, told, spare, tolerance)
        if less is best:
            break
        best = less
    return best, sorted(traces, key=lambda s: -s.share)


def certain(e: Hypothesis, i: int) -> float:
    """Share of the i-th effect's size that is there at the nearer ends of its parameters' intervals, above 0."""
    term, value, (low, high) = e.terms[i], e.values[i], intervals(e)[i]
    counts = np.array([n not in IDLE_WHILE_NEUTRAL for n in term.names]) / term.size
    least = np.clip(term.neutral, low, high)
    return float(
        max(np.linalg.norm((least - term.neutral) * counts) / np.linalg.norm((value - term.neutral) * counts), 1e-9)
    )


def shares_of(
    setup: Setup[Any], e: Hypothesis, there: Hypothesis, hypotheses: list[Hypothesis], rng: np.random.Generator
) -> list[Relevance]:
    """What each effect of a set does beyond the others of it, on windows that `there` foretells."""
    told = foretold(setup, there)
    nominal = mean_error(setup, hypotheses[0], told)
    out = []
    for i, (term, value) in enumerate(zip(e.terms, e.values, strict=True)):
        worse, better = (told * setup.squared(x.errors) for x in (without_effect(setup, e, i, hypotheses), e))
        out.append(Relevance(term, value, *(x / nominal for x in judge.gain(worse, better, 0.90, rng))))
    return out


class Repairs(NamedTuple):
    """Whether a set lowers errors, and on which windows that shows, in words."""

    lowers: bool
    on: str


def repairs(
    setup: Setup[Any], held: Hypothesis, there: Hypothesis, base: Hypothesis, rng: np.random.Generator
) -> Repairs:
    """Whether a set lowers the error of windows that were never fitted: credibly in most, and not less in the mean.

    Squared errors of windows differ by orders of magnitude, so that a few of them decide a mean: what is judged is the
    logarithm, and the mean is that of windows which `there` foretells. Fewer than `judge.FEW` windows show nothing for
    certain: then those that were fitted count as well, each foretold by the others.
    """
    first = len(setup.fitted) * setup.parts
    told = foretold(setup, there)[first:]
    before, after = (float((told * setup.squared(e.errors[first:])).mean()) for e in (base, held))
    apart = f"the {len(setup.held)} windows that were never fitted"
    if after >= before:
        return Repairs(False, apart)
    if len(setup.held) < judge.FEW:
        first, apart = 0, f"all {len(setup.fitted) + len(setup.held)} windows, each foretold by the others"
    return Repairs(judge.gain(base.errors[first:], held.errors[first:], 0.90, rng).low > 0, apart)


def foretold(setup: Setup[Any], best: Hypothesis) -> Array:
    """Weights of windows, [W] with mean 1: one that all effects together do not foretell says little of any of them.

    Near a pendulum's upper rest, for one, the last digit decides where it falls. As the fit itself weighs windows.
    """
    errors = setup.squared(best.errors)
    weight = 1 / (1 + errors / (OUTLYING * max(1.0, float(np.median(errors)))))
    return weight / weight.mean()


def by_window(told: Array, setup: Setup[Any]) -> Array:
    """Weights of parts of windows, fitted ones first -> of all windows in their own order, [W]."""
    out = np.empty(len(told) // setup.parts)
    out[np.concatenate([setup.fitted, setup.held])] = told.reshape(-1, setup.parts).mean(1)
    return out


def mean_error(setup: Setup[Any], e: Hypothesis, told: Array) -> float:
    """Mean squared error of weighted windows, in units of noise, floor and tolerance."""
    return float((told * setup.squared(e.errors)).mean())


def errors_by_signal(setup: Setup[Any], e: Hypothesis, told: Array) -> Array:
    """Mean squared error of each signal in units of noise, floor and tolerance, [S]; told: weights of windows, [W]."""
    r = setup.problem.residuals(e.fit.terms, [e.fit.values], np.arange(len(told)))[0]
    return (told[:, None, None] * r.reshape(len(told), setup.problem.blocks, -1) ** 2).mean((0, 1))


def noise_shares(setup: Setup[Any]) -> Array:
    """How much of those units is noise and floor, 0…1, [S]; [1] where nothing is tolerated."""
    if not np.any(setup.tolerated):
        return np.ones(1)
    return 1 - (setup.tolerated**2 / setup.problem.scale**2).mean((0, 1))


def simplest(
    setup: Setup[Any], best: Hypothesis, hypotheses: list[Hypothesis], told: Array, spare: float, tolerance: Tolerance
) -> Hypothesis:
    """The set with one effect in place of one that includes it, if what that costs does not matter.

    It leaves at most `spare` more of squared error, and predicts the same but for the tolerance; if the user gave that,
    it alone decides.
    """
    enough = mean_error(setup, best, told) + spare
    alike = (e for e in simpler(setup, best, hypotheses) if e.complexity < best.complexity)
    cheap = [e for e in alike if tolerance.asked or mean_error(setup, e, told) <= enough]
    enough_told = [e for e in cheap if tolerance.alike(e.fit, best.fit, by_window(told, setup))]
    return min(enough_told, key=lambda e: (e.complexity, e.error), default=best)
