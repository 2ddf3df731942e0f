"""Smoothed accelerations, and forces as they show them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter

from mpc_sgft.diagnose.data.smooth import averaged


@pytest.mark.parametrize("spread", [5, 25, 75])
def test_a_force_is_averaged_as_the_acceleration_that_it_makes(spread: int) -> None:
    """A unit mass under a rough force, each step's own: what smoothing makes of its acceleration is the mean of it."""
    rng, dt = np.random.default_rng(0), 0.004
    force = np.cumsum(rng.standard_normal(600))
    x = np.cumsum(np.cumsum(np.r_[0.0, force[:-1]])) * dt**2  # second differences are the force of the sample between
    told = savgol_filter(x, spread, 3, deriv=2, delta=dt)
    inner = slice(spread, -spread)
    assert averaged(force, spread)[inner] == pytest.approx(told[inner], abs=1e-6 * np.abs(force).max())
    assert averaged(np.ones(100), spread) == pytest.approx(1.0)
