"""Which set of effects the data call for, and what ties with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from mpc_sgft.diagnose.candidates.effect_table import EQUIVALENT, Equivalence
from mpc_sgft.diagnose.candidates.library import IDLE_WHILE_NEUTRAL
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, holds, without_effect
from mpc_sgft.diagnose.fitting.prepare import ABOVE_NOISE, NOISE, Setup
from mpc_sgft.diagnose.verdict.uncertainty import intervals, standard_deviations

NEAREST = 8  # rivals that are simulated to see whether they foretell the same


def choose(setup: Setup[Any], hypotheses: list[Hypothesis], rng: np.random.Generator) -> Hypothesis:
    """The smallest set that no larger one credibly beats; of several effects, each must be surely there."""
    current = hypotheses[0]
    while True:
        larger = [e for e in hypotheses if e.complexity > current.complexity and e.error < current.error]
        better = [
            e for e in larger if gains(setup, current, e, rng) and (e.effects < 2 or surely_there(setup, current, e))
        ]
        if not better:
            return prune(setup, current, hypotheses, rng)
        smallest = min(e.complexity for e in better)
        current = min(
            (e for e in better if e.complexity == smallest), key=lambda e: e.error + judge.least_gain(e.error) * e.idle
        )


def gains(setup: Setup[Any], small: Hypothesis, large: Hypothesis, rng: np.random.Generator) -> bool:
    """Whether a larger set is credibly better."""
    likelier = log_odds(setup, large, small) if settled(small) else None
    return judge.credible(
        small.errors, large.errors, rng, setup.parts, setup.one_window(large.errors), log_odds=likelier
    )


def surely_there(setup: Setup[Any], small: Hypothesis, large: Hypothesis) -> bool:
    """Whether each effect is away from none, or, where noise alone is left, the data are far likelier with all."""
    likelier = log_odds(setup, large, small) if small.effects and settled(small) else None
    return distinct(large) or likelier is not None and likelier > np.log(judge.SURE_ODDS)


def distinct(e: Hypothesis) -> bool:
    """Whether a parameter of each effect is credibly away from no effect."""
    limits = zip(e.terms, intervals(e, 2 * judge.GAIN_LEVEL - 1), strict=True)
    return all(
        np.any((low > t.neutral) | (high < t.neutral), where=[n not in IDLE_WHILE_NEUTRAL for n in t.names])
        for t, (low, high) in limits
    )


def prune(setup: Setup[Any], best: Hypothesis, hypotheses: list[Hypothesis], rng: np.random.Generator) -> Hypothesis:
    """Leave out effects that are not needed once the others are there; fitted subsets join `hypotheses`."""
    for i in range(best.effects if best.effects > 1 else 0):
        without = without_effect(setup, best, i, hypotheses)
        if not gains(setup, without, best, rng):
            return prune(setup, without, hypotheses, rng)
    return best


def find_ties(
    setup: Setup[Any],
    best: Hypothesis,
    there: Hypothesis,
    hypotheses: list[Hypothesis],
    rng: np.random.Generator,
    alike: Callable[[Fit, Fit], bool] = lambda a, b: False,
) -> list[Hypothesis]:
    """Other sets of no more names and parameters than the best that are not credibly worse, best first.

    Not those that hold the best, and can do all that it does: a richer effect must gain something. Nor those that are
    credibly worse with all that is there beside what matters: what the best leaves out makes a rival look as good.

    Args:
        setup: Problem and baseline.
        best: The set of what matters.
        there: The set of all that is there.
        hypotheses: All that were fitted.
        rng: For the bootstrap.
        alike: Whether two fits foretell so much the same that it does not matter which is right: those tie.
    """
    rivals = [e for e in hypotheses if 0 < e.effects <= best.effects and 0 < e.complexity and no_larger(e, best)]
    other = [e for e in rivals if sorted(e.names) != sorted(best.names) and not holds(e, best)]

    def beaten(e: Hypothesis, by: Hypothesis) -> bool:
        return judge.ruled_out(e.errors, by.errors, rng, log_odds(setup, by, e))

    def worse(e: Hypothesis) -> bool:
        whole = with_all(e, best, there, hypotheses)
        return beaten(e, best) or whole is not None and beaten(whole, there)

    other.sort(key=lambda e: e.error)
    return [e for i, e in enumerate(other) if not worse(e) or i < NEAREST and alike(e.fit, best.fit)]


def with_all(e: Hypothesis, best: Hypothesis, there: Hypothesis, hypotheses: list[Hypothesis]) -> Hypothesis | None:
    """A rival of the best with what `there` has beside or in place of what is in both; None if it was not fitted."""
    left_out, instead = {*there.names} - {*best.names}, {*best.names} - {*there.names}
    if not left_out or not instead <= {*e.names}:
        return None
    names = sorted(({*e.names} - instead) | left_out)
    return min((h for h in hypotheses if sorted(h.names) == names), key=lambda h: h.error, default=None)


def as_given(setup: Setup[Any], best: Hypothesis, ties: list[Hypothesis]) -> tuple[Hypothesis, list[Hypothesis]]:
    """The best set, and the ties that are left, where some need nominal quantities that are just as given.

    An uncertain mass could be any within its range: where a set finds it to a fraction of that range, and there at the
    nominal value, a set that does as well with another mass needs a second cause, and the first a coincidence.
    """
    count = len(setup.baseline.terms)
    if not count or not ties:
        return best, ties
    sets = [best, *ties]
    plain = np.array([_odds_as_given(e, count) for e in sets])
    least = plain.max() - np.log(judge.TIE_ODDS)
    kept = [e for e, x in zip(sets, plain, strict=True) if x >= least]
    return kept[0], kept[1:]


def _odds_as_given(e: Hypothesis, count: int) -> float:
    """Logarithm of how much likelier nominal quantities are as given than anywhere in their range (Savage-Dickey).

    Args:
        e: A set.
        count: Nominal terms, its first ones.
    """
    total = 0.0
    for term, value, sd in zip(e.fit.terms[:count], e.fit.values[:count], standard_deviations(e)[:count], strict=True):
        span = term.high - term.low
        there = stats.norm.pdf(term.neutral, value, np.maximum(sd, 1e-12 * span))
        total += float(np.log((1 + span * there) / 2).sum())
    return total


def no_larger(e: Hypothesis, best: Hypothesis) -> bool:
    """Whether a set has no more parameters than the best, of those that show in the data or of all."""
    return e.complexity <= best.complexity or sum(map(len, e.values)) <= sum(map(len, best.values))


def log_odds(setup: Setup[Any], best: Hypothesis, rival: Hypothesis) -> float | None:
    """Logarithm of how much likelier the data are with the best than with a rival; None where more than noise is left.

    Of one signal's independent residuals: noise is not quite white. Those of windows that are left out, where the best
    has more parameters.
    """
    if not settled(best):
        return None
    a, b = (e.errors if best.complexity > rival.complexity else e.fitted for e in (rival, best))
    return setup.problem.blocks / setup.parts * float((np.expm1(a) - np.expm1(b)).sum()) / 2


def equivalence(a: Hypothesis, b: Hypothesis) -> Equivalence | None:
    """The declared class in which two sets differ, if that is all they differ in."""
    only_a = [t.effect for t in a.terms if t.label not in b.names]
    only_b = [t.effect for t in b.terms if t.label not in a.names]
    if len(only_a) != 1 or len(only_b) != 1:
        return None
    both = {only_a[0], only_b[0]}
    return next((q for q in EQUIVALENT if both <= q.effects and len(both) == 2), None)


def canonical(
    best: Hypothesis, ties: list[tuple[Hypothesis, Equivalence | None]]
) -> tuple[Hypothesis, list[Hypothesis]]:
    """The set to report, and the ties that no convention resolves."""
    unresolved = [e for e, q in ties if q is None or q.canonical is None]
    for e, q in ties:
        if (
            q is not None
            and q.canonical in [t.effect for t in e.terms]
            and q.canonical not in [t.effect for t in best.terms]
        ):
            return e, unresolved
    return best, unresolved


def settled(best: Hypothesis) -> bool:
    """Whether a set leaves nothing that is worth a further name."""
    return best.error < NOISE + ABOVE_NOISE


def effect_probability(
    best: Hypothesis, hypotheses: Sequence[Hypothesis], probability: dict[frozenset[str], float]
) -> list[float]:
    """Share of resamples whose winner contains each effect of the chosen set."""
    return [sum(probability[e.key] for e in hypotheses if t.label in e.names) for t in best.terms]
