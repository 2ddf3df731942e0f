"""Numbers of the report."""

import numpy as np
import pytest

from mpc_sgft.diagnose.rows import reduction


def test_what_was_nothing_and_is_nothing_fell_by_nothing() -> None:
    rng, none = np.random.default_rng(0), np.zeros(6)
    still = reduction("qpos/j", "rad", none, none, rng)
    assert (still["reduction"], still["low"], still["high"]) == (0.0, 0.0, 0.0)
    moved = reduction("qpos/j", "rad", none + 4.0, none + 1.0, rng)
    assert (moved["nominal"], moved["repaired"]) == (2.0, 1.0)
    assert [moved[k] for k in ("reduction", "low", "high")] == pytest.approx([0.5, 0.5, 0.5])
