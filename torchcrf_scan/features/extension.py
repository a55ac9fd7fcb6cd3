"""Features in addition to the thirty that the paper describes: `features.decisions`, `features.free_space`, `features.reach`.

Robust squares do not set a distance limit for inliers, so there are a gate and a constant; nor do they prefer the nearest of
several points enough. A point in the free space of the other scan under a motion does not move so (design finding 13), and a
point far from the segment that a mover was found by is hardly part of it (finding 21).
Names and order are those of `names.py`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcrf_scan.features.free_space import FreeSpace
from torchcrf_scan.features.scales import Scales, beyond_gate, robust_square
from torchcrf_scan.names import CLUSTERING_EXTENSION

FARTHEST_EXCESS = 3.0  # scales
_OF_OUTLIER = [name for name in CLUSTERING_EXTENSION if name.startswith("outlier")]
_OF_INLIERS = [name for name in CLUSTERING_EXTENSION if name not in _OF_OUTLIER]
ORDER = [[*_OF_INLIERS, *_OF_OUTLIER].index(name) for name in CLUSTERING_EXTENSION]


def association_extension(distance: Tensor, mask: Tensor, sight: FreeSpace, scales: Scales) -> Tensor:
    """The association chain's extension features of every state, the outlier last.

    Args:
        distance: (B, N, K) to the candidates under the point's own motion; mask: (B, N, K) which are real.
        sight: free space and occlusion in the target scan of the points under their own motion, (B, N).

    Returns:
        (B, N, K+1, 5).
    """
    nearest = distance.masked_fill(~mask, torch.inf).amin(-1, keepdim=True)
    excess = ((distance - nearest) / scales.cluster_distance).clamp(0.0, FARTHEST_EXCESS)
    inliers = torch.stack([-excess, -beyond_gate(distance, scales)], dim=-1)
    outlier = torch.stack([torch.ones_like(sight.hidden), sight.seen_through, sight.hidden], dim=-1)
    return with_outlier(inliers, outlier)


def clustering_extension(
    residual: Tensor, ahead: FreeSpace, back: FreeSpace, is_inlier: Tensor, reach: Tensor | None, scales: Scales
) -> Tensor:
    """The clustering chain's extension features of every state, the outlier last.

    Args:
        residual: (B, N, C) under every motion.
        ahead: free space and occlusion in the target scan of the points under every motion, (B, N, C).
        back: the same in the source scan of the points' partners under every motion's inverse, (B, N, C); inliers only.
        is_inlier: (B, N) whether the point has a partner.
        reach: (B, N, C) of `Start.reach`; None: a feature of zeros.

    Returns:
        (B, N, D, 9).
    """
    partnered = is_inlier[..., None].to(residual)
    contradicted = [ahead.seen_through, back.seen_through * partnered, ahead.hidden, back.hidden * partnered]
    beyond = torch.zeros_like(residual) if reach is None else -robust_square(reach, torch.ones_like(reach))
    inliers = -torch.stack([beyond_gate(residual, scales), *contradicted, beyond], dim=-1)
    under_background = [ahead.seen_through[..., 0], ahead.hidden[..., 0]]
    outlier = torch.stack([torch.ones_like(under_background[0]), *under_background], dim=-1)
    return with_outlier(inliers, outlier)[..., ORDER]


def with_outlier(inliers: Tensor, outlier: Tensor) -> Tensor:
    """Joins features of inlier states (B, N, S, F) and of the outlier (B, N, G), zero for each other: (B, N, S+1, F+G)."""
    return torch.cat([pad(inliers, (0, outlier.shape[-1])), pad(outlier, (inliers.shape[-1], 0))[:, :, None]], dim=2)
