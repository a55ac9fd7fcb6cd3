"""The free-space test (design finding 13): the ranges that a scan measured in a direction, and how exactly."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.features.free_space import SLACK_SHARE, SLACK_STEPS, WIDEST_GAP
from torchcrf_scan.loops.circle import turn_apart
from torchcrf_scan.loops.jit import Array, kernel


@kernel
def measured_ranges(
    ranges: Array, bearings: Array, step: float, is_closed: bool, bearing: float, after: int
) -> tuple[float, float]:
    """Least and largest of the two ranges beside a bearing: the free space ends between them.

    Args:
        ranges, bearings: (N,) of the scan, N >= 1, the latter rising. step: radians between two beams.
        after: first beam whose bearing is not less than `bearing`.

    Returns:
        Metres; -inf and inf in a gap where nothing was measured, twice -inf beyond the end of an open scan, where all is hidden.
    """
    N = len(ranges)
    if not is_closed and bearing > bearings[N - 1] + step / 2:
        return -np.inf, -np.inf
    left, right = max(after - 1, 0), min(after, N - 1)
    if is_closed:
        left, right = (after - 1 if after > 0 else N - 1), (after if after < N else 0)
    if left != right:
        apart = max(turn_apart(bearing - bearings[left]), turn_apart(bearings[right] - bearing))
        if not apart < WIDEST_GAP * step:
            return -np.inf, np.inf
    return min(ranges[left], ranges[right]), max(ranges[left], ranges[right])


@kernel
def range_slack(reach: float, step: float, noise: float) -> float:
    """Metres by which a measured range may differ from a distance `reach` without contradiction. step: radians; noise: metres."""
    return max(SLACK_STEPS * (noise + reach * step) + SLACK_SHARE * reach, 1e-6)
