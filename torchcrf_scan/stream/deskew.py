"""Scans corrected for the motion during their sweep, where the times of their beams are plausible."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Scan
from torchcrf_scan.stream import twist

LONGEST = 1.1  # of the time between scans: a sweep cannot last longer
SHORTEST = 0.125  # of what a scanner needs that turns once between scans

log = logging.getLogger(__name__)


def deskewed(scan: Scan, velocity: Floats, at: float = 0.0) -> Scan:
    """The returns where all beams would have seen them, had they been cast at the same time.

    Args:
        scan: with times. velocity: (3,) of the sensor, (theta, x, y) in its frame. at: seconds after the first beam.
    """
    assert scan.times is not None
    points = se2.apply(twist.exp((scan.times - at)[:, None] * velocity), scan.points[:, None])[:, 0]
    turned = se2.wrap(np.arctan2(points[:, 1], points[:, 0]) - scan.bearings)
    bearings = scan.bearings + turned
    order = np.argsort(bearings, kind="stable")
    ranges = np.hypot(*points.T)[order]
    return replace(scan, ranges=ranges, bearings=bearings[order], beam=scan.beam[order], times=scan.times[order])


def doubt(scan: Scan, period: float | None) -> str:
    """Why the times of a scan's beams are not believed, in words; empty: they are.

    period: seconds between scans; None: not known yet.
    """
    if scan.times is None or len(scan) < 2:
        return "no times"
    sweep, span = float(np.ptp(scan.times)), float(np.ptp(scan.bearings))
    if sweep <= 0:
        return "no times"
    if period is None:
        return ""
    if sweep > LONGEST * period:
        return f"a sweep of {sweep:.3g} s, longer than the {period:.3g} s between scans"
    expected = span / (2 * np.pi) * period
    if sweep < SHORTEST * expected:
        return (
            f"a sweep of {sweep:.3g} s over {np.degrees(span):.0f} degrees, {expected / sweep:.0f} times less than a scanner needs"
        )
    return ""


class Deskewing:
    """Decides whether scans are corrected, and tells once why they are not though they have times.

    Args:
        is_on: as the settings say.
    """

    def __init__(self, is_on: bool) -> None:
        self.is_on = is_on
        self._has_warned = False

    def middle(self, scan: Scan, period: float | None) -> float:
        """Seconds from the first beam to the mean time of the returns: a pose then found hardly depends on the velocity that the
        scan was corrected by, and errors of velocities do not grow from scan to scan. 0 for a scan that is not corrected.

        period: seconds between scans; None: not known yet.
        """
        return float(np.mean(scan.times)) if scan.times is not None and self.suits(scan, period) else 0.0

    def suits(self, scan: Scan, period: float | None) -> bool:
        """Whether the scan has plausible times. period: as in `doubt`."""
        if not self.is_on or scan.times is None:
            return False
        why = doubt(scan, period)
        if why and why != "no times" and not self._has_warned:
            self._has_warned = True
            log.warning("the times of the beams give %s: scans are not corrected for the sweep", why)
        return not why
