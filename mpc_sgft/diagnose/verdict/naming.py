"""The verdict: an effect, none, unknown, or not identifiable from these data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from mpc_sgft.diagnose.candidates.effect_table import EQUIVALENT, Equivalence
from mpc_sgft.diagnose.candidates.library import IDLE_WHILE_NEUTRAL, includes
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import ABOVE_NOISE, NOISE, Setup
from mpc_sgft.diagnose.fitting.residual_model import ResidualModel

UNEXPLAINED = 0.05  # share of what any model can explain that named effects may miss before the answer is "unknown"
FIRST_GAIN = 0.025  # in log(1 + e), of the only effect where the nominal model leaves noise alone
NEXT_GAIN = 0.06  # in log(1 + e), of one more effect where noise alone is left
RICHER_SHARE = 0.2  # of what is worth a name, of a richer effect in place of one that it includes
WIDER = 1.3  # of intervals: what windows that begin at each other's ends share; set on development seeds
LEFT = 0.1  # share of the squared error above noise that names may leave


class Verdict(NamedTuple):
    """The answer.

    Attributes:
        kind: "effect", "none", "unknown" or "not_identifiable".
        best: The set that is named; the baseline if there is none.
        ties: Sets of the same size that these data cannot rule out, and why if that is declared.
        probability: Share of resampled windows in which a set wins, by key.
        reason: In words.
    """

    kind: str
    best: Hypothesis
    ties: list[tuple[Hypothesis, str]]
    probability: dict[frozenset[str], float]
    reason: str


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
    """Whether a larger set is credibly better; where noise alone is left, one more effect must gain more.

    A richer effect in place of a simpler one is no further cause, and gains nothing where the simpler one is the truth.
    """
    least = judge.least_gain(small.error)
    if holds(large, small):
        least *= RICHER_SHARE
    elif small.effects and settled(small):
        least = NEXT_GAIN
    elif not small.effects and small.error < setup.quiet:
        least = FIRST_GAIN
    likelier = log_odds(setup, large, small) if settled(small) else None
    return judge.credible(small.errors, large.errors, rng, setup.parts, least, setup.one_window(large.errors), likelier)


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
    nominal = len(setup.baseline.terms)
    for i in range(nominal, len(best.fit.terms)):
        if best.effects < 2:
            break
        keep = [k for k in range(len(best.fit.terms)) if k != i]
        key = frozenset(best.fit.terms[k].label + str(best.fit.terms[k].fixed) for k in keep if k >= nominal)
        without = next((e for e in hypotheses if e.key == key), None)
        if without is None:
            terms = [best.fit.terms[k] for k in keep]
            without = judge_fit(setup, fit(setup.problem, terms, [best.fit.values[k] for k in keep], setup.fitted))
            hypotheses.append(without)
        if not gains(setup, without, best, rng):
            return prune(setup, without, hypotheses, rng)
    return best


def reach_verdict(
    setup: Setup[Any], hypotheses: list[Hypothesis], residual_model: ResidualModel | None, rng: np.random.Generator
) -> Verdict:
    """Compare everything that was fitted.

    Args:
        setup: Problem and baseline.
        hypotheses: From `search`, baseline first.
        residual_model: Residual model on top of the chosen set; None if it was not fitted.
        rng: For the bootstrap.
    """
    best = choose(setup, hypotheses, rng)
    probability = dict.fromkeys((e.key for e in hypotheses), 0.0)
    rivals = [e for e in hypotheses if e.complexity <= 1 or no_larger(e, best)]  # larger sets are no more credible
    shares = judge.win_shares(
        np.array([e.errors for e in rivals]), np.array([e.complexity for e in rivals]), rng, setup.problem.blocks
    )
    probability |= {e.key: float(s) for e, s in zip(rivals, shares, strict=True)}
    best, ties = as_given(setup, best, find_ties(setup, best, hypotheses, rng))
    declared = [(e, equivalence(best, e)) for e in ties]
    base = hypotheses[0]
    if residual_model is not None and beats(residual_model, best, base, setup.parts, rng):
        missed = (best.error - residual_model.error) / max(base.error - residual_model.error, 1e-12)
        reason = f"a flexible residual model explains {missed:.0%} more of the error than {_list(best)}"
        ties = [(e, "" if q is None else q.reason) for e, q in declared]
        return Verdict("unknown", best, ties, probability, reason)
    times = np.sqrt(np.expm1(best.error))
    if not best.effects:
        reason = "the nominal model's error is within noise and the simulator's floor"
        if not settled(base):
            tried = "no name" if residual_model is None else "no name and no flexible model"
            reason = f"{tried} explains the error, {times:.1f} times noise and floor, on windows that were not fitted"
        return Verdict("none", best, [], probability, reason)
    if judge.leaves_much(best.error, base.error, LEFT):
        reason = f"{_list(best)} leaves {times:.1f} times noise and floor, which no name in the library explains"
        return Verdict("unknown", best, [(e, "" if q is None else q.reason) for e, q in declared], probability, reason)
    first, (best, open_ties) = best, canonical(best, declared)
    declared = [*declared, (first, equivalence(best, first))]  # where a convention prefers another
    named: list[tuple[Hypothesis, str]] = []
    for e, q in declared:  # each set of names once: the best of those that differ in what is held
        if sorted(e.names) not in [sorted(other.names) for other in (best, *(t for t, _ in named))]:
            named.append((e, "" if q is None else q.reason))
    if open_ties:
        return Verdict("not_identifiable", best, named, probability, f"{_list(best)} and {len(open_ties)} others tie")
    return Verdict("effect", best, named, probability, f"no larger set is credibly better than {_list(best)}")


def caution(verdict: Verdict) -> list[str]:
    """A note where the repaired files hold effects that the report does not name."""
    if verdict.kind != "unknown" or not verdict.best.effects:
        return []
    held = _list(verdict.best)
    return [f"repaired.xml and effects.yaml hold {held}: a fit that takes part of the error away, not its name"]


def find_ties(
    setup: Setup[Any], best: Hypothesis, hypotheses: list[Hypothesis], rng: np.random.Generator
) -> list[Hypothesis]:
    """Other sets of no more names and parameters than the best that are not credibly worse, best first.

    Not those that hold the best, and can do all that it does: a richer effect must gain something.
    """
    rivals = [e for e in hypotheses if 0 < e.effects <= best.effects and 0 < e.complexity and no_larger(e, best)]
    other = [e for e in rivals if sorted(e.names) != sorted(best.names) and not holds(e, best)]
    tied = [e for e in other if not judge.ruled_out(e.errors, best.errors, rng, log_odds(setup, best, e))]
    return sorted(tied, key=lambda e: e.error)


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


def holds(rich: Hypothesis, simple: Hypothesis) -> bool:
    """Whether one set is the other with an effect in place of a simpler one that it includes."""
    more, less = ([t for t in a.terms if t.label not in b.names] for a, b in ((rich, simple), (simple, rich)))
    return len(more) == len(less) == 1 and includes(more[0], less[0])


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


def beats(
    residual_model: ResidualModel, best: Hypothesis, base: Hypothesis, parts: int, rng: np.random.Generator
) -> bool:
    """Whether something that no name in the library covers is clearly there."""
    if settled(best) or not judge.credible(best.errors, residual_model.errors, rng, parts):
        return False
    return best.error - residual_model.error > UNEXPLAINED * (base.error - residual_model.error)


def standard_deviations(f_entry: Hypothesis) -> list[Array]:
    """Standard deviations of each term's parameters: the wider of the model's and the windows' own scatter.

    The first takes residuals as white, the second (a sandwich over windows) lets each window have its own error.
    """
    f = f_entry.fit
    count = f.J.shape[-1]
    if not count:
        return []
    weight = f.weights
    A = np.einsum("w,wmp,wmq->pq", weight, f.J, f.J, optimize=True)
    inverse = np.linalg.pinv(A + 1e-12 * np.eye(count) * max(float(np.trace(A)), 1e-30))
    white = np.diag(inverse) * max(1.0, float(weight @ (f.r**2).mean(1) / weight.sum()))
    scores = np.einsum("w,wmp,wm->wp", weight, f.J, f.r, optimize=True)
    windows = np.diag(inverse @ (scores.T @ scores) @ inverse)
    sd = WIDER * np.sqrt(np.maximum(white, windows))
    ends = np.cumsum([len(t.size) for t in f.terms])
    return [x * t.size for x, t in zip(np.split(sd, ends[:-1]), f.terms, strict=True)]


def intervals(f_entry: Hypothesis, level: float = 0.90) -> list[tuple[Array, Array]]:
    """Low and high of each effect's parameters."""
    f = f_entry.fit
    half = float(stats.t.ppf(0.5 + level / 2, max(len(f.r) - 1, 1)))
    rows = zip(f.terms, f.values, standard_deviations(f_entry), strict=True) if f.terms else ()
    bounds = [(np.maximum(v - half * sd, t.low), np.minimum(v + half * sd, t.high)) for t, v, sd in rows]
    return bounds[len(f.terms) - f_entry.effects :]


def _list(e: Hypothesis) -> str:
    return " + ".join(e.names) or "the nominal model"


def effect_probability(
    best: Hypothesis, hypotheses: Sequence[Hypothesis], probability: dict[frozenset[str], float]
) -> list[float]:
    """Share of resamples whose winner contains each effect of the chosen set."""
    return [sum(probability[e.key] for e in hypotheses if t.label in e.names) for t in best.terms]
