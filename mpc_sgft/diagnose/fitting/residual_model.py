"""A residual model without a name: waves over the position, and smooth random functions of it and the speed.

Each is an unknown force at a joint, or, times the direction of motion, an unknown friction.

The force of each feature is taken along the recorded motion and simulated; to first order the predictions are linear
in the features' weights, so the fit is a ridge regression on the simulation error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.fitting.fit import by_parts, change_of
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup

WAVES, RUBS, RANDOM = 12, 3, 12  # per joint: over the position, the same times the direction, of position and speed
SMOOTH = 4.0  # half waves over the range of the motion, from where on they cost more
PUSH = 0.01  # of the typical force, to differentiate
RIDGES = np.logspace(-6, 3, 10)


class ResidualModel(NamedTuple):
    """A fitted residual model.

    Attributes:
        errors: Of every window when its block is left out, as sets are judged, [W fitted + W held].
    """

    errors: Array

    @property
    def error(self) -> float:
        return float(self.errors.mean())


def fit_residual_model(
    setup: Setup, best: Hypothesis, scales: dict[tuple[str, str], TypicalSizes], rng: np.random.Generator
) -> ResidualModel:
    """Fit features on top of a set of effects, whose parameters move along (to first order)."""
    problem, replayer = setup.problem, setup.problem.replayer
    pick = np.concatenate([setup.fitted, setup.held])
    features, cost = _features(setup, scales, rng)
    change = change_of(best.fit.terms, best.fit.values)
    r0 = problem.residuals(best.fit.terms, [best.fit.values], pick)[0]
    response = np.stack(
        [
            (problem.whiten(replayer.simulate([change], pick, force=f[None, pick]), pick)[0] - r0) / PUSH
            for f in features
        ],
        -1,
    )  # [W, m, F]
    fitted = np.arange(len(setup.fitted))
    J, count = best.fit.J, len(cost)
    own = np.concatenate([J, np.zeros((len(setup.held), *J.shape[1:]))])
    X = np.concatenate([response, own], -1)
    free = np.r_[cost, np.full(own.shape[-1], 1e-6)]
    norm = np.sqrt((X[fitted] ** 2).mean((0, 1))) + 1e-12
    X = X / norm
    weight = best.fit.weights[:, None, None]  # as the named effects were fitted
    Xw, rw = X[fitted] * np.sqrt(weight), r0[fitted] * np.sqrt(weight[..., 0])
    free = free * len(fitted) * r0.shape[1]
    choices = [(left_out(Xw, rw, setup.blocks, lam * free) ** 2 / weight[..., 0], lam) for lam in RIDGES]
    squares, lam = min(choices, key=lambda c: float(np.log1p(c[0].mean(1)).mean()))
    w = solve(Xw, rw, lam * free)
    held = X[len(fitted) :, :, :count] @ w[:count]
    squares = np.concatenate([squares, (r0[len(fitted) :] + held) ** 2])
    return ResidualModel(setup.judged(by_parts(squares, setup.parts)))


def _features(
    setup: Setup, scales: dict[tuple[str, str], TypicalSizes], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Forces of all features along the recorded motion, in N or N m times PUSH, [F, W, N, nj], and what each costs."""
    replayer = setup.problem.replayer
    w, joints = replayer.windows, replayer.plant.joints
    times = replayer.step_times()
    q, v = np.empty((2, *times.shape, len(joints)))
    u = np.empty((*times.shape, len(replayer.plant.actuators)))
    for i, s in enumerate(replayer.smooth):
        mine = np.flatnonzero(w.episode == i)
        rows = np.clip(np.round(times[mine] / replayer.dt).astype(int), 0, len(s.q) - 1)
        q[mine], v[mine], u[mine] = s.q[rows], s.v[rows], replayer.episodes[i].ctrl[rows]
    out: list[tuple[int, int, Array]] = []  # half waves over the range, joint, its force in typical ones
    for j, name in enumerate(joints):
        at = scales["joint", name]
        x = np.stack([(q[..., j] - at.centre) / at.travel, v[..., j] / at.speed], -1)
        along = np.pi * (q[..., j] - q[..., j].min()) / max(float(np.ptp(q[..., j])), 1e-9)
        sense = np.tanh(3 * x[..., 1])
        for k in range(1, WAVES + 1):
            both = [wave(k * along) for wave in (np.cos, np.sin)]
            out += [(k, j, f) for f in (both if k > RUBS else [*both, *(f * sense for f in both)])]
        for _ in range(RANDOM):
            direction = rng.normal(size=2) * rng.choice([0.5, 1.0, 3.0])
            out.append((0, j, np.cos(x @ direction + rng.uniform(0, 2 * np.pi))))
        out += [(0, j, f) for f in (np.tanh(10 * x[..., 1]), x[..., 1], np.tanh(x[..., 1]))]
    forces = np.zeros((len(out), *times.shape, len(joints)))
    for row, (_, j, f) in zip(forces, out, strict=True):
        row[..., j] = PUSH * scales["joint", joints[j]].force * f
    return forces, 1 + (np.array([k for k, _, _ in out]) / SMOOTH) ** 2


def solve(X: Array, r: Array, ridge: Array) -> Array:
    """The weights w for which r + X w is least, of X [W, m, F] and r [W, m], [F]."""
    A = np.einsum("wmp,wmq->pq", X, X) + np.diag(ridge)
    return -np.linalg.solve(A, np.einsum("wmp,wm->p", X, r))


def left_out(X: Array, r: Array, blocks: Index, ridge: Array) -> Array:
    """r + X w of each window when its block is left out of the ridge regression, [W, m]."""
    A = np.einsum("wmp,wmq->wpq", X, X)
    g = np.einsum("wmp,wm->wp", X, r)
    total_A, total_g, out = A.sum(0) + np.diag(ridge), g.sum(0), np.empty(r.shape)
    for b in np.unique(blocks):
        mine = blocks == b
        w = -np.linalg.solve(total_A - A[mine].sum(0), total_g - g[mine].sum(0))
        out[mine] = r[mine] + X[mine] @ w
    return out
