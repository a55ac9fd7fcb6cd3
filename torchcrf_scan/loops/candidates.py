"""Candidate target points of every source point; `features.candidates` for one pair, by a search, not all distances."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.nearest import RUN, Boxes, box_distance, boxes_of, nearest
from torchcrf_scan.loops.rigid import apply


@kernel
def under_motions(source: Array, motions: Array, active: Booleans) -> tuple[Array, Integers]:
    """(A, N, 2) source points under every active motion, and (A,) which these are. motions: (C, 3); active: (C,)."""
    which, A = np.empty(len(active), np.int64), 0
    for c in range(len(active)):
        if active[c]:
            which[A] = c
            A += 1
    moved = np.empty((A, len(source), 2))
    for a in range(A):
        moved[a] = apply(motions[which[a]], source)
    return moved, which[:A]


@kernel
def _least_distance(moved: Array, i: int, x: float, y: float) -> float:
    """Squared distance of a target point to source point i under the closest motion. moved: (A, N, 2)."""
    least = np.inf
    for a in range(len(moved)):
        dx, dy = moved[a, i, 0] - x, moved[a, i, 1] - y
        least = min(least, dx * dx + dy * dy)
    return least


@kernel
def _insert(distance: float, j: int, last: int, squared: Array, index: Integers) -> None:
    """Inserts a point before `last`, which is dropped from the list of the nearest, sorted by distance, then by index."""
    place = last
    while place > 0 and (squared[place - 1] > distance or (squared[place - 1] == distance and index[place - 1] > j)):
        squared[place], index[place] = squared[place - 1], index[place - 1]
        place -= 1
    squared[place], index[place] = distance, j


@kernel
def _improve(boxes: Boxes, moved: Array, i: int, member: Integers, squared: Array, index: Integers, guess: Integers) -> None:
    """Improves the list (K,) of source point i to its nearest points, and finds the nearest point under every motion.

    member: (M,) is i for the points in the list. guess: (A,) a point that may be the nearest, and afterwards is; the first of them.
    """
    points, small, large = boxes
    last = len(index) - 1
    for a in range(len(moved)):
        x, y, closest = moved[a, i, 0], moved[a, i, 1], guess[a]
        least = (points[closest, 0] - x) ** 2 + (points[closest, 1] - y) ** 2
        reach = max(squared[last], least)
        for c in range(len(large)):
            if box_distance(large[c], x, y) > reach:
                continue
            for b in range(c * RUN, min(len(small), (c + 1) * RUN)):
                if box_distance(small[b], x, y) > reach:
                    continue
                for j in range(b * RUN, min(len(points), (b + 1) * RUN)):
                    dx, dy = points[j, 0] - x, points[j, 1] - y
                    distance = dx * dx + dy * dy
                    if distance > reach:
                        continue
                    if distance < least or (distance == least and j < closest):
                        least, closest = distance, j
                    if distance <= squared[last] and member[j] != i:
                        of_any = _least_distance(moved, i, points[j, 0], points[j, 1])
                        if of_any < squared[last] or (of_any == squared[last] and j < index[last]):
                            member[index[last]] = -1
                            _insert(of_any, j, last, squared, index)
                            member[j] = i
                    reach = max(squared[last], least)
        guess[a] = closest


@kernel
def sort_in_place(index: Integers) -> None:
    """Sorts in ascending order; for a few numbers."""
    for k in range(1, len(index)):
        value, place = index[k], k
        while place > 0 and index[place - 1] > value:
            index[place] = index[place - 1]
            place -= 1
        index[place] = value


@kernel
def nearest_under(boxes: Boxes, moved: Array, which: Integers, C: int) -> Integers:
    """(N, C) nearest target point under every active motion; 0 under the others. moved: (A, N, 2); which: (A,)."""
    index = np.zeros((moved.shape[1], C), np.int64)
    M = len(boxes.points)
    for a in range(len(which) if M > 0 else 0):
        guess = 0
        for i in range(moved.shape[1]):
            _, guess = nearest(boxes, moved[a, i, 0], moved[a, i, 1], guess)
            index[i, which[a]] = guess
            guess = min(guess + 1, M - 1)
    return index


@entry
def by_motion(boxes: Boxes, source: Array, motions: Array, active: Booleans, count: int) -> tuple[Integers, Booleans, Integers]:
    """The `count` nearest target points under any active motion; all of them when count is 0 (dense).

    Args:
        boxes: of M target points. source: (N, 2); motions: (C, 3); active: (C,) bool.
        count: K. Ties go to the first points.

    Returns:
        index (N, K), ascending; mask (N, K), all true unless no motion is active; nearest (N, C), see `nearest_under`.
    """
    N, M = len(source), len(boxes.points)
    moved, which = under_motions(source, motions, active)
    A = len(which)
    is_dense = count == 0 or count >= M
    K = M if is_dense else count
    index, mask = np.empty((N, K), np.int64), np.full((N, K), is_dense or A > 0)
    if is_dense or A == 0:
        index[:] = np.arange(K)
        return index, mask, nearest_under(boxes, moved, which, len(active))
    closest, guess = np.zeros((N, len(active)), np.int64), np.zeros(A, np.int64)
    squared, member = np.empty(K), np.full(M, -1)
    for i in range(N):  # the candidates of the point before, or those after them, are good guesses
        step = 1 if i > 0 and index[i - 1, K - 1] < M - 1 else 0
        for k in range(K):
            j = index[i - 1, k] + step if i > 0 else k
            _insert(_least_distance(moved, i, boxes.points[j, 0], boxes.points[j, 1]), j, k, squared, index[i])
            member[j] = i
        _improve(boxes, moved, i, member, squared, index[i], guess)
        sort_in_place(index[i])
        for a in range(A):
            closest[i, which[a]] = guess[a]
            guess[a] = min(guess[a] + 1, M - 1)
    return index, mask, closest


@entry
def candidates_of(
    source: Array, target: Array, motions: Array, active: Booleans, count: int
) -> tuple[Integers, Booleans, Integers]:
    """`by_motion` of one pair. source: (N, 2); target: (M, 2)."""
    return by_motion(boxes_of(target), source, motions, active, count)


@entry
def with_targets(index: Integers, mask: Booleans, association: Integers) -> tuple[Integers, Booleans, Integers]:
    """Adds a given target to every point's candidates, replacing the last if it is missing, and returns its position.

    Args:
        index, mask: (N, K). association: (N,), -1 outlier.

    Returns:
        index, mask (copies), and (N,) the state of that target, K for an outlier.
    """
    N, K = index.shape
    index, mask, place = index.copy(), mask.copy(), np.full(N, K)
    for i in range(N):
        if association[i] < 0 or K == 0:
            continue
        place[i] = K - 1
        for k in range(K):
            if mask[i, k] and index[i, k] == association[i]:
                place[i] = k
                break
        index[i, place[i]], mask[i, place[i]] = association[i], True
    return index, mask, place
