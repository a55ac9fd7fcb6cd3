"""Tolerance of the free-space test (design finding 13), common to the tests of points and of labels."""

from __future__ import annotations

from torchcrf_scan.features.free_space import LEAST_SLACK, SLACK_SHARE, SLACK_STEPS
from torchcrf_scan.loops.jit import kernel


@kernel
def range_slack(reach: float, step: float, noise: float) -> float:
    """Metres by which a measured range may differ from a distance `reach` without contradiction. step: radians; noise: metres."""
    return max(SLACK_STEPS * (noise + reach * step) + SLACK_SHARE * reach, LEAST_SLACK)
