"""Simpler ways to name what is missing, all on the inverse-dynamics residual, as reports that `score` can read.

| name            | how it decides                                                                              |
|-----------------|---------------------------------------------------------------------------------------------|
| always_viscous  | viscous friction, whatever the data                                                         |
| training_error  | the one effect that fits the training data best                                             |
| bic             | forward selection of up to three effects while the Bayesian information criterion falls     |
| all_at_once     | everything in one fit; what is more than two standard errors from zero is named             |
| pysindy         | sequentially thresholded least squares, the sparse regression of PySINDy                    |
| network         | a small network explains the residual and names nothing                                     |

Sources: S. Brunton, J. Proctor, J. Kutz, PNAS 113(15), 2016 (STLSQ); G. Schwarz, Ann. Statist. 6(2), 1978 (BIC).
"""

from pathlib import Path
from typing import Any

import numpy as np

from tools.studies.blind.features import Motion, columns, read, uncertain
from tools.studies.blind.plants import Array

THRESHOLD = 0.1  # of PySINDy, in standard deviations of the residual per standard deviation of a column
RIDGE = 0.05  # of PySINDy (its default), per sample of unit columns
Library = dict[str, list[Array]]


def run(case: Path) -> dict[str, dict[str, Any]]:
    """Every baseline on one case folder: reports by baseline name.

    Each report also has `held_out_ratio`: what is left of the missing force on held-out data, root mean square, over
    what the nominal model leaves.
    """
    model, motion = read(case)
    r, library = columns(model, motion)
    free = {"mass": "payload@", "gain": "actuator_gain@"}
    given = [c for what in uncertain(case) for k, v in library.items() if k.startswith(free[what]) for c in v]
    train = np.repeat(motion.train, motion.q.shape[1])
    r, library = _without(r, library, given, train)
    out = {"always_viscous": report([k for k in library if k.startswith("viscous")], r, library, train)}
    ranked = sorted(library, key=lambda k: _best(r, [], library[k], train)[0])
    out["training_error"] = report(ranked[:1], r, library, train, ranked)
    out["bic"] = report(_forward(r, library, train), r, library, train, ranked)
    out["all_at_once"] = report(_everything(r, library, train), r, library, train, ranked)
    names, flat = _flat(r, library, train)
    kept = sparse(flat[train], r[train], THRESHOLD, RIDGE)
    out["pysindy"] = report(list(dict.fromkeys(n for n, k in zip(names, kept, strict=True) if k)), r, library, train)
    out["network"] = {"verdict": "unknown", "effects": [], "candidates": [], "held_out_ratio": _network(motion, r)}
    return out


def report(labels: list[str], r: Array, library: Library, train: Array, ranked: list[str] | None = None) -> dict:
    """What the baseline says, in the shape of diagnose's report."""
    chosen: list[Array] = []
    for label in labels:
        chosen.append(_best(r, chosen, library[label], train)[1])
    left = r - _fit(r, np.concatenate(chosen, 1), train) if chosen else r
    test = ~train
    ratio = float(np.sqrt(np.mean(left[test] ** 2) / max(np.mean(r[test] ** 2), 1e-30)))
    effects = [{"name": k.split("@")[0], "at": k.split("@")[1:], "parameters": {}} for k in labels]
    first = [{"effects": [e["name"] for e in effects]}] if effects else []
    rest = [{"effects": [k.split("@")[0]]} for k in ranked or [] if k not in labels]
    verdict = "effect" if labels else "none"
    return {"verdict": verdict, "effects": effects, "candidates": first + rest, "held_out_ratio": ratio}


def sparse(a: Array, y: Array, threshold: float, ridge: float) -> Array:
    """Which columns survive PySINDy's sequentially thresholded least squares, [K] of bool.

    Args:
        a: Columns, [M, K]; scaled to unit root mean square here, as y is.
        y: What they explain, [M].
        threshold: Smallest coefficient that is kept, of scaled columns.
        ridge: Penalty on the squared coefficients, for columns of unit Euclidean length.
    """
    from pysindy.optimizers import STLSQ  # late: it takes seconds

    rms, size = np.sqrt(np.mean(a**2, 0)), max(float(np.sqrt(np.mean(y**2))), 1e-30)
    scaled = a / np.where(rms > 0, rms, 1.0) / np.sqrt(len(a))
    fitted = STLSQ(threshold=threshold, alpha=ridge, max_iter=20).fit(scaled, (y / size / np.sqrt(len(y)))[:, None])
    return np.abs(fitted.coef_[0]) > 0


