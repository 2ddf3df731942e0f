"""Simulation error, robust over windows: whitened residuals, errors of the start projected out, bounded Gauss-Newton.

What is minimised is the mean over windows of log(1 + e / s), e a window's mean square residual and s some times the
windows' median of it: a window that a structure cannot explain does not outvote those that it can. Its Gauss-Newton
steps are those of least squares with weights 1 / (1 + e / s).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.simulation.plant import Change
from mpc_sgft.diagnose.simulation.replay import Replayer

MAX_POINTS = 40  # residuals per window and signal; more samples are averaged
STEP = 1e-2  # finite differences, in typical sizes of a parameter
TOLERANCE = 1e-3  # relative gain of an iteration that is too small to go on
ITERATIONS = 12
MOST_STEPS = 8  # of a pattern search, of one size
HOPS = (-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0)  # to neighbouring minima, and around in a narrow one
OUTLYING = 4.0  # times the median error, or noise
MOST_FLOOR = 10.0  # times noise and tolerance: the simulator's own error weighs a point down by no more


class Fit(NamedTuple):
    """A structure with its best parameters on the windows it was fitted to.

    Attributes:
        terms: Nominal quantities first, then effects.
        values: One array [p] each term.
        r: Whitened residuals of the fitted windows, [W, m].
        J: Their derivatives by the parameters in typical sizes, [W, m, P].
    """

    terms: tuple[Term, ...]
    values: tuple[Array, ...]
    r: Array
    J: Array

    @property
    def weights(self) -> Array:
        """Of the fitted windows, [W]."""
        return weights(self.r)


def typical(r: Array) -> float:
    """The error beyond which a window of residuals [W, m] loses weight."""
    return OUTLYING * max(1.0, float(np.median((r**2).mean(-1))))


def weights(r: Array) -> Array:
    """Of windows with residuals [W, m], [W]."""
    return 1 / (1 + (r**2).mean(-1) / typical(r))


def robust(r: Array, scale: float) -> Array:
    """What a fit minimises, of residuals [..., W, m], [...]."""
    return np.log1p((r**2).mean(-1) / scale).mean(-1)


def change_of(terms: Sequence[Term], values: Sequence[Array]) -> Change:
    total = Change()
    for term, value in zip(terms, values, strict=True):
        if not np.array_equal(value, term.neutral):
            total = total + term.build(value)
    return total


class Residuals(Protocol):
    """What can be fitted.

    Attributes:
        blocks: Number of independent points of a signal in a window.
        step: Finite differences, in typical sizes of a parameter.
        pattern: Steps of a pattern search where derivatives mislead, in typical sizes; none where residuals are smooth.
    """

    blocks: int
    step: float
    pattern: tuple[float, ...]

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[Array]], pick: Index) -> Array:
        """Whitened residuals of one structure at K points on some windows, [K, W, m]."""
        ...


class Discrepancy(NamedTuple):
    """How far predictions of the right model are off, at every sample of every window.

    Attributes:
        known: What the simulator's time step leaves out, to be added to predictions, [W, n, S].
        floor: What may be off beyond that, with its sign, terms [F, W, n, S] that add up in squares.
        doubt: Of each sample, beyond its noise, [W, n, S]; as large for its neighbours.
    """

    known: Array
    floor: Array
    doubt: Array


class Problem:
    """Residuals of structures over windows.

    Args:
        replayer: Simulates.
        sigma: Noise of each signal, one sample, [S].
        own: Errors of the simulator itself.
        tolerated: What of each signal does not matter, [S]; averaging does not make it less.
        start_sd: Uncertainty of each window's start, [W, 2 nj]; projected out.
        sensitivity: Derivative of the predictions by the start, [W, n, S, 2 nj].

    Attributes:
        known: What the simulator's time step leaves out, to be added to predictions, [W, n, S].
        floor_shares: Of each residual's expected square, how much each term of the floor makes, 0…1, [F, W, m].
    """

    step, pattern = STEP, ()

    def __init__(
        self,
        replayer: Replayer,
        sigma: Array,
        own: Discrepancy,
        tolerated: Array,
        start_sd: Array,
        sensitivity: Array,
    ):
        self.replayer, self.sigma, self.known = replayer, sigma, own.known
        n = replayer.windows.samples
        self.stride = max(1, n // MAX_POINTS)
        self.blocks = n // self.stride
        self.target = self._average(replayer.windows.measured - own.known)
        hidden = sigma**2 / self.stride + tolerated**2
        floors = self._average(own.floor) ** 2
        floors *= np.minimum(1.0, MOST_FLOOR**2 * hidden / np.maximum(floors.sum(0), 1e-300))
        self.scale = np.sqrt(hidden + floors.sum(0) + self._average(own.doubt) ** 2)
        self.floor_shares = (floors / self.scale**2).reshape(len(floors), len(self.scale), self.scale[0].size)
        moved = self._average(np.moveaxis(sensitivity, -1, 0)) / self.scale  # [2 nj, W, nb, S]
        a = moved.reshape(*moved.shape[:2], -1).transpose(1, 2, 0) * start_sd[:, None]  # [W, m, 2 nj]
        self.u, s, _ = np.linalg.svd(a, full_matrices=False)
        self.shrink = 1 - 1 / np.sqrt(1 + s**2)

    def whiten(self, predicted: Array, pick: Index) -> Array:
        """Predictions [K, W, n, S] -> residuals [K, W, m] of unit variance where the model is right."""
        y = (self._average(predicted) - self.target[pick]) / self.scale[pick]
        y = y.reshape(*y.shape[:2], -1)
        u = self.u[pick]
        return y - np.einsum("wmi,kwi->kwm", u, np.einsum("wmi,kwm->kwi", u, y) * self.shrink[pick])

    def residuals(self, terms: Sequence[Term], points: Sequence[Sequence[Array]], pick: Index) -> Array:
        """Whitened residuals of one structure at K points, [K, W, m]."""
        return self.whiten(self.replayer.simulate([change_of(terms, p) for p in points], pick), pick)

    def _average(self, x: Array) -> Array:
        """Mean over blocks of samples of [..., n, S]."""
        cut = x[..., : self.blocks * self.stride, :]
        return cut.reshape(*cut.shape[:-2], self.blocks, self.stride, cut.shape[-1]).mean(-2)


def fit(
    problem: Residuals, terms: Sequence[Term], start: Sequence[Array], pick: Index, iterations: int = ITERATIONS
) -> Fit:
    """Bounded Levenberg-Marquardt; each iteration tries three dampings in one batch.

    Args:
        problem: What is minimised.
        terms: The structure.
        start: Parameters to start from, one array each term.
        pick: Windows to fit.
        iterations: At most.
    """
    flat = _Flat(terms)
    x = flat.pack(start)
    if not flat.count:
        r = problem.residuals(terms, [start], pick)[0]
        return Fit(tuple(terms), tuple(start), r, np.zeros((*r.shape, 0)))
    x, r, J = _descend(problem, flat, x, pick, iterations)
    if flat.hops.any() and (elsewhere := _hop(problem, flat, x, pick)) is not x:
        x, r, J = _descend(problem, flat, elsewhere, pick, iterations)
    if problem.pattern:
        x, r, J = _walk(problem, flat, x, pick), None, None
    if r is None or J is None:
        r, J = _linearise(problem, flat, x, pick, r)
    return Fit(tuple(terms), tuple(flat.unpack(x)), r, J)


def _descend(
    problem: Residuals, flat: _Flat, x: Array, pick: Index, iterations: int
) -> tuple[Array, Array | None, Array | None]:
    """Where it ends, and residuals and derivatives there as far as they are known."""
    damping, r, J = 1e-2, None, None
    for _ in range(iterations):
        if r is None or J is None:
            r, J = _linearise(problem, flat, x, pick, r)
        w = weights(r)
        A, g = np.einsum("w,wmp,wmq->pq", w, J, J, optimize=True), np.einsum("w,wmp,wm->p", w, J, r, optimize=True)
        tries = [flat.clip(x + _step(A, g, lam, x, flat)) for lam in (damping / 10, damping, damping * 30)]
        scale = typical(r)
        tried = problem.residuals(flat.terms, [flat.unpack(t) for t in tries], pick)
        costs = robust(tried, scale)
        best = int(np.argmin(costs))
        before = float(robust(r, scale))
        damping = min(max(damping * (0.1, 1.0, 30.0)[best], 1e-8), 1e8)
        if costs[best] >= before:
            damping *= 10
            if damping > 1e4:
                break
            continue
        x, r, J = tries[best], tried[best], None
        if before - costs[best] < TOLERANCE * before:
            break
    return x, r, J


def _hop(problem: Residuals, flat: _Flat, x: Array, pick: Index) -> Array:
    """To the best of the neighbours at a parameter's hops, and of points between them, while that is better.

    A force follows its command at once: whether a late command comes before or after a sample changes what is read
    there, so that the error has a minimum between any two samples.
    """
    moves = np.concatenate([k * np.diag(flat.hops)[flat.hops > 0] for k in HOPS])
    scale = typical(problem.residuals(flat.terms, [flat.unpack(x)], pick)[0])
    return _best_nearby(problem, flat, x, pick, moves, scale)


def _walk(problem: Residuals, flat: _Flat, x: Array, pick: Index) -> Array:
    """Pattern search (Hooke and Jeeves, 1961): to the best of a step along each parameter, while that is better.

    Where contacts begin and end within a window, residuals are rugged: their derivatives are noise, and Gauss-Newton
    takes steps that are too short.
    """
    scale = typical(problem.residuals(flat.terms, [flat.unpack(x)], pick)[0])
    for size in problem.pattern:
        moves = size * np.concatenate([np.eye(flat.count), -np.eye(flat.count)])
        x = _best_nearby(problem, flat, x, pick, moves, scale)
    return x


def _best_nearby(problem: Residuals, flat: _Flat, x: Array, pick: Index, moves: Array, scale: float) -> Array:
    """To the best of the points at these moves [M, P] from here, while that is better."""
    for _ in range(MOST_STEPS):
        tries = [x, *(flat.clip(x + m) for m in moves)]
        costs = robust(problem.residuals(flat.terms, [flat.unpack(t) for t in tries], pick), scale)
        best = int(np.argmin(costs))
        if costs[best] >= (1 - TOLERANCE) * costs[0]:
            break
        x = tries[best]
    return x


def _linearise(problem: Residuals, flat: _Flat, x: Array, pick: Index, r: Array | None = None) -> tuple[Array, Array]:
    """Residuals at a point [W, m], simulated if they are not given, and their derivatives [W, m, P]."""
    steps = flat.steps(x, problem.step)
    points = [x, *(x + steps[i] * np.eye(flat.count)[i] for i in range(flat.count))]
    new = points if r is None else points[1:]
    all_r = problem.residuals(flat.terms, [flat.unpack(p) for p in new], pick)
    here, around = (all_r[0], all_r[1:]) if r is None else (r, all_r)
    return here, np.moveaxis((around - here) / steps[:, None, None], 0, -1)


def _step(A: Array, g: Array, damping: float, x: Array, flat: _Flat) -> Array:
    """Damped Gauss-Newton step with the parameters that push against a bound held."""
    free = ~(((x <= flat.low) & (g > 0)) | ((x >= flat.high) & (g < 0)))
    step = np.zeros(flat.count)
    if free.any():
        sub = A[np.ix_(free, free)]
        diagonal = np.diag(sub)
        sub = sub + np.diag(damping * diagonal + 1e-9 * max(float(diagonal.max()), 1e-30))
        step[free] = -np.linalg.solve(sub, g[free])
    return step


class _Flat:
    """Parameters of a structure as one vector, in typical sizes."""

    def __init__(self, terms: Sequence[Term]):
        self.terms = tuple(terms)
        none = np.zeros(0)
        self.size = np.concatenate([none, *(t.size for t in terms)])
        self.least, self.most = (np.concatenate([none, *x]) for x in ([t.low for t in terms], [t.high for t in terms]))
        self.low, self.high = self.least / self.size, self.most / self.size
        self.count = len(self.size)
        self.hops = np.concatenate([none, *(t.hops or np.zeros(len(t.size)) for t in terms)]) / self.size

    def pack(self, values: Sequence[Array]) -> Array:
        return self.clip(np.concatenate([np.zeros(0), *values]) / self.size)

    def unpack(self, x: Array) -> list[Array]:
        cuts = np.cumsum([len(t.size) for t in self.terms])[:-1]
        return np.split(np.clip(x * self.size, self.least, self.most), cuts)

    def clip(self, x: Array) -> Array:
        return np.clip(x, self.low, self.high)

    def steps(self, x: Array, step: float) -> Array:
        """Finite-difference steps that stay inside the bounds."""
        return np.where(x + step > self.high, -step, step)


def part_edges(points: int, parts: int) -> Index:
    """Where equal parts of so many points begin and end, [parts + 1]."""
    return np.linspace(0, points, parts + 1).astype(int)


def by_parts(squares: Array, parts: int) -> Array:
    """Means of [W, m] over equal parts of each row, one after the other, [W parts]."""
    edges = part_edges(squares.shape[1], parts)
    return (np.add.reduceat(squares, edges[:-1], axis=1) / np.diff(edges)).ravel()


def window_errors(problem: Residuals, f: Fit, pick: Index, parts: int = 1) -> Array:
    """Mean whitened square of a fitted structure on windows that it may not have seen, [W parts]."""
    return by_parts(problem.residuals(f.terms, [f.values], pick)[0] ** 2, parts)


def left_out_errors(f: Fit, blocks: Index) -> Array:
    """Error of each part of each fitted window when its block is left out of the fit, to first order, [W parts].

    Args:
        f: The fit.
        blocks: Block of each part of each fitted window, [W, parts].
    """
    count, parts = f.J.shape[-1], blocks.shape[1]
    if not count:
        return by_parts(f.r**2, parts)
    of = np.repeat(blocks, np.diff(part_edges(f.r.shape[1], parts)), axis=1)  # block of every residual
    root = np.sqrt(f.weights)[:, None]
    J, r, out = f.J * root[..., None], f.r * root, np.empty(f.r.shape)
    total = np.einsum("wmp,wmq->pq", J, J, optimize=True)
    ridge = 1e-9 * np.eye(count) * max(float(np.trace(total)) / count, 1e-30)
    for b in np.unique(of):
        mine = of == b
        rest = total - J[mine].T @ J[mine] + ridge
        moved = np.linalg.solve(rest, J[mine].T @ r[mine])
        out[mine] = (f.r[mine] + f.J[mine] @ moved) ** 2
    return by_parts(out, parts)
