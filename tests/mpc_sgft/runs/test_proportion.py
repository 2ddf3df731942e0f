"""A share's interval against the textbook and against scipy's."""

import math

import pytest
from scipy.stats import binomtest

from mpc_sgft.runs.proportion import wilson


def test_wilson_matches_the_textbook() -> None:
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)
    assert wilson(0, 100) == pytest.approx((0.0, 0.0370), abs=1e-4)
    assert all(math.isnan(end) for end in wilson(0, 0))


@pytest.mark.parametrize(("hits", "count"), [(0, 1), (1, 1), (3, 50), (49, 50), (100, 100), (77, 200)])
def test_wilson_is_scipys(hits: int, count: int) -> None:
    interval = binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((interval.low, interval.high), abs=1e-12)
