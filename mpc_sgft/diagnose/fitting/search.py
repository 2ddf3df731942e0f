"""Which sets of effects are worth judging: a beam search in which supersets start at their subsets' optimum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from mpc_sgft.diagnose.candidates.effect_table import ALIKE, EQUIVALENT
from mpc_sgft.diagnose.candidates.library import Term, includes, simplify
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit, fit, robust, typical
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.fitting.screening import (
    Effort,
    Proposal,
    Sample,
    glance,
    key_of,
    pair_up,
    proposals,
    quick_fits,
    screen,
    spread,
    worth_a_look,
)

FIRST, NEXT = (1.0, 0.1, 0.01), (0.3,)  # how far from no effect the fits of a first effect start, and of further ones
GLANCE = (0.1,)  # the same where there are so many effects that most are seen there only
REJUDGED = 6  # sets that are judged anew, half of them however bad they are
HOPELESS = 3.0  # times the error of a set, after a few iterations on some windows or of another problem: no full fit
MUCH = 0.05  # share of the squared error above noise, left of a set: its effects are exchanged for any others
WIDE = 2  # times as many sets that extend one that leaves noise alone: what more there is, is small
PAIR = 2  # effects, of the largest set that is looked for where a smaller one leaves noise alone
CHANCE = 3.0  # less fall of the sum of squares in a quick fit, in noise's units: no full fit where noise alone is left
STARTS = 2  # of each richer set that get a quick fit
SWAPPED = 2  # of the best sets, in which effects are exchanged for those that start well where they end

T = TypeVar("T")


def search(
    setup: Setup[Any],
    terms: Sequence[Term],
    max_effects: int,
    rng: np.random.Generator,
    report: Callable[[str, float], None] = lambda what, done: None,
    effort: Effort = Effort(),  # noqa: B008, it is a tuple
    nearer: Callable[[Fit], Setup[Any]] | None = None,
) -> tuple[Setup[Any], list[Hypothesis]]:
    """All sets that were fitted, baseline first, and the problem that they were fitted to.

    Args:
        setup: Problem and baseline.
        terms: Candidates.
        max_effects: Largest set.
        rng: For the bootstrap that decides whether to go on.
        report: Told what is being done, and the share that is done.
        effort: How widely.
        nearer: The problem as a fit sees it: where one effect leaves more than noise, the search goes on in that.
    """
    found = {frozenset(): judge_fit(setup, setup.baseline)}
    beam, best, pairs = list(found.values()), found[frozenset()], []
    most, wide = max_effects, 1
    samples: list[Sample] = []  # what each effect does to the nominal model
    for level in range(max_effects + 1):  # one more, in which simple effects may still be replaced by richer ones
        new: dict[frozenset[str], Hypothesis] = {}
        full = effort.full[min(level, len(effort.full) - 1)] * wide
        for b, parent in enumerate(beam):
            report(f"{' + '.join(parent.names) or 'nominal'}", (level + b / len(beam)) / (max_effects + 1))
            options = proposals(parent, terms, most, FIRST if not level else NEXT)
            if not level and len({t.label for t in terms}) > effort.most:
                samples = glance(setup, parent, proposals(parent, terms, most, GLANCE), effort)
            options = worth_a_look(setup, parent, options, samples, effort)
            ranked, seen = screen(setup, parent, options, effort.screen_windows)
            if not level:
                samples = samples or seen
                pairs = pair_up(parent, samples, setup, effort) if max_effects > 1 and effort.pairs else []
            new |= promising(setup, parent, ranked, full, found | new, effort)
        if level == 1:
            left = [p for p in pairs if key_of(setup, p.terms) not in new]
            new |= promising(setup, found[frozenset()], left, full, {}, effort, best)
        new = {key: no_worse(setup, e, found, effort) for key, e in new.items()}
        found |= new
        if not new:
            break
        count = effort.beam[min(level, len(effort.beam) - 1)]
        ordered = sorted(new.values(), key=lambda e: e.error)
        beam = ordered[:count]
        if judge.credible(best.errors, beam[0].errors, rng, setup.parts, one_window=setup.one_window(beam[0].errors)):
            best = beam[0]
        elif level or best.error <= effort.enough:
            break
        else:
            beam = ordered[: effort.alone]  # pairs may do what nothing does alone
        if nearer and level == 0 and best.effects and best.error >= setup.quiet:
            setup = nearer(best.fit)
            found = {e.key: e for e in refit(setup, list(found.values()), best)}
            beam = sorted((e for e in found.values() if e.effects), key=lambda e: e.error)[:count]
            best = beam[0]
        if best.error < setup.quiet:
            beam, most, wide = beam[:1], min(most, PAIR), WIDE
    best = min(found.values(), key=lambda e: e.error)
    if effort.exchange and best.effects > 1 and judge.leaves_much(best.error, found[frozenset()].error, MUCH):
        found |= exchange(setup, best, found, terms, samples, effort)
    return setup, list((found | swaps(setup, found, terms, effort)).values())


def promising(
    setup: Setup[Any],
    parent: Hypothesis,
    ranked: list[Proposal],
    full: int,
    found: Mapping[frozenset[str], Hypothesis],
    effort: Effort,
    best: Hypothesis | None = None,
) -> dict[frozenset[str], Hypothesis]:
    """Full fits of the best proposals, those that are new or better than before.

    Args:
        setup: Problem and baseline.
        parent: The set that they extend.
        ranked: Proposals, best first.
        full: How many get a full fit, beside richer effects in place of simpler ones; twice as many get a quick one.
        found: What was fitted already; from a simpler set's optimum, a richer set is fitted once more.
        effort: How widely.
        best: Whose residuals they must better; the parent's by default.
    """
    best = best or parent
    starts: dict[frozenset[str], list[Proposal]] = {}  # of sets in which an effect becomes a richer one
    for p in (p for p in ranked if len(p.terms) == len(parent.fit.terms)):
        starts.setdefault(key_of(setup, p.terms), []).append(p)
    richer = [p for ps in starts.values() for p in ps[:STARTS]]
    others = [p for p in ranked if len(p.terms) > len(parent.fit.terms)]
    others = of_each(setup, others, effort.starts, 2 * full) if effort.starts else others[: 2 * full]
    new: dict[frozenset[str], Hypothesis] = {}
    for some, count in ((richer, len(starts)), (others, full)):
        sets: dict[frozenset[str], Proposal] = {}
        for p in quick_fits(setup, best, some, effort):
            if some is richer or not sets or best.error > setup.quiet or p.gain > CHANCE:
                sets.setdefault(key_of(setup, p.terms), p)
        for key, proposal in list(sets.items())[:count]:
            if key in found and some is others:
                continue
            fitted = judge_fit(setup, fit(setup.problem, proposal.terms, proposal.start, setup.fitted, effort.last))
            if key not in found or fitted.error < found[key].error:
                new[key] = fitted
    return new


def of_each(setup: Setup[Any], ranked: list[Proposal], starts: int, most: int) -> list[Proposal]:
    """The best starts of each of the best sets."""
    sets: dict[frozenset[str], list[Proposal]] = {}
    for p in ranked:
        sets.setdefault(key_of(setup, p.terms), []).append(p)
    return [p for some in list(sets.values())[:most] for p in some[:starts]]


def exchange(
    setup: Setup[Any],
    best: Hypothesis,
    found: dict[frozenset[str], Hypothesis],
    terms: Sequence[Term],
    samples: Sequence[Sample],
    effort: Effort,
) -> dict[frozenset[str], Hypothesis]:
    """What becomes of a set that leaves much when one effect makes way for any other, or starts elsewhere.

    The search came to it one effect at a time: the first of two may be one that stands in for both.
    """
    new: dict[frozenset[str], Hypothesis] = {}
    nominal = len(setup.baseline.terms)
    for i in range(nominal, nominal + best.effects):
        less, start = _without(best.fit.terms, i), _without(best.fit.values, i)
        parent = found.get(key_of(setup, less)) or judge_fit(setup, fit(setup.problem, less, start, setup.fitted))
        others = {key: e for key, e in (found | new).items() if key != best.key}
        options = worth_a_look(setup, parent, proposals(parent, terms, best.effects, NEXT), samples, effort)
        ranked, _ = screen(setup, parent, options, effort.screen_windows)
        new |= promising(setup, parent, ranked, effort.exchange, others, effort)
    return {key: e for key, e in new.items() if key not in found or e.error < found[key].error}


def _without(xs: Sequence[T], i: int) -> list[T]:
    return [*xs[:i], *xs[i + 1 :]]


def no_worse(
    setup: Setup[Any], e: Hypothesis, found: Mapping[frozenset[str], Hypothesis], effort: Effort
) -> Hypothesis:
    """A set as it was fitted, or fitted anew from the optimum of the best set within it, if that fits better."""
    scale = typical(setup.baseline.r)
    within = min((s for s in found.values() if s.key < e.key), key=lambda s: robust(s.fit.r, scale))
    if robust(e.fit.r, scale) <= robust(within.fit.r, scale):
        return e
    there = {(t.label, t.names): v for t, v in zip(within.fit.terms, within.fit.values, strict=True)}
    start = [there.get((t.label, t.names), np.clip(t.neutral, t.low, t.high)) for t in e.fit.terms]
    return judge_fit(setup, fit(setup.problem, e.fit.terms, start, setup.fitted, effort.last))


def nearest(hypotheses: Sequence[Hypothesis]) -> Hypothesis:
    """The set that comes nearest to the fitted data, if that is worth a name; else the baseline.

    Args:
        hypotheses: As from `search`, baseline first.
    """
    best = min(hypotheses, key=lambda e: float(e.fitted.mean()))
    before = float(hypotheses[0].fitted.mean())
    return best if before - float(best.fitted.mean()) > judge.least_gain(before) else hypotheses[0]


def refit(setup: Setup[Any], hypotheses: Sequence[Hypothesis], best: Hypothesis) -> list[Hypothesis]:
    """The best sets, those that are in them, and the baseline, fitted and judged anew for another setup.

    Args:
        setup: Of the same data.
        hypotheses: As from `search`, baseline first.
        best: One of them.
    """
    rivals = sorted((e for e in hypotheses[1:] if e.effects <= best.effects), key=lambda e: e.error)[:REJUDGED]
    larger = sorted((e for e in hypotheses[1:] if e.effects > best.effects), key=lambda e: e.error)[: REJUDGED // 3]
    parts = [e for e in hypotheses[1:] if e.key < best.key]
    enough = best.error + np.log(HOPELESS)
    rivals = [e for i, e in enumerate(rivals) if i < REJUDGED // 2 or e.error < enough]
    kept = {e.key: e for e in [best, *rivals, *parts, *larger]}
    fits = (fit(setup.problem, e.fit.terms, e.fit.values, setup.fitted) for e in kept.values())
    return [judge_fit(setup, setup.baseline), *(judge_fit(setup, f) for f in fits)]


def swaps(
    setup: Setup[Any], found: dict[frozenset[str], Hypothesis], terms: Sequence[Term], effort: Effort
) -> dict[frozenset[str], Hypothesis]:
    """The best sets with one effect exchanged: for a simpler one that it holds, one that does much the same with the
    same number, for the usual name of the same term.

    Rivals this near must not lose because their fit began elsewhere, or never began.
    """
    out: dict[frozenset[str], Hypothesis] = {}
    pick, scale = spread(setup.fitted, effort.quick_windows), typical(setup.baseline.r)
    for e in sorted(found.values(), key=lambda e: e.error)[:SWAPPED]:
        enough = HOPELESS * robust(e.fit.r[np.searchsorted(setup.fitted, pick)], scale)
        first, there = len(e.fit.terms) - e.effects, {t.label for t in e.terms}
        for i, old in enumerate(e.terms, first):
            for new in (t for t in terms if t.label not in there):
                changed = (*e.fit.terms[:i], new, *e.fit.terms[i + 1 :])
                for start in _instead(old, e.fit.values[i], new):
                    values = [*e.fit.values[:i], start, *e.fit.values[i + 1 :]]
                    quick = fit(setup.problem, changed, values, pick, effort.quick)
                    if robust(quick.r, scale) > enough:
                        continue
                    other = judge_fit(setup, fit(setup.problem, changed, quick.values, setup.fitted, effort.last))
                    before = out.get(other.key, found.get(other.key))
                    if before is None or other.error < before.error:
                        out[other.key] = other
    return out


def _instead(old: Term, value: Array, new: Term) -> list[Array]:
    """Where to start with one effect in place of another; nowhere if that is not worth a try."""
    if includes(old, new):
        return [simplify(old, value, new)]
    if new.at == old.at and {new.effect, old.effect} in ALIKE:
        return [value]
    usual = (q for q in EQUIVALENT if q.canonical == new.effect and old.effect in q.effects)
    return list(new.starts) if any(usual) else []
