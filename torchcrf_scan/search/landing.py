"""Members of a group under a hypothesised motion: residuals, nearest target points and free-space test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.rigid import apply_to_some
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.hypotheses import pick
from torchcrf_scan.search.leftover import residual_at
from torchcrf_scan.search.surface import look_along

EXPLAINED = 1.0  # units; smaller residuals count as explained
FEATURE_POINTS = 24


class Sample(NamedTuple):
    """At most `FEATURE_POINTS` members of a group under a hypothesis.

    Attributes:
        member: (L,) index of the source. moved: (2, L). units: (L,) truncated residual. nearest: (L,) target point.
        sight: (L,) free-space test of it in the target, see `search.surface`.
    """

    member: Integers
    moved: Array
    units: Array
    nearest: Integers
    sight: Integers


@kernel
def empty_sample() -> Sample:
    """A sample before its members are taken."""
    L = FEATURE_POINTS
    return Sample(np.empty(L, np.int64), np.empty((2, L)), np.empty(L), np.empty(L, np.int64), np.empty(L, np.int64))


@kernel
def take_members(members: Integers, index: Integers) -> int:
    """Writes at most `FEATURE_POINTS` members to `index`; returns how many."""
    L = min(len(members), FEATURE_POINTS)
    for k in range(L):
        index[k] = members[pick(k, len(members), FEATURE_POINTS)]
    return L


@kernel
def land(points: Array, target: ScanGrid, units: Array, motion: Array, sample: Sample, L: int) -> None:
    """Moves the L members of `sample` and finds residuals, nearest target points and free-space tests.

    points: (P, 2) of the source. units: (M,) metres. motion: (3,).
    """
    apply_to_some(motion, points, sample.member[:L], sample.moved)
    residual_at(sample.moved, target, units, sample.units[:L], sample.nearest[:L])
    for k in range(L):
        sample.sight[k] = look_along(target.scan, sample.moved[0, k], sample.moved[1, k])


@kernel
def box_of(sample: Sample, L: int) -> Array:
    """(4,) least x and y, largest x and y of the moved members."""
    box = np.empty(4)
    box[0] = box[2] = sample.moved[0, 0]
    box[1] = box[3] = sample.moved[1, 0]
    for k in range(1, L):
        box[0], box[2] = min(box[0], sample.moved[0, k]), max(box[2], sample.moved[0, k])
        box[1], box[3] = min(box[1], sample.moved[1, k]), max(box[3], sample.moved[1, k])
    return box


@kernel
def gap_squared(one: Array, other: Array) -> float:
    """Squared distance of two boxes (4,)."""
    dx = max(max(one[0] - other[2], other[0] - one[2]), 0.0)
    dy = max(max(one[1] - other[3], other[1] - one[3]), 0.0)
    return dx * dx + dy * dy


@kernel
def nearest_member(sample: Sample, L: int, x: float, y: float, guess: int, enough: float) -> tuple[float, int]:
    """Squared distance to and number of the nearest member, or of any that is nearer than the root of `enough`."""
    dx, dy = sample.moved[0, guess] - x, sample.moved[1, guess] - y
    least, index = dx * dx + dy * dy, guess
    if least < enough:
        return least, index
    for k in range(L):
        dx, dy = sample.moved[0, k] - x, sample.moved[1, k] - y
        squared = dx * dx + dy * dy
        if squared < least:
            least, index = squared, k
            if least < enough:
                break
    return least, index
