"""Which sets of effects deserve a full fit: one step from where their subset ended, then a few on some windows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.candidates.library import IDLE_WHILE_NEUTRAL, Term, enrich, includes
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.fitting.fit import fit, robust, typical, weights
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import ABOVE_NOISE, NOISE, Setup

INVISIBLE = 1e-4  # times the noise: an effect of typical size that changes less is no candidate
SHRINKS, TOO_MUCH = 3, 1.0  # a start that adds this much to log(1 + e) is tried at a tenth, so many times


class Effort(NamedTuple):
    """How widely to search.

    Attributes:
        beam: Sets that are extended, to two effects, to three.
        full: Candidates that get a full fit: alone, as a second effect, as a third; twice as many get a quick one.
        starts: Of each set that get a quick fit; None: those that promise most, of whichever sets they are.
        screen_windows, quick_windows: Windows for one step of each, and for quick fits.
        quick, last: Iterations of a quick fit, and of the full one that goes on from it.
        enough: Pairs are tried although no effect alone gains, if the error is above this.
        alone: Sets that are extended then.
        pairs: Of those that the screened effects make, how many get a quick fit.
        exchange: Full fits with one effect of a set that leaves much replaced by another; 0 for no such exchange.
        most: Effects that are simulated beside those of a set; where there are more, those that promise least are not.
    """

    beam: tuple[int, ...] = (2, 1)
    full: tuple[int, ...] = (5, 2, 2)
    starts: int | None = None
    screen_windows: int = 6
    quick_windows: int = 10
    quick: int = 3
    last: int = 8
    enough: float = NOISE + ABOVE_NOISE
    alone: int = 1
    pairs: int = 6
    exchange: int = 4
    most: int = 30


class Proposal(NamedTuple):
    """A set to be fitted.

    Attributes:
        terms, start: The set, and where its fit starts.
        cost: Its error there on some windows, as a fit measures it.
        gain: By how much less its squared residuals sum up to than the best set's, both after a quick fit.
    """

    terms: tuple[Term, ...]
    start: tuple[Array, ...]
    cost: float
    gain: float = 0.0


class Sample(NamedTuple):
    """What one effect at one start does to the residuals of the nominal model: by how much it moves them [W, m], and
    their derivatives by its parameters in typical sizes [W, m, p]."""

    term: Term
    start: Array
    moved: Array
    J: Array


def proposals(parent: Hypothesis, terms: Sequence[Term], max_effects: int, shares: tuple[float, ...]) -> list[Option]:
    """Sets one step larger, one for each start of the new term."""
    out = []
    base, values = parent.fit.terms, parent.fit.values
    mine = {t.label for t in parent.terms}
    for term in terms:
        simpler = [i for i, old in enumerate(base) if includes(term, old)]
        if any(includes(old, term) for old in parent.terms) or (term.label in mine and not simpler):
            continue
        if simpler:
            i = simpler[0]
            for start in enrich(term, base[i], values[i]):
                out.append(Option((*base[:i], term, *base[i + 1 :]), [*values[:i], start, *values[i + 1 :]], i))
        elif parent.effects < max_effects:
            out += [Option((*base, term), [*values, start], len(base)) for start in spread_starts(term, shares)]
    return out


def spread_starts(term: Term, shares: tuple[float, ...]) -> list[Array]:
    """The starts of a term, at these shares of their distance from no effect."""
    return [smaller(term, s, share) for share in shares for s in term.starts]


def smaller(term: Term, start: Array, share: float) -> Array:
    """A start at a share of its distance from no effect."""
    some = [n not in IDLE_WHILE_NEUTRAL for n in term.names]
    return np.where(some, term.neutral + share * (start - term.neutral), start)


def key_of(setup: Setup[Any], terms: Sequence[Term]) -> frozenset[str]:
    """Of a set of effects, whatever their order."""
    return frozenset(t.label + str(t.fixed) for t in terms[len(setup.baseline.terms) :])


class Option(NamedTuple):
    """A set to try: its terms, where they start, and which of them is new."""

    terms: tuple[Term, ...]
    start: list[Array]
    new: int


class Preview(NamedTuple):
    """An option seen from one Gauss-Newton step.

    Attributes:
        option: The option.
        here, there: Error at its start, and where the step leads, by derivatives.
        tries: Points on the way, to be simulated.
        sample: What the new effect does; None if that is nothing.
    """

    option: Option
    here: float
    there: float = np.inf
    tries: Sequence[Sequence[Array]] = ()
    sample: Sample | None = None


def screen(
    setup: Setup[Any], parent: Hypothesis, options: list[Option], windows: int
) -> tuple[list[Proposal], list[Sample]]:
    """Order options by their error after one Gauss-Newton step: of each set the most promising start, of one in which
    an effect becomes a richer one every start, as it is."""
    problem, pick, scale = setup.problem, spread(setup.fitted, windows), typical(parent.fit.r)
    previews = [preview(setup, parent, option, pick) for option in options]
    before = float(robust(parent.fit.r[np.searchsorted(setup.fitted, pick)], scale))
    for last in {_idle_start(x.option): x for x in previews}.values():  # the smallest start
        for _ in range(SHRINKS):
            if last.here < before + TOO_MUCH:
                break
            terms, start, new = last.option
            less = [*start[:new], smaller(terms[new], start[new], 0.1), *start[new + 1 :]]
            previews.append(last := preview(setup, parent, Option(terms, less, new), pick))
    by_set: dict[Any, list[Preview]] = {}
    for x in previews:
        richer = x.option.new < len(parent.fit.terms)
        key = key_of(setup, x.option.terms), tuple(x.option.start[x.option.new]) if richer else ()
        if x.sample is not None:
            by_set.setdefault(key, []).append(x)
    out = []
    for (_, richer), mine in by_set.items():
        x, y = min(mine, key=lambda x: x.there), min(mine, key=lambda x: x.here)  # derivatives may promise too much
        own = Proposal(x.option.terms, tuple(x.option.start), x.here)
        costs = robust(problem.residuals(own.terms, x.tries, pick), scale)
        reached = [Proposal(own.terms, tuple(t), float(c)) for t, c in zip(x.tries, costs, strict=True)]
        stay = Proposal(y.option.terms, tuple(y.option.start), y.here)
        first = min([own, *reached, stay], key=lambda p: p.cost)
        out.append(own._replace(cost=first.cost) if richer else first)
    return sorted(out, key=lambda p: p.cost), [x.sample for x in previews if x.sample is not None]


def _idle_start(option: Option) -> tuple[str, ...]:
    """An effect, and what its start says of parameters that mean nothing while it is neutral."""
    term, start = option.terms[option.new], option.start[option.new]
    return term.label, *(f"{n}={x:g}" for n, x in zip(term.names, start, strict=True) if n in IDLE_WHILE_NEUTRAL)


def preview(setup: Setup[Any], parent: Hypothesis, option: Option, pick: Index) -> Preview:
    """Simulate an option at its start and around it, on the picked windows."""
    problem, scale = setup.problem, typical(parent.fit.r)
    rows = np.searchsorted(setup.fitted, pick)
    terms, start, new = option
    term = terms[new]
    d = problem.step
    steps = [(-d if start[new][i] + d * s > term.high[i] else d) * s for i, s in enumerate(term.size)]
    points = [start]
    for i, step in enumerate(steps):
        moved = list(start)
        moved[new] = start[new] + step * np.eye(len(steps))[i]
        points.append(moved)
    r = problem.residuals(terms, points, pick)
    J_new = np.moveaxis((r[1:] - r[0]) * (term.size / np.array(steps))[:, None, None], 0, -1)
    here = float(robust(r[0], scale))
    if np.sqrt(np.mean(J_new**2)) < INVISIBLE:
        return Preview(option, here)
    J_old = parent.fit.J[rows] if new == len(parent.fit.terms) else np.zeros((*r.shape[1:], 0))
    J = np.concatenate([J_old, J_new], -1)
    w = weights(r[0])
    A, g = np.einsum("w,wmp,wmq->pq", w, J, J, optimize=True), np.einsum("w,wmp,wm->p", w, J, r[0], optimize=True)
    A = A + np.diag(1e-3 * np.diag(A) + 1e-9 * max(float(np.diag(A).max()), 1e-30))
    step = -np.linalg.solve(A, g)
    tries = [_moved(terms, start, new, step * share, J_old.shape[-1]) for share in (1.0, 0.3)]
    reach = [(b - a) / t.size for t, a, b in zip(terms, start, tries[0], strict=True)]  # as far as bounds allow
    there = float(robust(r[0] + J @ np.concatenate(reach if J_old.shape[-1] else [reach[new]]), scale))
    return Preview(option, here, there, tries, Sample(term, start[new], r[0] - parent.fit.r[rows], J_new))


def pair_up(parent: Hypothesis, samples: list[Sample], setup: Setup[Any], effort: Effort) -> list[Proposal]:
    """Pairs of effects that together may do what neither does alone, judged by what each does to the residuals.

    The residuals of two effects are taken for the nominal model's, moved by the one and by the other: no simulation.
    """
    pairs = [
        (i, j)
        for j, second in enumerate(samples)
        for i, first in enumerate(samples[:j])
        if first.term.label != second.term.label and not _overlap(first.term, second.term)
    ]
    best: dict[frozenset[str], tuple[float, Sequence[int], Array]] = {}
    for pair, step, cost in _beside(setup, parent, samples, pairs, effort):
        key = key_of(setup, (*parent.fit.terms, *(samples[k].term for k in pair)))
        if key not in best or cost < best[key][0]:
            best[key] = cost, pair, step
    out = []
    for cost, pair, step in sorted(best.values(), key=lambda x: x[0])[: effort.pairs]:
        terms = (*parent.fit.terms, *(samples[k].term for k in pair))
        values = [*parent.fit.values, *(samples[k].start for k in pair)]
        cuts = np.split(step, np.cumsum([len(v) for v in values])[:-1])
        reached = tuple(v + s * t.size for v, s, t in zip(values, cuts, terms, strict=True))
        out.append(Proposal(terms, reached, cost))
    return out


def _beside(
    setup: Setup[Any], parent: Hypothesis, samples: Sequence[Sample], sets: Sequence[Sequence[int]], effort: Effort
) -> Iterator[tuple[Sequence[int], Array, float]]:
    """Sets of samples beside a set of effects: each with its Gauss-Newton step within bounds, in typical sizes, over
    the parent's parameters and its own, and the squares that this leaves.

    Residuals are the parent's, moved by each sample as it moves the nominal model's: no simulation.
    """
    rows = np.searchsorted(setup.fitted, spread(setup.fitted, effort.screen_windows))
    r0, J0 = parent.fit.r[rows], parent.fit.J[rows]
    root = np.sqrt(weights(r0))[:, None, None]
    parts = [r0[..., None], J0, *(x for s in samples for x in (s.moved[..., None], s.J))]
    columns = (np.concatenate(parts, -1) * root).reshape(r0.size, -1)
    gram = columns.T @ columns
    ends = np.cumsum([p.shape[-1] for p in parts])
    moved = ends[1::2][: len(samples)]  # column of how each effect moves the residuals; its derivatives follow
    alike: dict[tuple[int, ...], list[Sequence[int]]] = {}  # sets, by their effects' numbers of parameters
    for one in sets:
        alike.setdefault(tuple(len(samples[k].start) for k in one), []).append(one)
    for counts, some in alike.items():
        own = [moved[k][:, None] + 1 + np.arange(n) for k, n in zip(np.array(some).T, counts, strict=True)]
        free = np.concatenate([np.tile(np.arange(1, ends[1]), (len(some), 1)), *own], 1)
        fixed = np.concatenate([np.zeros((len(some), 1), int), moved[np.array(some)]], 1)
        A, g = gram[free[:, :, None], free[:, None]], gram[free[:, :, None], fixed[:, None]].sum(2)
        ridge = 1e-3 * np.einsum("npp->np", A) + 1e-12
        step = -np.linalg.solve(A + ridge[:, :, None] * np.eye(free.shape[1]), g[..., None])[..., 0]
        terms = [[*parent.fit.terms, *(samples[k].term for k in one)] for one in some]
        start = np.array([np.concatenate([*parent.fit.values, *(samples[k].start for k in one)]) for one in some])
        low, high, size = (
            np.array([np.concatenate([getattr(t, what) for t in ts]) for ts in terms])
            for what in ("low", "high", "size")
        )
        step = (np.clip(start + step * size, low, high) - start) / size
        cost = gram[fixed[:, :, None], fixed[:, None]].sum((1, 2)) + 2 * np.einsum("np,np->n", g, step)
        cost += np.einsum("np,npq,nq->n", step, A, step)
        yield from zip(some, step, cost.tolist(), strict=True)


def glance(setup: Setup[Any], parent: Hypothesis, options: list[Option], effort: Effort) -> list[Sample]:
    """What each option's effect does, without a try of where its Gauss-Newton step leads."""
    pick = spread(setup.fitted, effort.screen_windows)
    seen = (preview(setup, parent, o, pick).sample for o in options)
    return [s for s in seen if s is not None]


