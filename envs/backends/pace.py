"""Absolute deadlines for a fixed control rate, and how well they were met."""

import time
from collections.abc import Callable

import numpy as np


class Pace:
    """Control periods that do not drift: each ends one period after the last one was due to end.

    A period that begins after its own end is an overrun: it is counted, and time is counted anew from then.

    Args:
        period: [s].
        measure: The time that lengths are measured in, [s]; deadlines are on whatever clock `now` comes from.
    """

    def __init__(self, period: float, measure: Callable[[], float] = time.monotonic):
        self.period, self.due, self.overruns, self.measure = period, 0.0, 0, measure
        self.lengths: list[float] = []  # [s] of periods without an overrun, from end to end
        self._last = 0.0

    def start(self, now: float) -> None:
        """An episode begins."""
        self.due, self._last = now, self.measure()

    def begin(self, now: float) -> bool:
        """A period begins; whether the one before it overran."""
        self.due += self.period
        late = now > self.due
        if late:
            self.overruns += 1
            self.due = now + self.period
            self._last = self.measure()
        return late

    def end(self) -> None:
        """The period's observation was taken."""
        now = self.measure()
        self.lengths.append(now - self._last)
        self._last = now

    def report(self) -> dict[str, float | int | None]:
        """Length of the periods: median, 99th percentile of the distance from the nominal one [s], and the counts."""
        lengths = np.array(self.lengths)
        off = np.abs(lengths - self.period)
        return {
            "periods": len(lengths),
            "period_median_s": round(float(np.median(lengths)), 5) if len(lengths) else None,
            "jitter_p99_s": round(float(np.percentile(off, 99)), 5) if len(lengths) else None,
            "jitter_max_s": round(float(off.max()), 5) if len(lengths) else None,
            "overruns": self.overruns,
        }
