"""A set of effects, fitted and judged."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.candidates.effect_table import INCLUDES
from mpc_sgft.diagnose.candidates.library import Term, includes, simplify
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit, by_parts, fit, left_out_errors, window_errors
from mpc_sgft.diagnose.fitting.prepare import Setup

SEEN = 1e-3  # a parameter whose derivative is smaller than this share of its effect's largest changes nothing


class Hypothesis(NamedTuple):
    """A set of effects, fitted and judged.

    Attributes:
        fit: Nominal terms and effects.
        effects: Number of effects; they are the last terms.
        errors: Error of every part of every window when that is not fitted, [(W fitted + W held) parts].
        fitted: The same with the fitted windows as they were fitted.
        complexity: Parameters of the effects that change anything.
    """

    fit: Fit
    effects: int
    errors: Array
    fitted: Array
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


def judge_fit(setup: Setup[Any], f: Fit) -> Hypothesis:
    """Judge a fit on all windows: fitted ones by leaving out their block, the others as they are.

    Leaving out is to first order. Where that foretells more than the fit and no effect do, the rest of the data do not
    determine the effect, and none is foretold. One of a few windows may hold all that shows an effect. Then its parts
    are left out one by one, if the rest of it foretells them but for noise.
    """
    nominal = len(setup.baseline.terms)
    held = window_errors(setup.problem, f, setup.held, setup.parts)
    blocks = np.repeat(setup.blocks[:, None], setup.parts, axis=1)
    each = np.arange(blocks.size).reshape(blocks.shape)
    left_in = by_parts(f.r**2, setup.parts)
    most = np.maximum(left_in, by_parts(setup.baseline.r**2, setup.parts)) if len(f.terms) > nominal else np.inf
    left_out = (np.minimum(left_out_errors(f, b), most) for b in (each, blocks))
    by_part, errors, fitted = (setup.judged(np.concatenate([x, held])) for x in (*left_out, left_in))
    if setup.one_window(by_part):
        errors = by_part
    ends = np.cumsum([len(t.size) for t in f.terms])
    norms = np.split(np.sqrt((f.J**2).sum((0, 1))), ends[:-1])[nominal:]  # of each effect's parameters
    seen = sum(int((own > SEEN * max(float(own.max()), 1e-12)).sum()) for own in norms if len(own))
    return Hypothesis(f, len(f.terms) - nominal, errors, fitted, seen)


def holds(rich: Hypothesis, simple: Hypothesis) -> bool:
    """Whether one set is the other with an effect in place of a simpler one that it includes."""
    more, less = ([t for t in a.terms if t.label not in b.names] for a, b in ((rich, simple), (simple, rich)))
    return len(more) == len(less) == 1 and includes(more[0], less[0])


def without_effect(setup: Setup[Any], e: Hypothesis, i: int, hypotheses: list[Hypothesis]) -> Hypothesis:
    """A set without its i-th effect, as it was fitted, or fitted now from where the others are."""
    drop = len(e.fit.terms) - e.effects + i
    terms = [*e.fit.terms[:drop], *e.fit.terms[drop + 1 :]]
    values = [*e.fit.values[:drop], *e.fit.values[drop + 1 :]]
    return _fitted(setup, terms, values, e.effects - 1, hypotheses)


def with_effects(
    setup: Setup[Any], e: Hypothesis, terms: list[Term], values: list[Array], hypotheses: list[Hypothesis]
) -> Hypothesis:
    """A set with further effects, as it was fitted, or fitted now from these values."""
    all_terms, all_values = [*e.fit.terms, *terms], [*e.fit.values, *values]
    return _fitted(setup, all_terms, all_values, e.effects + len(terms), hypotheses)


def simpler(setup: Setup[Any], e: Hypothesis, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """The sets with an effect in place of one that includes it, as they were fitted, or fitted now.

    Simpler effects are those of sets that were fitted.
    """
    known = {t.label: t for h in hypotheses for t in h.terms if t.label not in e.names}
    out, first = [], len(e.fit.terms) - e.effects
    for i, rich in enumerate(e.terms, first):
        for term in (t for t in known.values() if includes(rich, t)):
            terms = [*e.fit.terms[:i], term, *e.fit.terms[i + 1 :]]
            values = [*e.fit.values[:i], simplify(rich, e.fit.values[i], term), *e.fit.values[i + 1 :]]
            out.append(_fitted(setup, terms, values, e.effects, hypotheses))
    return out


def _fitted(
    setup: Setup[Any], terms: list[Term], values: list[Array], effects: int, hypotheses: list[Hypothesis]
) -> Hypothesis:
    """A set as it was fitted, or fitted now from these values; it joins `hypotheses` then."""
    key = frozenset(t.label + str(t.fixed) for t in terms[len(terms) - effects :])
    there = next((h for h in hypotheses if h.key == key), None)
    if there is None:
        there = judge_fit(setup, fit(setup.problem, terms, values, setup.fitted))
        hypotheses.append(there)
    return there
