"""Numbers of a simulator, and how much they differ from window to window, are found again."""

from __future__ import annotations

import numpy as np
import pytest

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.dropo import dropo

WINDOWS, TRUTH = 150, np.array([0.3, 0.7, 0.5])


def found(spread: list[float]) -> tuple[Array, Array, Array]:
    """Mean and standard deviation of each draw, where the truth of each window is spread, and that truth [W, 3]."""
    rng = np.random.default_rng(0)
    slope, scale = rng.normal(size=(WINDOWS, 5, 3)), np.full((WINDOWS, 5), 0.02)

    def outcome(places: Array) -> Array:  # [..., W, D] -> [..., W, 5]
        return np.einsum("wsd,...wd->...ws", slope, places) + 0.3 * np.sin(3 * places.sum(-1))[..., None]

    truth = np.clip(TRUTH + spread * rng.normal(size=(WINDOWS, 3)), 0, 1)
    measured = outcome(truth) + scale * rng.normal(size=scale.shape)
    shapes = dropo(lambda p: outcome(np.repeat(p[:, None], WINDOWS, 1)), 3, measured, scale, seed=0)
    a, b = shapes.T.numpy()
    return a / (a + b), np.sqrt(a * b / ((a + b) ** 2 * (a + b + 1))), truth


def test_one_truth_is_found_and_believed() -> None:
    mean, spread, _ = found([0.0, 0.0, 0.0])
    assert np.abs(mean - TRUTH).max() < 0.01
    assert spread.max() < 0.02, "as narrow as a Beta distribution may be"


def test_what_differs_between_windows_stays_wide_and_nothing_else() -> None:
    mean, spread, truth = found([0.0, 0.0, 0.1])
    assert np.abs(mean - truth.mean(0)).max() < 0.01
    assert spread[:2].max() < 0.02 and spread[2] == pytest.approx(truth[:, 2].std(), rel=0.15)


def test_nothing_to_find_is_refused() -> None:
    with pytest.raises(ValueError, match="draws=0, windows=2"):
        dropo(lambda p: p, 0, np.zeros((2, 1)), np.ones((2, 1)), seed=0)
