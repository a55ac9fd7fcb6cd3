"""Cached candidates: a point's list of nearest targets is provably unchanged while its motions change little.

A motion that displaces a point by d changes none of its distances by more than d. So the K nearest targets stay the same until
some motion of the point has displaced it by half the gap between the last target in the list and the next one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.candidates import by_motion
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.nearest import Boxes

ROUNDING = 1e-9  # of the unit of features: smaller changes of distance are rounding errors


class Kept(NamedTuple):
    """Candidates cached between rounds, updated by `update`; results do not depend on the cache.

    Attributes:
        index: (N, K) candidates, ascending. lead: (N,) gap to the next target, -1 at first.
        moved: (C, N, 2) the moved points when their lists were made. active: (C,) the active motions then.
    """

    index: Integers  # type: ignore[assignment]  # hides a method of tuples
    lead: Array
    moved: Array
    active: Booleans


@kernel
def kept_of(points: int, targets: int, clusters: int, count: int) -> Kept:
    """An empty cache for N points, M targets, C clusters and K candidates, 0 for all targets."""
    K = count if 0 < count < targets else targets
    lead = np.full(points, -1.0)
    return Kept(np.empty((points, K), np.int64), lead, np.empty((clusters, points, 2)), np.zeros(clusters, np.bool_))


@kernel
def stale_points(kept: Kept, moved: Array, active: Booleans) -> Integers:
    """(P,) the points whose lists may have changed. moved: (C, N, 2) points under every active motion; active: (C,)."""
    N = len(kept.lead)
    places, P = np.empty(N, np.int64), 0
    is_other = False
    for c in range(len(active)):
        is_other = is_other or active[c] != kept.active[c]
    for i in range(N):
        farthest = 0.0
        for c in range(len(active)):
            if active[c] and kept.lead[i] >= 0:
                dx, dy = moved[c, i, 0] - kept.moved[c, i, 0], moved[c, i, 1] - kept.moved[c, i, 1]
                farthest = max(farthest, dx * dx + dy * dy)
        if is_other or not 2 * math.sqrt(farthest) + ROUNDING < kept.lead[i]:
            places[P] = i
            P += 1
    return places[:P]


@kernel
def keep_nearest(kept: Kept, i: int, longer: Integers, boxes: Boxes, moved: Array, active: Booleans) -> None:
    """Makes the list of point i from the K + 1 nearest targets, ascending. Other arguments as in `stale_points`."""
    worst, last, second = -1.0, 0, -1.0
    for k in range(len(longer)):
        x, y = boxes.points[longer[k], 0], boxes.points[longer[k], 1]
        least = np.inf
        for c in range(len(active)):
            if active[c]:
                least = min(least, (moved[c, i, 0] - x) ** 2 + (moved[c, i, 1] - y) ** 2)
        if least >= worst:  # ties go to the first one
            worst, last, second = least, k, worst
        else:
            second = max(second, least)
    for k in range(kept.index.shape[1]):
        kept.index[i, k] = longer[k] if k < last else longer[k + 1]
    kept.lead[i] = math.sqrt(worst) - math.sqrt(second)


@kernel
def update(kept: Kept, boxes: Boxes, source: Array, moved: Array, motions: Array, active: Booleans) -> None:
    """Brings the lists up to date; they are then those of `candidates.by_motion`.

    Args:
        boxes: of M targets. source: (N, 2). moved: (C, N, 2) source points under every active motion.
        motions: (C, 3). active: (C,), some.
    """
    K, M = kept.index.shape[1], len(boxes.points)
    if K == M:
        kept.index[:] = np.arange(M)
        return
    places = stale_points(kept, moved, active)
    some = np.empty((len(places), 2))
    for p in range(len(places)):
        some[p, 0], some[p, 1] = source[places[p], 0], source[places[p], 1]
    longer, _, _ = by_motion(boxes, some, motions, active, K + 1)
    for p in range(len(places)):
        keep_nearest(kept, places[p], longer[p], boxes, moved, active)
        for c in range(len(active)):
            kept.moved[c, places[p], 0], kept.moved[c, places[p], 1] = moved[c, places[p], 0], moved[c, places[p], 1]
    for c in range(len(active)):
        kept.active[c] = active[c]