def _without(r: Array, library: Library, given: list[Array], train: Array) -> tuple[Array, Library]:
    """Project out what a wrong nominal mass or gain does, from the residual and from every column."""
    if not given:
        return r, library
    basis = np.concatenate(given, 1)
    x, *_ = np.linalg.lstsq(basis[train], np.stack([r[train]], 1), rcond=None)

    def clean(c: Array) -> Array:
        y, *_ = np.linalg.lstsq(basis[train], c[train], rcond=None)
        return c - basis @ y

    cleaned = {k: [clean(c) for c in v] for k, v in library.items()}
    some = {
        k: [c for c, o in zip(v, library[k], strict=True) if _size(c) > 1e-3 * _size(o)] for k, v in cleaned.items()
    }
    return r - (basis @ x)[:, 0], {k: v for k, v in some.items() if v}


def _size(c: Array) -> float:
    return float(np.sqrt(np.mean(c**2)))


def _fit(r: Array, a: Array, train: Array) -> Array:
    scale = np.sqrt(np.mean(a[train] ** 2, 0)) + 1e-30
    x, *_ = np.linalg.lstsq(a[train] / scale, r[train], rcond=1e-8)
    return a @ (x / scale)


def _best(r: Array, chosen: list[Array], variants: list[Array], train: Array) -> tuple[float, Array]:
    """Smallest training error over an effect's variants beside the chosen columns, and that variant."""
    errors = []
    for c in variants:
        left = r - _fit(r, np.concatenate([*chosen, c], 1), train)
        errors.append(float(np.mean(left[train] ** 2)))
    i = int(np.argmin(errors))
    return errors[i], variants[i]


def _forward(r: Array, library: Library, train: Array, most: int = 3) -> list[str]:
    count, chosen, labels = int(train.sum()), [], []
    score = count * np.log(np.mean(r[train] ** 2))
    while len(labels) < most:
        options = {k: _best(r, chosen, v, train) for k, v in library.items() if k not in labels}
        parameters = sum(c.shape[1] for c in chosen)
        scores = {
            k: count * np.log(error) + (parameters + c.shape[1]) * np.log(count) for k, (error, c) in options.items()
        }
        name = min(scores, key=lambda k: scores[k])
        if scores[name] >= score:
            return labels
        score, labels = scores[name], [*labels, name]
        chosen.append(options[name][1])
    return labels


def _flat(r: Array, library: Library, train: Array) -> tuple[list[str], Array]:
    """One variant of each effect, the one that fits best alone, side by side."""
    best = {k: _best(r, [], v, train)[1] for k, v in library.items()}
    return [k for k, c in best.items() for _ in range(c.shape[1])], np.concatenate(list(best.values()), 1)


def _everything(r: Array, library: Library, train: Array) -> list[str]:
    names, a = _flat(r, library, train)
    a = a[train] / (np.sqrt(np.mean(a[train] ** 2, 0)) + 1e-30)
    inverse = np.linalg.pinv(a.T @ a, rcond=1e-8)
    x = inverse @ a.T @ r[train]
    spread = np.sqrt(np.mean((r[train] - a @ x) ** 2) * np.diag(inverse).clip(0))
    return list(dict.fromkeys(n for n, k in zip(names, np.abs(x) > 2 * spread, strict=True) if k))


def _network(m: Motion, r: Array, steps: int = 300) -> float:
    """Held-out ratio of a small network from position, velocity and command to the residual."""
    import torch

    torch.manual_seed(0)
    inputs = np.concatenate([m.q, m.v, m.command], 1)
    x = (inputs - inputs[m.train].mean(0)) / (inputs[m.train].std(0) + 1e-9)
    y = r.reshape(len(m.q), -1)
    scale = y[m.train].std(0) + 1e-30
    xt, yt = (torch.tensor(z, dtype=torch.float32) for z in (x, y / scale))
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], 32),
        torch.nn.Tanh(),
        torch.nn.Linear(32, 32),
        torch.nn.Tanh(),
        torch.nn.Linear(32, y.shape[1]),
    )
    optimiser = torch.optim.Adam(net.parameters(), 5e-3, weight_decay=1e-4)
    train = torch.tensor(m.train)
    for _ in range(steps):
        optimiser.zero_grad()
        loss: torch.Tensor = ((net(xt[train]) - yt[train]) ** 2).mean()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        left = (net(xt).numpy() * scale - y)[~m.train]
    return float(np.sqrt(np.mean(left**2) / max(np.mean(y[~m.train] ** 2), 1e-30)))


NAMES = ("always_viscous", "training_error", "bic", "all_at_once", "pysindy", "network")
