"""What is expected of a pair's movers from before: more hypotheses of the search, judged as all others are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.search.groups import MIN_POINTS, Groups
from torchcrf_scan.search.hypotheses import Hypotheses
from torchcrf_scan.search.leftover import Leftover
from torchcrf_scan.search.pool import SEGMENT_POINTS, segment_hypotheses


class Expected(NamedTuple):
    """What is known of the movers of a pair before it is matched.

    Attributes:
        motions: (E, 3) `T_target_source` of E objects. members: (E, N) bool, the source points that may be theirs.
        log_moving: (N,) log potential of every source point for moving, added to that of all movers.
    """

    motions: Array
    members: Booleans
    log_moving: Array


def with_expected(hypotheses: Hypotheses, expected: Expected, leftover: Leftover) -> Hypotheses:
    """The hypotheses, and for every expected object of enough points its motion as it is and registered to the target."""
    points, target = leftover.source.grid.scan.points, leftover.target.grid
    motions, group = [hypotheses.motions], [hypotheses.group]
    start, members = [hypotheses.groups.start], [hypotheses.groups.members]
    for motion, mine in zip(expected.motions, expected.members, strict=True):
        index = np.flatnonzero(mine)
        if len(index) < MIN_POINTS:
            continue
        some = points[index[np.arange(SEGMENT_POINTS) * len(index) // SEGMENT_POINTS]]
        registered = segment_hypotheses(some[None], target, motion[None], leftover.unit)
        motions.append(np.concatenate([motion[None], registered]))
        group.append(np.full(2, sum(map(len, start)) - 1))
        start.append(start[-1][-1:] + len(index))
        members.append(index)
    groups = Groups(np.concatenate(start), np.concatenate(members))
    return Hypotheses(np.concatenate(motions), np.concatenate(group), groups)
