"""InitialiseRT: where the iterations start (Algorithm 1, line 1). It decides the result, so it is looked for with care.

Background: shape-only matching with RANSAC and registrations from a grid of starts, the best by what it leaves unexplained over
the whole scene (`background.py`). Movers: hypothesised motions of segments that the background does not explain (`movers.py`).
No gradient passes through the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features import candidates
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import background_pool, unit_length
from torchcrf_scan.inference.cold import ransac_motions, shape_association
from torchcrf_scan.inference.movers import HypothesisScore, find_movers
from torchcrf_scan.inference.surface import Surface

FEWEST_POINTS = 3  # a scan with fewer says nothing of the motion
RANSAC_STARTS = 4
FOOTPRINT = 0.0175  # radians; spacing of a one-degree scanner on a surface that faces it


@dataclass(frozen=True, slots=True)
class Start:
    """Motions to begin with.

    Attributes:
        motions: (B, C, 3), active: (B, C).
        association: (B, N) nearest target point under the best motion, -1 where none comes near.
        target_tangents: (B, M, 2) direction of the target's surface at every point, 0 where it has none.
    """

    motions: Tensor
    active: Tensor
    association: Tensor
    target_tangents: Tensor

    def background_alone(self) -> Start:
        """The start of CRF-Matching, which has one motion."""
        return replace(self, motions=self.motions[:, :1], active=self.active[:, :1])


@torch.no_grad()
def initialise(batch: ScanPairBatch, scales: Scales, score: HypothesisScore, clusters: int) -> Start:
    """Background and up to `clusters` - 1 movers of every pair; `batch.initial_motion` is one more guess, not trusted blindly."""
    shape_matches = shape_association(PairView.of(batch), scales)
    motions = batch.initial_motion[:, None].repeat(1, clusters, 1)
    active = torch.zeros(motions.shape[:2], dtype=torch.bool, device=motions.device)
    active[:, 0] = True
    tangents = torch.zeros_like(batch.target)
    for b in range(len(batch)):
        n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
        if min(n, m) < FEWEST_POINTS:
            continue
        source = Surface.of(batch.source[b, :n], batch.range_noise[b], bool(batch.source_closed[b]))
        target = Surface.of(batch.target[b, :m], batch.range_noise[b], bool(batch.target_closed[b]))
        found = start_pair(source, target, batch.initial_motion[b], shape_matches[b, :n], float(batch.dt[b]), score, clusters - 1)
        motions[b, : len(found)], active[b, : len(found)] = found, True
        tangents[b, :m] = target.tangent
    return Start(motions, active, nearest_association(batch, motions, active), tangents)


def start_pair(
    source: Surface, target: Surface, guess: Tensor, match: Tensor, dt: float, score: HypothesisScore, most: int
) -> Tensor:
    """(1 + G, 3) motions of one pair's background and movers. guess: (3,); match: (P,) shape associations, -1 none."""
    matched = match >= 0
    unit = unit_length(source, target)
    ransac = ransac_motions(source.points[matched], target.points[match[matched]], 3 * unit, RANSAC_STARTS)
    background = background_pool(source, target, guess, ransac)[0]
    return torch.cat([background[None], find_movers(source, target, background, dt, score, most=most).motions])


def nearest_association(batch: ScanPairBatch, motions: Tensor, active: Tensor, gate: float = 3.0) -> Tensor:
    """(B, N) target point that comes nearest under any active motion, -1 beyond `gate` units of footprint and noise."""
    moved = se2.apply(motions, batch.source[:, None])  # (B, C, N, 2)
    distance = candidates.squared_distances(moved, batch.target, batch.target_mask)  # (B, C, N, M)
    nearest, index = distance.masked_fill(~active[:, :, None, None], torch.inf).amin(1).min(-1)
    footprint = torch.linalg.vector_norm(batch.source, dim=-1) * FOOTPRINT
    unit = footprint / 2 + 2 * batch.range_noise[:, None]
    return index.masked_fill((nearest.sqrt() > gate * unit) | ~batch.source_mask, -1)