def worth_a_look(
    setup: Setup[Any], parent: Hypothesis, options: list[Option], samples: Sequence[Sample], effort: Effort
) -> list[Option]:
    """The options whose effects would leave least of a set's residuals if they moved these as they do the nominal ones.

    An arm has as many effects as joints times kinds, and simulating each beside each set takes most of the time. All
    options where there are few, and those in which an effect becomes a richer one.

    Args:
        setup: Problem and baseline.
        parent: The set that they extend.
        options: As from `proposals`.
        samples: What each effect does to the nominal model, as from `glance` or `screen`.
        effort: How widely.
    """
    added = {o.terms[o.new].label for o in options if o.new == len(parent.fit.terms)}
    if len(added) <= effort.most:
        return options
    left: dict[str, float] = {}
    some = [(k,) for k, s in enumerate(samples) if s.term.label in added]
    for (k,), _, cost in _beside(setup, parent, samples, some, effort):
        label = samples[k].term.label
        left[label] = min(left.get(label, np.inf), cost)
    best = set(sorted(left, key=left.__getitem__)[: effort.most])
    return [o for o in options if o.new < len(parent.fit.terms) or o.terms[o.new].label in best]


def _overlap(a: Term, b: Term) -> bool:
    return includes(a, b) or includes(b, a)


