"""Robust functions of a residual: the capped square of the features, and the weight of a robust fit."""

from __future__ import annotations

from torchcrf_scan.features.scales import KAPPA
from torchcrf_scan.loops.jit import kernel


@kernel
def robust_square(error: float, per_scale: float) -> float:
    """Minus min((error per_scale)^2, kappa), `features.scales.robust_square`. per_scale: one over the scale."""
    ratio = error * per_scale
    return -min(ratio * ratio, KAPPA)


@kernel
def robust_slope(error: float, per_scale: float) -> float:
    """Derivative of `robust_square` by the error."""
    ratio = error * per_scale
    return -2 * ratio * per_scale if ratio * ratio <= KAPPA else 0.0


@kernel
def robust_weight(squared: float, scale: float) -> float:
    """Weight of a squared residual: 1 at 0, one half at the residual `scale`."""
    return 1 / (1 + squared / scale**2)
