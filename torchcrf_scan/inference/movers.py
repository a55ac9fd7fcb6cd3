"""The start of the moving objects (InitialiseRT, second half): a learned score of hypothesised motions, and which to accept."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.hypotheses import Hypotheses, residual_units
from torchcrf_scan.inference.hypothesis_features import EXPLAINED, FEATURES, Landing, share_in_common
from torchcrf_scan.inference.surface import Surface

AS_WELL = 0.5  # units; a motion that fits this much worse at most explains the points as well
LARGEST = 4.0  # standard deviations; what lies beyond tells no more
SHARED = 0.4  # share of points in common from which two hypotheses compete

# Feature: its mean, its scale, and the weights of the standardised feature and of its square; fitted on 110 simulated pairs.
STREETS_AND_ROOMS = {
    "size": (2.468, 0.986, -0.409, 0.037),
    "share_of_segment": (0.79, 0.341, 0.264, -0.236),
    "extent": (2.085, 0.832, -0.095, 0.165),
    "linearity": (0.802, 0.177, -0.285, -0.163),
    "range": (0.179, 0.655, -0.595, -0.007),
    "residual": (1.03, 0.564, 0.071, -0.064),
    "gain": (0.555, 0.961, 0.561, 0.154),
    "total_gain": (1.492, 1.16, 0.107, -0.029),
    "explained": (0.631, 0.276, 0.069, 0.077),
    "open_before": (0.529, 0.391, 0.264, -0.333),
    "occluded_before": (0.111, 0.232, 0.102, -0.092),
    "seen_through_before": (0.053, 0.173, 0.405, -0.05),
    "seen_through": (0.079, 0.16, -0.423, -0.157),
    "occluded": (0.08, 0.149, -0.59, -0.022),
    "distinct": (0.555, 0.278, 0.144, -0.116),
    "landing_open": (0.311, 0.327, -0.04, -0.14),
    "landing_seen_through_before": (0.055, 0.175, 0.572, -0.08),
    "target_open": (1.808, 0.852, -0.386, -0.266),
    "target_residual": (1.846, 0.871, 0.006, 0.027),
    "target_gain": (0.324, 0.874, 0.387, 0.144),
    "target_total_gain": (0.882, 1.008, 0.223, 0.002),
    "target_cover": (0.404, 0.364, -0.005, -0.012),
    "displacement": (2.251, 1.195, -0.2, -0.23),
    "displacement_in_spacings": (2.461, 1.255, -0.013, -0.385),
    "displacement_in_range": (0.308, 0.32, -0.483, 0.095),
    "displacement_in_extent": (1.117, 1.019, -0.694, -1.016),
    "along_surface": (0.703, 0.215, -0.289, 0.063),
    "rotation": (0.531, 0.608, -0.571, -0.235),
    "gain_both_ways": (1.873, 1.128, 0.275, 0.232),
    "residual_to_best": (0.517, 0.525, -0.245, 0.151),
    "total_gain_to_best": (-0.843, 0.934, 0.275, 0.014),
    "target_total_gain_to_best": (-0.966, 0.893, 0.049, 0.224),
    "units_around": (1.061, 0.356, 0.188, 0.068),
    "scene_open": (0.203, 0.097, -0.168, -0.051),
}
BIAS, THRESHOLD = -4.902, 0.35


class HypothesisScore(nn.Module):
    """Probability that a hypothesis is a mover's motion: logistic in the standardised features and their squares.

    It starts with weights fitted on simulated streets, model cars and rooms; `learning.hypothesis_fit` fits others.

    Attributes:
        mean, scale: (F,). weight: (2F,) of the standardised features, then of their squares. bias: ().
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
        self.register_buffer("weight", torch.cat([weight, of_square]))
        self.register_buffer("bias", torch.tensor(BIAS))
        self.register_buffer("threshold", torch.tensor(THRESHOLD))

    def terms(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (..., 2F) the terms that the weights belong to."""
        standard = ((features - self.mean) / self.scale).clamp(-LARGEST, LARGEST)
        return torch.cat([standard, standard**2], dim=-1)

    def forward(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (...) probabilities."""
        return (self.terms(features) @ self.weight + self.bias).sigmoid()


@dataclass(frozen=True, slots=True)
class Movers:
    """G accepted movers, the surest first.

    Attributes:
        motions: (G, 3) `T_target_source`.
        probabilities: (G,).
        members: (G, P) bool, the source segment that each was found by.
    """

    motions: Tensor
    probabilities: Tensor
    members: Tensor


def select(
    hypotheses: Hypotheses, probabilities: Tensor, source: Surface, target: Surface, *, threshold: float, most: int
) -> Movers:
    """Accepts the surest hypothesis, drops what competes with it, and so on: non-maximum suppression.

    Two compete when they move the same points, explain the same points of the second scan, or when the accepted motion explains
    the other's points as well.

    Args:
        probabilities: (H,).
        threshold: least probability. most: movers at most.
    """
    likely = (probabilities >= threshold).nonzero()[:, 0]
    likely = likely[probabilities[likely].argsort(descending=True)]
    if not len(likely) or not most:
        return Movers(hypotheses.motions[:0], probabilities[:0], hypotheses.members[:0])
    pool = Hypotheses(hypotheses.motions[likely], hypotheses.members[likely])
    rivals = _rivals(pool, source, target)
    accepted: list[int] = []
    for row, beside in enumerate(rivals.tolist()):
        if len(accepted) < most and not any(beside[k] for k in accepted):
            accepted.append(row)
    chosen = likely[accepted]
    return Movers(hypotheses.motions[chosen], probabilities[chosen], hypotheses.members[chosen])


def _rivals(pool: Hypotheses, source: Surface, target: Surface) -> Tensor:
    """(H, H) bool: hypothesis h competes with g, once g is accepted."""
    landing = Landing.of(pool, source, target)
    same_points = share_in_common(pool.members) > SHARED
    same_goal = share_in_common(landing.target_units < EXPLAINED) > SHARED
    by_other = residual_units(se2.apply(pool.motions[:, None], source.points[landing.index]), target)  # (g, h, L)
    count = landing.is_member.sum(-1)
    by_other = (by_other * landing.is_member).sum(-1) / count
    return same_points | same_goal | (by_other.T - landing.mean(landing.units)[:, None] < AS_WELL)


def find_movers(
    hypotheses: Hypotheses, features: Tensor, source: Surface, target: Surface, score: HypothesisScore, *, most: int = 6
) -> Movers:
    """The hypotheses that the score accepts. features: (H, F) of `hypothesis_features`; most: movers at most."""
    return select(hypotheses, score(features), source, target, threshold=float(score.threshold), most=most)
