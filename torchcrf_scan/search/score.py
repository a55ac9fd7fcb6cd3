"""The score of hypothesised motions: a logistic function of their features, its form and its fitted weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LARGEST = 4.0  # standard deviations; larger values are clipped

# Feature: its mean, its scale, and the weights of the standardised feature and of its square. All weights of this file are those
# of `learning.hypothesis_fit.fit_mixture()`.
STREETS_AND_ROOMS = {
    "size": (2.3, 0.943, -0.636, -0.147),
    "share_of_segment": (0.579, 0.368, 0.502, -0.238),
    "extent": (1.796, 0.783, -0.201, 0.215),
    "linearity": (0.824, 0.162, -0.095, 0.021),
    "range": (0.104, 0.657, -0.635, -0.051),
    "residual": (0.868, 0.483, 0.127, -0.229),
    "gain": (0.711, 0.884, 0.599, 0.082),
    "total_gain": (1.574, 1.075, 0.02, -0.141),
    "explained": (0.706, 0.258, 0.22, -0.004),
    "open_before": (0.5, 0.377, 0.31, -0.102),
    "occluded_before": (0.12, 0.262, 0.073, -0.142),
    "seen_through_before": (0.053, 0.179, 0.504, -0.08),
    "seen_through": (0.044, 0.118, -0.477, -0.148),
    "occluded": (0.055, 0.129, -0.225, -0.221),
    "distinct": (0.567, 0.268, 0.155, -0.071),
    "landing_open": (0.306, 0.333, 0.028, -0.018),
    "landing_seen_through_before": (0.049, 0.177, 0.237, -0.046),
    "target_open": (1.622, 0.858, -0.005, -0.233),
    "target_residual": (1.742, 0.9, 0.087, 0.094),
    "target_gain": (0.379, 0.876, 0.258, 0.139),
    "target_total_gain": (0.863, 0.966, 0.218, 0.029),
    "target_cover": (0.335, 0.341, -0.226, 0.061),
    "displacement": (2.381, 1.128, -0.47, 0.125),
    "displacement_in_spacings": (2.54, 1.174, -0.117, -0.816),
    "displacement_in_range": (0.283, 0.291, -0.505, -0.021),
    "displacement_in_extent": (1.376, 1.047, -0.754, -0.83),
    "along_surface": (0.747, 0.216, -0.258, 0.128),
    "rotation": (0.47, 0.547, -0.749, -0.44),
    "gain_both_ways": (1.917, 1.051, 0.372, 0.244),
    "residual_to_best": (0.492, 0.461, 0.032, 0.446),
    "total_gain_to_best": (-0.974, 0.909, 0.165, 0.14),
    "target_total_gain_to_best": (-1.128, 0.885, -0.005, 0.074),
    "units_around": (1.123, 0.382, 0.023, 0.021),
    "scene_open": (0.244, 0.105, -0.279, 0.013),
    "unexcused": (0.293, 0.321, 0.074, -0.03),
    "landing_unexcused": (0.202, 0.282, 0.199, 0.059),
    "unexcused_both": (0.152, 0.237, -0.088, -0.142),
    "landing_occluded_before": (0.047, 0.167, 0.077, -0.046),
    "fair_gain": (1.096, 1.007, -0.128, 0.074),
    "share_of_piece": (0.891, 0.256, 0.153, 0.05),
    "landing_piece_cover": (0.557, 0.31, 0.168, 0.098),
    "stands_out": (0.081, 0.611, 0.389, -0.045),
    "landing_stands_out": (0.081, 0.484, 0.329, 0.094),
}

FEATURES = tuple(STREETS_AND_ROOMS)  # the order of every vector of features

BIAS, THRESHOLD = -5.785, 0.4

PRODUCTS = {  # of two standardised features: the weight
    ("displacement_in_extent", "total_gain_to_best"): -0.402,
    ("displacement_in_extent", "share_of_segment"): -0.448,
    ("displacement_in_extent", "landing_piece_cover"): -0.246,
    ("displacement_in_spacings", "range"): -0.76,
    ("displacement_in_spacings", "unexcused"): -0.25,
    ("displacement", "target_total_gain"): 0.073,
    ("range", "unexcused"): 0.052,
    ("along_surface", "stands_out"): 0.142,
}


class HypothesisScore(nn.Module):
    """Probability that a hypothesis is a mover's motion: logistic in the standardised features, their squares and a few products.

    It starts with weights fitted on simulated streets, model cars and rooms; `learning.hypothesis_fit` fits others.

    Attributes:
        mean, scale: (F,). weight: (2F + R,) of the standardised features, then of their squares, then of `PRODUCTS`. bias: ().
        threshold: () probability from which a hypothesis is accepted.
    """

    mean: Tensor
    scale: Tensor
    weight: Tensor
    bias: Tensor
    threshold: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, scale, weight, of_square = torch.tensor([STREETS_AND_ROOMS[name] for name in FEATURES]).unbind(-1)
        self.register_buffer("mean", mean.clone())
        self.register_buffer("scale", scale.clone())
        self.register_buffer("weight", torch.cat([weight, of_square, torch.tensor(list(PRODUCTS.values()))]))
        self.register_buffer("bias", torch.tensor(BIAS))
        self.register_buffer("threshold", torch.tensor(THRESHOLD))

    def terms(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (..., 2F + R) the weighted terms."""
        standard = ((features - self.mean) / self.scale).clamp(-LARGEST, LARGEST)
        one, other = zip(*PRODUCTS, strict=True)
        products = standard[..., [FEATURES.index(name) for name in one]] * standard[..., [FEATURES.index(name) for name in other]]
        return torch.cat([standard, standard**2, products], dim=-1)

    def forward(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (...) probabilities."""
        return (self.terms(features) @ self.weight + self.bias).sigmoid()
