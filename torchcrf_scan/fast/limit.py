"""The distance of outliers in metres for one pair; `features.limit` without batches."""

from __future__ import annotations

from typing import NamedTuple

from torchcrf_scan.features.limit import STRENGTH
from torchcrf_scan.loops.jit import kernel
from torchcrf_scan.loops.messages import exp_below


class Limit(NamedTuple):
    """Distance and width of its step, in the features' unit of length; distance 0: none, outliers are told as learned."""

    distance: float
    softness: float


@kernel
def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x))."""
    below = exp_below(-abs(x))
    return (1.0 if x > 0 else below) / (1 + below)


@kernel
def log_within(limit: Limit, distance: float) -> float:
    """Log potential of an inlier at a distance, `features.limit.Limit.log_within`."""
    return STRENGTH * (1 - 2 * sigmoid((distance - limit.distance) / limit.softness))


@kernel
def slope_within(limit: Limit, distance: float) -> float:
    """Derivative of `log_within` by the distance."""
    beyond = sigmoid((distance - limit.distance) / limit.softness)
    return -2 * STRENGTH * beyond * (1 - beyond) / limit.softness
