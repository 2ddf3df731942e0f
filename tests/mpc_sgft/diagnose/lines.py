"""A problem made by hand for tests of the search and the verdict: residuals are linear in each effect's parameter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.fitting.fit import Fit
from mpc_sgft.diagnose.simulation.plant import Change
from mpc_sgft.diagnose.verdict.tolerance import Tolerance

Points = Sequence[Sequence[np.ndarray]]


def term(name: str) -> Term:
    one = np.ones(1)
    return Term(name, (), ("a",), ("1",), 0 * one, -50 * one, 50 * one, one, (0.5 * one,), lambda x: Change())


class Lines:
    """r = y - sum of a_i x_i over the effects; y is the difference of two columns that are nearly the same."""

    blocks, step, pattern = 40, 1e-2, ()

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        shared = rng.normal(size=(24, 40))
        self.columns = {name: rng.normal(size=shared.shape) for name in "abcdefgh"}
        self.columns |= {name: shared + 0.1 * rng.normal(size=shared.shape) for name in "xy"}
        self.y = 30 * (self.columns["x"] - self.columns["y"]) + rng.normal(size=shared.shape)
        self.columns["a"] += 0.1 * self.y  # looks best alone

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[np.ndarray]], pick: np.ndarray) -> np.ndarray:
        def one(values: Sequence[np.ndarray]) -> np.ndarray:
            return sum((v[0] * self.columns[t.effect] for t, v in zip(terms, values, strict=True)), -self.y)[pick]

        return np.stack([one(p) for p in points])


def motion(problem: Lines, limit: float = 0.01, asked: bool = False) -> Tolerance:
    """Of a share of the motion, which is y."""
    everything = np.arange(len(problem.y))

    def predict(fits: Sequence[Fit]) -> np.ndarray:
        return np.stack([(problem.residuals(f.terms, [f.values], everything)[0] + problem.y)[..., None] for f in fits])

    limits = np.array([limit * problem.y.std()])
    return Tolerance(limits, predict, problem.y[..., None], np.ones(1), asked)
