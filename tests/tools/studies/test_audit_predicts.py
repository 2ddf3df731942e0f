"""The area under the curve by hand, and what counts as a run."""

from pathlib import Path

import numpy as np
import pytest

from tools.studies.audit_predicts import Run, area, interval, runs

HEAD = "gap,method,variant,seed,rollouts,success,episodes,audit,frozen_sha256\n"


def some(shares: list[float], best: list[float], gaps: str = "abcdefgh") -> list[Run]:
    return [Run(g, "0", s, b) for g, s, b in zip(gaps, shares, best, strict=False)]


def test_the_area_counts_pairs_in_the_right_order_and_half_of_the_ties() -> None:
    found = some([0.9, 0.5, 0.5, 0.1], [1.0, 0.9, 0.2, 0.89])  # pairs: 0.9 before both, 0.5 ties with one
    assert area(found) == pytest.approx((1 + 1 + 0.5 + 1) / 4)
    assert np.isnan(area(found[:2]))


def test_the_interval_holds_the_area_and_is_none_where_the_order_is_perfect() -> None:
    assert interval(some([0.9, 0.8, 0.2, 0.1], [1, 1, 0, 0])) == (1.0, 1.0)
    found = some([0.9, 0.3, 0.6, 0.1, 0.5, 0.4], [1, 1, 0, 0, 1, 0])
    low, high = interval(found)
    assert 0 <= low < area(found) < high <= 1


def test_a_run_is_its_best_evaluation_after_real_rollouts(tmp_path: Path) -> None:
    rows = ["a,sgft,,0,0,1.0,50,0.7,x", "a,sgft,,0,10,0.5,50,0.7,x", "a,sgft,,0,20,0.8,50,0.7,x"]
    rows += ["a,sgft,,1,10,0.95,50,0.6,x", "a,tdmpc2,,0,10,1.0,50,0.7,x", "a,sgft,horizon=1,0,10,1.0,50,0.7,x"]
    rows += ["b,sgft,,0,10,1.0,50,,x"]
    (tmp_path / "s.csv").write_text(HEAD + "\n".join(rows) + "\n")
    assert runs([tmp_path / "s.csv"]) == [Run("a", "0", 0.7, 0.8), Run("a", "1", 0.6, 0.95)]
    assert [r.reached for r in runs([tmp_path / "s.csv"])] == [False, True]
