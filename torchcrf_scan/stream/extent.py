"""The extent of an object: a box along its heading, of what was seen of it so far, and what a partial view tells of its centre.

The centroid of the visible points jumps when an object shows another side. The box does not: points within it move nothing, an
edge that faces the sensor shifts it, and points that cover more than the box make it grow.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools, Floats, Ints

GROWTH = 0.5  # share of the points' excess by which a box grows at a time


class Interval(NamedTuple):
    """What points cover along and across a heading, relative to a centre, metres.

    Attributes:
        low, high: (..., 2) along and across.
    """

    low: Floats
    high: Floats

    @property
    def middle(self) -> Floats:
        """(..., 2) the middle."""
        return (self.low + self.high) / 2

    @property
    def size(self) -> Floats:
        """(..., 2) length and width."""
        return self.high - self.low


def cover(points: Floats, centre: Floats, heading: float) -> Interval:
    """What the points (n, 2), n > 0, cover along and across the heading, relative to the centre (2,)."""
    local = se2.rotate(np.asarray(-heading), points - centre)
    return Interval(local.min(0), local.max(0))


def covers(points: Floats, starts: Ints, centres: Floats, headings: Floats) -> Interval:
    """What K clusters cover in the frames of T boxes: (T, K, 2) low and high.

    Args:
        points: (N, 2), cluster by cluster, none of them empty. starts: (K,) index of the first point of each.
        centres: (T, 2). headings: (T,).
    """
    local = se2.rotate(-headings[:, None], points - centres[:, None])  # (T, N, 2)
    return Interval(np.minimum.reduceat(local, starts, axis=1), np.maximum.reduceat(local, starts, axis=1))


def gap(seen: Interval, extent: Floats) -> Floats:
    """(..., 2) how far points and box are from one lying within the other, along and across: 0 if one does."""
    slack = np.abs(extent - seen.size) / 2
    return np.sign(seen.middle) * np.maximum(np.abs(seen.middle) - slack, 0)


class View(NamedTuple):
    """What a partial view tells of a box, along and across its heading, metres.

    Attributes:
        shift: (2,) how far the box is to be moved to agree with the points; is_seen: (2,) whether that was observed.
        excess: (2,) of the points' size beyond the box's. side: (2,) in [-1, 1], where that lies: 1 in front, -1 behind.
    """

    shift: Floats
    is_seen: Bools
    excess: Floats
    side: Floats


def look(seen: Interval, extent: Floats, sensor: Floats | None, noise: Floats) -> View:
    """Compares points with a box.

    A face that the sensor looks at is where the points end, and what is beyond the box lies on its other side. Otherwise points
    that fill the box have its middle, points within it tell nothing, and points beyond it push it.

    Args:
        seen: of the points, relative to the box's centre. extent: (2,).
        sensor: (2,) position of the sensor in the box's frame; None: not known.
        noise: (2,) standard deviation of where points end, metres.
    """
    half = extent / 2
    front, back = seen.high - half, seen.low + half  # of the points beyond the box's
    excess = np.maximum(seen.size - extent, 0)
    is_full, is_larger = seen.size >= extent, excess > 3 * noise
    pushed = np.where(front > 0, front, np.minimum(back, 0))
    shift = np.where(is_full, seen.middle, pushed)
    is_seen = (is_full | (pushed != 0)) & ~is_larger
    side = np.clip((front + back) / np.maximum(excess, 1e-9), -1, 1)
    if sensor is not None:
        from_front, from_back = sensor > half, sensor < -half
        shift = np.where(from_front, front, np.where(from_back, back, shift))
        is_seen |= from_front | from_back
        side = np.where(from_front, -1.0, np.where(from_back, 1.0, side))
    return View(shift, is_seen, excess, side)
