"""Exact nearest points of a scan: boxes round runs of neighbouring beams, and boxes round runs of boxes.

Neighbouring beams mostly meet the same surface, so their order serves as well as a tree and costs nothing to build.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel

RUN = 8  # points in a box, and boxes in a large box


class Boxes(NamedTuple):
    """P points in beam order with two levels of bounding boxes.

    Attributes:
        points: (P, 2).
        small: (ceil(P / 8), 4), large: (ceil(P / 64), 4) least x and y, largest x and y of every run.
    """

    points: Array
    small: Array
    large: Array


@kernel
def _merge(rows: Array) -> Array:
    """(ceil(Q / 8), 4) boxes round runs of Q boxes."""
    merged = np.empty(((len(rows) + RUN - 1) // RUN, 4))
    for b in range(len(merged)):
        merged[b] = rows[b * RUN]
        for k in range(b * RUN + 1, min(len(rows), (b + 1) * RUN)):
            merged[b, 0], merged[b, 1] = min(merged[b, 0], rows[k, 0]), min(merged[b, 1], rows[k, 1])
            merged[b, 2], merged[b, 3] = max(merged[b, 2], rows[k, 2]), max(merged[b, 3], rows[k, 3])
    return merged


@kernel
def boxes_of(points: Array) -> Boxes:
    """Boxes round runs of (P, 2) points, P >= 1."""
    small = _merge(np.concatenate((points, points), axis=1))
    return Boxes(points, small, _merge(small))


@kernel
def box_distance(box: Array, x: float, y: float) -> float:
    """Squared distance of a point to a box (4,); 0 inside."""
    dx = max(max(box[0] - x, x - box[2]), 0.0)
    dy = max(max(box[1] - y, y - box[3]), 0.0)
    return dx * dx + dy * dy


@kernel
def nearest_within(boxes: Boxes, x: float, y: float, guess: int, least: float) -> tuple[float, int]:
    """Squared distance to and index of the nearest point that is nearer than the root of `least`, -1 if there is none.

    Ties go to the first point. `guess` is tried first, -1: none; good guesses make the search fast.
    """
    points, small, large = boxes
    index = -1
    if guess >= 0:
        dx, dy = points[guess, 0] - x, points[guess, 1] - y
        squared = dx * dx + dy * dy
        if squared < least:
            least, index = squared, guess
    for c in range(len(large)):
        if box_distance(large[c], x, y) > least:
            continue
        for b in range(c * RUN, min(len(small), (c + 1) * RUN)):
            if box_distance(small[b], x, y) > least:
                continue
            for j in range(b * RUN, min(len(points), (b + 1) * RUN)):
                dx, dy = points[j, 0] - x, points[j, 1] - y
                squared = dx * dx + dy * dy
                if squared < least or (squared == least and j < index):
                    least, index = squared, j
    return least, index


@kernel
def nearest(boxes: Boxes, x: float, y: float, guess: int) -> tuple[float, int]:
    """`nearest_within` an infinite distance."""
    return nearest_within(boxes, x, y, guess, np.inf)
