"""Time between scans, from stamps that may stand still, jump or go back."""

from __future__ import annotations

import logging
import math
from collections import deque

USUAL = 0.1  # seconds between scans, before any is known
SHORTEST = 1e-4  # seconds; no scanner is faster, and velocities over less are rounding
LONGEST = 1e6  # seconds; a stamp that much later is none
TICKS = 1 << 20  # in a second: what is decided after half a second must not depend on how sums of 0.1 s round
REMEMBERED = 15  # intervals of which the median is the usual one

log = logging.getLogger(__name__)


class Clock:
    """A time that always advances: by the stamps where they do, else by the usual interval.

    Args:
        warns: says in the log when a stamp is not later than the one before, once.

    Attributes:
        now: seconds since the first scan, a whole number of ticks. elapsed: the same, not rounded.
    """

    def __init__(self, *, warns: bool = True) -> None:
        self.now = self.elapsed = 0.0
        self._last = math.nan
        self._intervals: deque[float] = deque(maxlen=REMEMBERED)
        self._has_started, self._has_warned = False, not warns

    @property
    def known(self) -> float | None:
        """Seconds, the median of the last intervals; None before there is one."""
        return sorted(self._intervals)[len(self._intervals) // 2] if self._intervals else None

    @property
    def usual(self) -> float:
        """Seconds between scans as far as known."""
        return self.known or USUAL

    def advance(self, stamp: float) -> float:
        """Seconds since the scan before, above 0; 0 at the first scan. stamp: seconds, of the new scan."""
        since = stamp - self._last
        is_later = SHORTEST <= since < LONGEST  # false for what is not a number
        exact = (since if is_later else self.usual) if self._has_started else 0.0
        interval = round(exact * TICKS) / TICKS
        if is_later:
            self._intervals.append(since)
        elif not self._has_warned and not math.isnan(self._last):
            self._has_warned = True
            log.warning("stamp %s after %s: expected a later one; taken as %.3g s later", stamp, self._last, interval)
        self._has_started = True
        self._last = stamp if math.isfinite(stamp) else math.nan
        self.now, self.elapsed = self.now + interval, self.elapsed + exact
        return interval
