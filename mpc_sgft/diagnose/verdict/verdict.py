"""The verdict: an effect, none, unknown, or not identifiable from these data."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, with_effects
from mpc_sgft.diagnose.fitting.prepare import NOISE, Setup
from mpc_sgft.diagnose.fitting.residual_model import ResidualModel
from mpc_sgft.diagnose.verdict.naming import as_given, canonical, choose, equivalence, find_ties, no_larger, settled
from mpc_sgft.diagnose.verdict.relevance import (
    MATTERS,
    Relevance,
    by_window,
    errors_by_signal,
    foretold,
    mean_error,
    noise_shares,
    shares_of,
    what_matters,
)
from mpc_sgft.diagnose.verdict.tolerance import Tolerance
from mpc_sgft.diagnose.verdict.uncertainty import Interval, sure_intervals

TIED = 0.5  # of what the user tolerates: sets that foretell the same but for less tie, whatever the data say of them
LEFT = 0.1  # share of the squared error above noise that names may leave; of a deployment, in as many windows besides


class Verdict(NamedTuple):
    """The answer.

    Attributes:
        kind: "effect", "none", "unknown" or "not_identifiable".
        best: The set that is named; the baseline if there is none.
        ties: Sets of the same size that these data cannot rule out, and why if that is declared.
        probability: Share of resampled windows in which a set wins, by key.
        reason: In words.
        there: The set of all that is credibly there, traces too.
        shares: What each effect of the best set does beyond the others.
        traces: Effects that are there and do not matter, largest first.
        intervals: Of the best set's parameters, effect by effect.
        whole: The best set with the traces: `there`, unless another than what matters of that is named.
    """

    kind: str
    best: Hypothesis
    ties: list[tuple[Hypothesis, str]]
    probability: dict[frozenset[str], float]
    reason: str
    there: Hypothesis
    shares: list[Relevance]
    traces: list[Relevance]
    intervals: list[Interval]
    whole: Hypothesis


def reach_verdict(
    setup: Setup[Any],
    hypotheses: list[Hypothesis],
    residual_model: ResidualModel | None,
    rng: np.random.Generator,
    tolerance: Tolerance,
) -> Verdict:
    """Compare everything that was fitted: first what is there, then what of it matters, then what else would do.

    Args:
        setup: Problem and baseline.
        hypotheses: From `search`, baseline first.
        residual_model: Residual model on top of the chosen set; None if it was not fitted.
        rng: For the bootstrap.
        tolerance: Prediction errors that may not matter.
    """
    base, there = hypotheses[0], choose(setup, hypotheses, rng)
    best, traces = what_matters(setup, there, hypotheses, rng, tolerance)
    if _nothing(setup, base, tolerance):
        traces, best = [*shares_of(setup, best, there, hypotheses, rng), *traces], base
    probability: defaultdict[frozenset[str], float] = defaultdict(float)  # of sets that are fitted later, too
    rivals = [e for e in hypotheses if e.complexity <= 1 or no_larger(e, best)]  # larger sets are no more credible
    wins = judge.win_shares(
        np.array([e.errors for e in rivals]), np.array([e.complexity for e in rivals]), rng, setup.problem.blocks
    )
    probability |= {e.key: float(s) for e, s in zip(rivals, wins, strict=True)}
    told = by_window(foretold(setup, there), setup)

    def alike(a: Fit, b: Fit) -> bool:
        return tolerance.asked and tolerance.alike(a, b, told, TIED)

    matters = best
    best, ties = as_given(setup, best, find_ties(setup, best, there, hypotheses, rng, alike))
    declared = [(e, equivalence(best, e)) for e in ties]
    kind, reason = _no_name(setup, there, best, base, residual_model, rng, tolerance)
    if kind:
        named = [(e, "" if q is None else q.reason) for e, q in declared] if kind == "unknown" else []
    else:
        first, (best, open_ties) = best, canonical(best, declared)
        declared = [*declared, (first, equivalence(best, first))]  # where a convention prefers another
        named = []
        for e, q in declared:  # each set of names once: the best of those that differ in what is held
            if sorted(e.names) not in [sorted(other.names) for other in (best, *(t for t, _ in named))]:
                named.append((e, "" if q is None else q.reason))
        kind = "not_identifiable" if open_ties else "effect"
        reason = f"no larger set is better than {_list(best)} by what matters"
        if open_ties:
            reason = f"{_list(best)} and {len(open_ties)} others tie"
    shares = shares_of(setup, best, there, hypotheses, rng)
    whole, beside = there, [t for t in traces if t.term.label not in best.names]
    if best.key != matters.key:
        whole = with_effects(setup, best, [t.term for t in beside], [t.value for t in beside], hypotheses)
    sure = sure_intervals(setup, best, tolerance, told)
    return Verdict(kind, best, named, probability, reason, there, shares, traces, sure, whole)


def _no_name(
    setup: Setup[Any],
    there: Hypothesis,
    best: Hypothesis,
    base: Hypothesis,
    residual_model: ResidualModel | None,
    rng: np.random.Generator,
    tolerance: Tolerance,
) -> tuple[str, str]:
    """ "unknown" or "none" with the reason; empty words where there is a name.

    Args:
        setup: Problem and baseline.
        there: All that is credibly there.
        best: What of it matters.
        base: The nominal model.
        residual_model: On top of `there`.
        rng: For the bootstrap.
        tolerance: Prediction errors that may not matter.
    """
    nothing = _nothing(setup, base, tolerance)
    if nothing:
        return "none", nothing
    told = foretold(setup, there)
    if residual_model is not None and not tolerance.allows(there.fit) and beats(setup, residual_model, there, rng):
        missed = float((told * (setup.squared(there.errors) - setup.squared(residual_model.errors))).mean())
        share = missed / mean_error(setup, base, told)
        if share > MATTERS:
            return "unknown", f"a flexible residual model explains {share:.1%} more of the error than {_list(there)}"
    times, units = np.sqrt(mean_error(setup, best, told)), "noise and floor"
    if np.any(setup.tolerated):
        units = "noise, floor and tolerance together"
    unnamed = not tolerance.allows(there.fit) and _leaves_much(setup, there, base, tolerance)
    if unnamed and np.isfinite(setup.faint):
        left = int((there.errors > NOISE).sum())
        windows = f"in {left} of {len(there.errors)} windows, which no name explains"
        return "unknown", f"{_list(there)} leaves more than noise and contacts make {windows}"
    if not best.effects:
        if tolerance.asked and unnamed:
            return "unknown", "the nominal model's error is beyond the tolerance, and no name explains it"
        if there.effects:
            return "none", f"{_list(there)} is there, and too small to matter"
        if settled(base):
            within = "noise and the simulator's floor"
            if np.any(setup.tolerated):
                within = "noise, the simulator's floor and the tolerance together"
            return "none", f"the nominal model's error is within {within}"
        tried = "no name" if residual_model is None else "no name and no flexible model"
        return "none", f"{tried} explains the error, {times:.1f} times {units}, on windows that were not fitted"
    if unnamed:
        times = np.sqrt(mean_error(setup, there, told))
        if tolerance.asked:
            each = errors_by_signal(setup, there, by_window(told, setup))
            times = np.sqrt(each[np.broadcast_to(np.isfinite(tolerance.limits), each.shape)].max())
        return "unknown", f"{_list(there)} leaves {times:.1f} times {units}, which no name explains"
    return "", ""


def _nothing(setup: Setup[Any], base: Hypothesis, tolerance: Tolerance) -> str:
    """Why the nominal model is good enough whatever would lower its error; empty words if it is not."""
    if tolerance.allows(base.fit):
        return "the nominal model's error is within the tolerance"
    if float(base.errors.max()) <= setup.faint:
        return "the nominal model's error is in no window more than noise and contacts make"
    return ""


def _leaves_much(setup: Setup[Any], e: Hypothesis, base: Hypothesis, tolerance: Tolerance) -> bool:
    """Whether a set leaves a good part of the nominal model's error; where a tolerance was given, of any signal named.

    Objects of a deployment are hit in few windows, and a mean over all says little of those: there it must be in a good
    part of the windows that more is left than noise and contacts make.
    """
    if not np.isfinite(setup.faint):
        if tolerance.asked:
            told = by_window(foretold(setup, e), setup)
            left, nominal = (errors_by_signal(setup, x, told) for x in (e, base))
            most = 1 + judge.NEAR * noise_shares(setup)  # noise is not quite known, and a tolerance is
            return bool((np.isfinite(tolerance.limits) & (left > most) & (left > LEFT * nominal)).any())
        return judge.leaves_much(e.error, base.error, LEFT)
    left, nominal = (np.maximum(np.expm1(x.errors) - 1, 0.0) for x in (e, base))
    return bool((left > 0).mean() > LEFT and left.mean() > LEFT * nominal.mean())


def beats(setup: Setup[Any], residual_model: ResidualModel, best: Hypothesis, rng: np.random.Generator) -> bool:
    """Whether something that no name in the library covers is clearly there."""
    return not settled(best) and judge.credible(best.errors, residual_model.errors, rng, setup.parts)


def _list(e: Hypothesis) -> str:
    return " + ".join(e.names) or "the nominal model"
