"""Scales and constants of the features; fitted on the training pairs (spec 1.3, 3, 4), saved with the weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchcrf_scan.config import FeatureConfig
from torchcrf_scan.names import (
    ASSOCIATION_WEIGHTS,
    CLUSTERING_WEIGHTS,
    DECISION_WEIGHTS,
    FREE_SPACE_WEIGHTS,
    LOCAL_CHANNELS,
    REACH_WEIGHT,
    SCALED_EDGES,
)

GATE_WIDTH = 0.05  # of the sigmoid at the gate of outliers, as a share of the gate
KAPPA = 9.0  # cap of robust squares: three standard deviations (spec 0.1)

# Scales before any fitting, metres or radians.
LOCAL = {
    **{"dist1": 0.1, "dist3": 0.2, "dist5": 0.3, "angle1": 0.3, "angle3": 0.3, "angle5": 0.3},
    **{"geo1": 0.1, "geo3": 0.3, "geo5": 0.5, "radius": 0.5, "translation": 0.5, "registered_translation": 0.1},
}
EDGES = {"pairwise_distance": 0.1, "pairwise_translation": 0.15}
WORST = -4.0  # value of a channel at the outlier state before any fitting


def live_weights(config: FeatureConfig) -> tuple[Tensor, Tensor]:
    """(23,) and (21,): 1 for the weights of the model, 0 for those fixed at 0 (raw channels in W-B, left-out features)."""
    dead = {*config.left_out}
    dead |= set() if config.raw_channels else {f"association.{name}" for name in LOCAL_CHANNELS}
    dead |= set() if config.free_space else {*FREE_SPACE_WEIGHTS}
    dead |= set() if config.decisions else {*DECISION_WEIGHTS}
    dead |= set() if config.reach == "soft" else {REACH_WEIGHT}
    association = [f"association.{name}" not in dead for name in ASSOCIATION_WEIGHTS]
    clustering = [f"clustering.{name}" not in dead for name in CLUSTERING_WEIGHTS]
    return torch.tensor(association, dtype=torch.float64), torch.tensor(clustering, dtype=torch.float64)


def has_weight(config: FeatureConfig, name: str) -> bool:
    """Whether a model has the parameter `association.NAME` or `clustering.NAME`: thirty always (spec 5.1), others if enabled."""
    is_on = (config.free_space or name not in FREE_SPACE_WEIGHTS) and (config.decisions or name not in DECISION_WEIGHTS)
    return is_on and (config.reach == "soft" or name != REACH_WEIGHT)


def robust_square(error: Tensor, scale: Tensor) -> Tensor:
    """Minus min((error / scale)^2, kappa): 0 for no error, at least -9 (spec 0.1, A-03)."""
    return -((error / scale) ** 2).clamp(max=KAPPA)


def beyond_gate(distance: Tensor, scales: Scales) -> Tensor:
    """Sigmoid of the distance: 0 well inside the gate of outliers, 1/2 at it, 1 well beyond; 0.1 to 0.9 within a fifth of it."""
    return torch.sigmoid((distance / scales.gate - 1) / GATE_WIDTH)


class Scales(nn.Module):
    """Scales of the features, as buffers in metres or radians; defaults are those of a street scanner before any fitting.

    Attributes:
        local: (12,) scale of every local association channel.
        local_outlier: (12,) value of every channel at the outlier state: the worst tenth of the true pairs (spec 5.1).
        pairwise: (2,) scales of pairwise distance and pairwise translation.
        pairwise_outlier: (2,) their value on every transition that touches the outlier (A-14).
        cluster_distance: () scale of a point's residual under its own motion.
        outlier_threshold: () residual above which no motion explains a point.
        gate: () residual that separates true pairs from outliers with the fewest errors.
        neighbour_weight: () length scale of the neighbour weight.
        neighbour_distance: () scale of the elongation of an edge (stiffness, neighbour distance).
    """

    local: Tensor
    local_outlier: Tensor
    pairwise: Tensor
    pairwise_outlier: Tensor
    cluster_distance: Tensor
    outlier_threshold: Tensor
    gate: Tensor
    neighbour_weight: Tensor
    neighbour_distance: Tensor

    def __init__(self) -> None:
        super().__init__()
        values = {
            "local": [LOCAL[name] for name in LOCAL_CHANNELS],
            "local_outlier": [WORST] * len(LOCAL_CHANNELS),
            "pairwise": [EDGES[name] for name in SCALED_EDGES],
            "pairwise_outlier": [WORST] * len(SCALED_EDGES),
            "cluster_distance": 0.1,
            "outlier_threshold": 0.3,
            "gate": 0.3,
            "neighbour_weight": 0.5,
            "neighbour_distance": 0.1,
        }
        for name, value in values.items():
            self.register_buffer(name, torch.tensor(value))
