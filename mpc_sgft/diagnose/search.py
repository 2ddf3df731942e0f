"""Which sets of effects are worth judging: a beam search in which supersets start at their subsets' optimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose import judge
from mpc_sgft.diagnose.fit import Fit, fit, left_out_errors, robust, typical, weights, window_errors
from mpc_sgft.diagnose.library import HIDDEN, Term, enrich, includes
from mpc_sgft.diagnose.prepare import ABOVE_NOISE, NOISE, Setup
from mpc_sgft.diagnose.record import Array, Index
from mpc_sgft.diagnose.table import ALIKE, INCLUDES

INVISIBLE = 1e-4  # times the noise: an effect of typical size that changes less is no candidate
FIRST, NEXT = (1.0, 0.1, 0.01), (0.3,)  # how far from no effect the fits of a first effect start, and of further ones
SWAPPED = 2  # of the best sets, in which effects are exchanged for those that start well where they end
SEEN = 1e-3  # a parameter whose derivative is smaller than this share of the largest changes nothing


class Effort(NamedTuple):
    """How widely to search.

    Attributes:
        beam: Sets that are extended, to two effects, to three.
        full: Candidates that get a full fit: alone, as a second effect, as a third; twice as many get a quick one.
        screen, sharpen: Windows for one step of each, and for quick fits.
        quick, last: Iterations of a quick fit, and of the full one that goes on from it.
        enough: Pairs are tried although no effect alone gains, if the error is above this.
        pairs: Of those that the screened effects make, how many get a quick fit.
    """

    beam: tuple[int, ...] = (2, 1)
    full: tuple[int, ...] = (5, 2, 2)
    screen: int = 6
    sharpen: int = 10
    quick: int = 3
    last: int = 8
    enough: float = NOISE + ABOVE_NOISE
    pairs: int = 6


class Entry(NamedTuple):
    """A set of effects, fitted and judged.

    Attributes:
        fit: Nominal terms and effects.
        effects: Number of effects; they are the last terms.
        errors: Error of every part of every window when that is not fitted, [(W fitted + W held) parts].
        complexity: Parameters of the effects that change anything.
    """

    fit: Fit
    effects: int
    errors: Array
    complexity: int

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.fit.terms[len(self.fit.terms) - self.effects :]

    @property
    def values(self) -> tuple[Array, ...]:
        return self.fit.values[len(self.fit.terms) - self.effects :]

    @property
    def names(self) -> list[str]:
        return [t.label for t in self.terms]

    @property
    def key(self) -> frozenset[str]:
        return frozenset(t.label + str(t.fixed) for t in self.terms)

    @property
    def idle(self) -> int:
        """Parameters that change nothing here, of effects that are there to do more than simpler ones."""
        rich = any(t.effect in INCLUDES for t in self.terms)
        return sum(len(t.size) for t in self.terms) - self.complexity if rich else 0

    @property
    def error(self) -> float:
        return float(self.errors.mean())


class Proposal(NamedTuple):
    terms: tuple[Term, ...]
    start: tuple[Array, ...]
    cost: float


class Sample(NamedTuple):
    """What one effect at one start does to the residuals of the nominal model: by how much it moves them [W, m], and
    their derivatives by its parameters in typical sizes [W, m, p]."""

    term: Term
    start: Array
    moved: Array
    J: Array


def entry(setup: Setup[Any], f: Fit) -> Entry:
    """Judge a fit on all windows: fitted ones by leaving out their block, the others as they are."""
    nominal = len(setup.baseline.terms)
    left_out = left_out_errors(f, setup.blocks, setup.parts)
    errors = np.concatenate([left_out, window_errors(setup.problem, f, setup.held, setup.parts)])
    errors = setup.judged(errors)
    norms = np.sqrt((f.J**2).sum((0, 1)))
    own = norms[sum(len(t.size) for t in f.terms[:nominal]) :]
    seen = int((own > SEEN * max(float(own.max()), 1e-12)).sum()) if len(own) else 0
    return Entry(f, len(f.terms) - nominal, errors, seen)


def search(
    setup: Setup[Any],
    terms: Sequence[Term],
    max_effects: int,
    rng: np.random.Generator,
    report: Callable[[str, float], None] = lambda what, done: None,
    effort: Effort = Effort(),  # noqa: B008, it is a tuple
) -> list[Entry]:
    """All sets that were fitted, baseline first.

    Args:
        setup: Problem and baseline.
        terms: Candidates.
        max_effects: Largest set.
        rng: For the bootstrap that decides whether to go on.
        report: Told what is being done, and the share that is done.
        effort: How widely.
    """
    found = {frozenset(): entry(setup, setup.baseline)}
    beam, best, full, pairs = list(found.values()), found[frozenset()], 0, []
    for level in range(max_effects + 1):  # one more, in which simple effects may still be replaced by richer ones
        new: dict[frozenset[str], Entry] = {}
        for b, parent in enumerate(beam):
            report(f"{' + '.join(parent.names) or 'nominal'}", (level + b / len(beam)) / (max_effects + 1))
            full = effort.full[min(level, len(effort.full) - 1)]
            options = proposals(parent, terms, max_effects, FIRST if not level else NEXT)
            ranked, samples = screen(setup, parent, options, effort.screen)
            if not level:
                pairs = couple(parent, samples, setup, effort) if max_effects > 1 and effort.pairs else []
            for proposal in sharpen(setup, ranked[: 2 * full], effort)[:full]:
                key = key_of(setup, proposal.terms)
                if key in found or key in new:
                    continue
                f = fit(setup.problem, proposal.terms, proposal.start, setup.fitted, effort.last)
                new[key] = entry(setup, f)
        if level == 1:
            for proposal in sharpen(setup, [p for p in pairs if key_of(setup, p.terms) not in new], effort)[:full]:
                f = fit(setup.problem, proposal.terms, proposal.start, setup.fitted, effort.last)
                new[key_of(setup, proposal.terms)] = entry(setup, f)
        found |= new
        if not new:
            break
        beam = sorted(new.values(), key=lambda e: e.error)[: effort.beam[min(level, len(effort.beam) - 1)]]
        if judge.credible(best.errors, beam[0].errors, rng, setup.parts):
            best = beam[0]
        elif level or best.error <= effort.enough:
            break
        if best.error < setup.quiet:
            break
    return list((found | swaps(setup, found, terms, effort)).values())


def swaps(
    setup: Setup[Any], found: dict[frozenset[str], Entry], terms: Sequence[Term], effort: Effort
) -> dict[frozenset[str], Entry]:
    """The best sets with one effect exchanged for one that does much the same with the same number.

    Rivals this near must not lose because their fit began elsewhere.
    """
    out: dict[frozenset[str], Entry] = {}
    for e in sorted(found.values(), key=lambda e: e.error)[:SWAPPED]:
        for i, old in enumerate(e.fit.terms):
            there = {t.label for t in e.terms}
            alike = (t for t in terms if t.at == old.at and {t.effect, old.effect} in ALIKE)
            for new in (t for t in alike if t.label not in there):
                changed = (*e.fit.terms[:i], new, *e.fit.terms[i + 1 :])
                other = entry(setup, fit(setup.problem, changed, e.fit.values, setup.fitted, effort.last))
                before = found.get(other.key)
                if before is None or other.error < before.error:
                    out[other.key] = other
    return out


def proposals(
    parent: Entry, terms: Sequence[Term], max_effects: int, shares: tuple[float, ...]
) -> list[tuple[tuple[Term, ...], list[Array], int]]:
    """Sets one step larger: (terms, start, index of the term that is new), one for each start of the new term."""
    out = []
    base, values = parent.fit.terms, parent.fit.values
    mine = {t.label for t in parent.terms}
    for term in terms:
        if term.label in mine or any(includes(old, term) for old in parent.terms):
            continue
        simpler = [i for i, old in enumerate(base) if includes(term, old)]
        if simpler:
            i = simpler[0]
            swapped = list(values)
            swapped[i] = enrich(term, base[i], values[i])
            out.append(((*base[:i], term, *base[i + 1 :]), swapped, i))
        elif parent.effects < max_effects:
            out += [((*base, term), [*values, start], len(base)) for start in spread_starts(term, shares)]
    return out


def spread_starts(term: Term, shares: tuple[float, ...]) -> list[Array]:
    """The starts of a term, at these shares of their distance from no effect."""
    some = [n not in HIDDEN for n in term.names]
    return [np.where(some, term.neutral + share * (s - term.neutral), s) for share in shares for s in term.starts]


def key_of(setup: Setup[Any], terms: Sequence[Term]) -> frozenset[str]:
    """Of a set of effects, whatever their order."""
    return frozenset(t.label + str(t.fixed) for t in terms[len(setup.baseline.terms) :])


def screen(
    setup: Setup[Any], parent: Entry, options: list[tuple[tuple[Term, ...], list[Array], int]], windows: int
) -> tuple[list[Proposal], list[Sample]]:
    """Order proposals by their error after one Gauss-Newton step, the most promising start of each set only."""
    problem, pick, scale = setup.problem, _spread(setup.fitted, windows), typical(parent.fit.r)
    rows = np.searchsorted(setup.fitted, pick)
    best: dict[frozenset[str], tuple[float, Proposal, list[list[Array]]]] = {}
    samples: list[Sample] = []
    for terms, start, new in options:
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
        if np.sqrt(np.mean(J_new**2)) < INVISIBLE:
            continue
        samples.append(Sample(term, start[new], r[0] - parent.fit.r[rows], J_new))
        J_old = parent.fit.J[rows] if new == len(parent.fit.terms) else np.zeros((*r.shape[1:], 0))
        J = np.concatenate([J_old, J_new], -1)
        w = weights(r[0])
        A, g = np.einsum("w,wmp,wmq->pq", w, J, J, optimize=True), np.einsum("w,wmp,wm->p", w, J, r[0], optimize=True)
        A = A + np.diag(1e-3 * np.diag(A) + 1e-9 * max(float(np.diag(A).max()), 1e-30))
        step = -np.linalg.solve(A, g)
        here, there = float(robust(r[0], scale)), float(robust(r[0] + J @ step, scale))
        key = frozenset(t.label + str(t.fixed) for t in terms)
        if key not in best or there < best[key][0]:
            tries = [_moved(terms, start, new, step * share, J_old.shape[-1]) for share in (1.0, 0.3)]
            best[key] = there, Proposal(terms, tuple(start), here), tries
    out: list[Proposal] = []
    for _, proposal, tries in best.values():
        costs = robust(problem.residuals(proposal.terms, tries, pick), scale)
        reached = [Proposal(proposal.terms, tuple(t), float(c)) for t, c in zip(tries, costs, strict=True)]
        out.append(min([proposal, *reached], key=lambda p: p.cost))
    return sorted(out, key=lambda p: p.cost), samples


def couple(parent: Entry, samples: list[Sample], setup: Setup[Any], effort: Effort) -> list[Proposal]:
    """Pairs of effects that together may do what neither does alone, judged by what each does to the residuals.

    The residuals of two effects are taken for the nominal model's, moved by the one and by the other: no simulation.
    """
    rows = np.searchsorted(setup.fitted, _spread(setup.fitted, effort.screen))
    r0, J0 = parent.fit.r[rows], parent.fit.J[rows]
    root = np.sqrt(weights(r0))[:, None, None]
    parts = [r0[..., None], J0, *(x for s in samples for x in (s.moved[..., None], s.J))]
    columns = (np.concatenate(parts, -1) * root).reshape(r0.size, -1)
    gram = columns.T @ columns
    ends = np.cumsum([p.shape[-1] for p in parts])
    nominal = np.arange(1, ends[1])
    best: dict[frozenset[str], Proposal] = {}
    for j, second in enumerate(samples):
        for i, first in enumerate(samples[:j]):
            if first.term.label == second.term.label or _overlap(first.term, second.term):
                continue
            own = [np.arange(ends[2 * k + 2], ends[2 * k + 3]) for k in (i, j)]
            free = np.concatenate([nominal, *own])
            fixed = [0, ends[2 * i + 1], ends[2 * j + 1]]  # the nominal residuals, and how either effect moves them
            A, g = gram[np.ix_(free, free)], gram[np.ix_(free, fixed)].sum(1)
            step = -np.linalg.solve(A + np.diag(1e-3 * np.diag(A) + 1e-12), g)
            start, done = list(parent.fit.values), 0
            for term, value in zip(
                [*parent.fit.terms, first.term, second.term], [*start, first.start, second.start], strict=True
            ):
                size = slice(done, done + len(value))
                step[size] = (np.clip(value + step[size] * term.size, term.low, term.high) - value) / term.size
                done += len(value)
            cost = float(gram[np.ix_(fixed, fixed)].sum() + 2 * g @ step + step @ A @ step)
            terms = (*parent.fit.terms, first.term, second.term)
            key = key_of(setup, terms)
            if key not in best or cost < best[key].cost:
                values = [*parent.fit.values, first.start, second.start]
                cuts = np.split(step, np.cumsum([len(v) for v in values])[:-1])
                moved = [v + s * t.size for v, s, t in zip(values, cuts, terms, strict=True)]
                best[key] = Proposal(terms, tuple(moved), cost)
    return sorted(best.values(), key=lambda p: p.cost)[: effort.pairs]


def _overlap(a: Term, b: Term) -> bool:
    return includes(a, b) or includes(b, a)


def sharpen(setup: Setup[Any], ranked: list[Proposal], effort: Effort) -> list[Proposal]:
    """Order proposals anew after a few iterations on some windows: one step says little of some effects."""
    pick, out = _spread(setup.fitted, effort.sharpen), []
    scale = typical(setup.baseline.r)
    for p in ranked:
        f = fit(setup.problem, p.terms, p.start, pick, effort.quick)
        out.append(Proposal(f.terms, f.values, float(robust(f.r, scale))))
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


def _spread(windows: Index, count: int) -> Index:
    return windows[np.unique(np.linspace(0, len(windows) - 1, min(count, len(windows))).astype(int))]
