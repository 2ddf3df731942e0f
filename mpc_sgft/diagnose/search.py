"""Which sets of effects are worth judging: a beam search in which supersets start at their subsets' optimum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mpc_sgft.diagnose import judge
from mpc_sgft.diagnose.entry import Entry, entry
from mpc_sgft.diagnose.fit import fit, robust, typical
from mpc_sgft.diagnose.library import Term, includes, simplify
from mpc_sgft.diagnose.prepare import Setup
from mpc_sgft.diagnose.record import Array
from mpc_sgft.diagnose.screen import Effort, couple, key_of, proposals, screen, sharpen, spread
from mpc_sgft.diagnose.table import ALIKE, EQUIVALENT

FIRST, NEXT = (1.0, 0.1, 0.01), (0.3,)  # how far from no effect the fits of a first effect start, and of further ones
REJUDGED = 6  # sets that are judged anew
HOPELESS = 3.0  # times the error of a set, after a few iterations on some windows: no full fit
SWAPPED = 2  # of the best sets, in which effects are exchanged for those that start well where they end


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
                richer = len(proposal.terms) == len(parent.fit.terms)  # from a simpler set's optimum: once more
                if key in new or key in found and not richer:
                    continue
                fitted = entry(setup, fit(setup.problem, proposal.terms, proposal.start, setup.fitted, effort.last))
                if key not in found or fitted.error < found[key].error:
                    new[key] = fitted
        if level == 1:
            for proposal in sharpen(setup, [p for p in pairs if key_of(setup, p.terms) not in new], effort)[:full]:
                f = fit(setup.problem, proposal.terms, proposal.start, setup.fitted, effort.last)
                new[key_of(setup, proposal.terms)] = entry(setup, f)
        new = {key: no_worse(setup, e, found, effort) for key, e in new.items()}
        found |= new
        if not new:
            break
        beam = sorted(new.values(), key=lambda e: e.error)[: effort.beam[min(level, len(effort.beam) - 1)]]
        if judge.credible(best.errors, beam[0].errors, rng, setup.parts, one_window=setup.one_window(beam[0].errors)):
            best = beam[0]
        elif level or best.error <= effort.enough:
            break
        if best.error < setup.quiet:
            break
    return list((found | swaps(setup, found, terms, effort)).values())


def no_worse(setup: Setup[Any], e: Entry, found: Mapping[frozenset[str], Entry], effort: Effort) -> Entry:
    """A set as it was fitted, or fitted anew from the optimum of the best set within it, if that fits better."""
    scale = typical(setup.baseline.r)
    within = min((s for s in found.values() if s.key < e.key), key=lambda s: robust(s.fit.r, scale))
    if robust(e.fit.r, scale) <= robust(within.fit.r, scale):
        return e
    there = {(t.label, t.names): v for t, v in zip(within.fit.terms, within.fit.values, strict=True)}
    start = [there.get((t.label, t.names), np.clip(t.neutral, t.low, t.high)) for t in e.fit.terms]
    return entry(setup, fit(setup.problem, e.fit.terms, start, setup.fitted, effort.last))


def nearest(entries: Sequence[Entry]) -> Entry:
    """The set that comes nearest to the fitted data, if that is worth a name; else the baseline.

    Args:
        entries: As from `search`, baseline first.
    """
    best = min(entries, key=lambda e: float(e.fitted.mean()))
    before = float(entries[0].fitted.mean())
    return best if before - float(best.fitted.mean()) > judge.worth(before) else entries[0]


def again(setup: Setup[Any], entries: Sequence[Entry], best: Entry) -> list[Entry]:
    """The best sets, those that are in them, and the baseline, fitted and judged anew for another setup.

    Args:
        setup: Of the same data.
        entries: As from `search`, baseline first.
        best: One of them.
    """
    rivals = sorted((e for e in entries[1:] if e.effects <= best.effects), key=lambda e: e.error)[:REJUDGED]
    larger = sorted((e for e in entries[1:] if e.effects > best.effects), key=lambda e: e.error)[: REJUDGED // 3]
    parts = [e for e in entries[1:] if e.key < best.key]
    kept = {e.key: e for e in [best, *rivals, *parts, *larger]}
    fits = (fit(setup.problem, e.fit.terms, e.fit.values, setup.fitted) for e in kept.values())
    return [entry(setup, setup.baseline), *(entry(setup, f) for f in fits)]


def swaps(
    setup: Setup[Any], found: dict[frozenset[str], Entry], terms: Sequence[Term], effort: Effort
) -> dict[frozenset[str], Entry]:
    """The best sets with one effect exchanged: for a simpler one that it holds, one that does much the same with the
    same number, for the usual name of the same term.

    Rivals this near must not lose because their fit began elsewhere, or never began.
    """
    out: dict[frozenset[str], Entry] = {}
    pick, scale = spread(setup.fitted, effort.sharpen), typical(setup.baseline.r)
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
                    other = entry(setup, fit(setup.problem, changed, quick.values, setup.fitted, effort.last))
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