def quick_fits(setup: Setup[Any], best: Hypothesis, ranked: list[Proposal], effort: Effort) -> list[Proposal]:
    """Order proposals anew after a few iterations on some windows: one step says little of some effects."""
    if not ranked:
        return []
    pick, out = spread(setup.fitted, effort.quick_windows), []
    scale = typical(best.fit.r)
    before = float(np.sum(fit(setup.problem, best.fit.terms, best.fit.values, pick, effort.quick).r ** 2))
    for p in ranked:
        f = fit(setup.problem, p.terms, p.start, pick, effort.quick)
        out.append(Proposal(f.terms, f.values, float(robust(f.r, scale)), before - float(np.sum(f.r**2))))
    return sorted(out, key=lambda p: p.cost)


def _moved(terms: Sequence[Term], start: Sequence[Array], new: int, step: Array, old: int) -> list[Array]:
    """A point after a step in typical sizes: over all old terms and the new one, or over the new one alone."""
    out, at = list(start), 0
    for i in range(len(terms)) if old else [new]:
        if i == new and old:
            delta = step[old:]
        else:
            delta = step[at : at + len(terms[i].size)]
            at += len(terms[i].size)
        out[i] = np.clip(start[i] + delta * terms[i].size, terms[i].low, terms[i].high)
    return out


def spread(windows: Index, count: int) -> Index:
    """So many of the windows, from first to last."""
    return windows[np.unique(np.linspace(0, len(windows) - 1, min(count, len(windows))).astype(int))]
