"""Deadlines do not drift, and an overrun is counted."""

import pytest

from envs.backends.pace import Pace


def test_late_wakings_do_not_add_up() -> None:
    now = [10.0]
    pace = Pace(0.2, lambda: now[0])
    pace.start(10.0)
    for k in range(100):
        assert not pace.begin(pace.due + 0.03)  # planning took 30 ms
        assert pace.due == pytest.approx(10.2 + 0.2 * k)
        now[0] = pace.due + 0.004 * (k % 2)
        pace.end()
    report = pace.report()
    assert report["overruns"] == 0 and report["period_median_s"] == pytest.approx(0.2, abs=0.005)
    assert 0 < report["jitter_p99_s"] <= 0.005  # type: ignore[operator]


def test_an_overrun_is_counted_and_starts_anew() -> None:
    now = [0.0]
    pace = Pace(0.2, lambda: now[0])
    pace.start(0.0)
    now[0] = 3.0
    assert pace.begin(3.0)
    assert pace.due == pytest.approx(3.2) and pace.overruns == 1
    now[0] = 3.2
    pace.end()
    assert not pace.begin(3.25) and pace.due == pytest.approx(3.4)
    assert pace.report()["jitter_max_s"] == pytest.approx(0.0, abs=1e-9)
