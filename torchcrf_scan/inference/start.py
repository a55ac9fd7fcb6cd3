"""The start of the rounds: initial motions of a batch, with associations and directions of the target's surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.features.candidates import squared_distances
from torchcrf_scan.features.potentials import possible_clusters
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.directions import surface_tangents
from torchcrf_scan.tree import tensor_tree

ASSOCIATION_GATE = 3.0  # units of footprint and noise beyond which a point has no associate

REACH_EXTENT = 0.5  # of an object's visible extent, and

REACH_UNITS = 4.0  # units of resolution beyond it may still belong to the object

FARTHEST = 3.0  # reaches; points farther away count as so far, the cap of a robust square

SHORTEST = 1e-9  # metres; least reach

FOOTPRINT = 0.0175  # radians; point spacing of a one-degree scanner on a surface that faces it


@tensor_tree
@dataclass(frozen=True, slots=True)
class Start:
    """Initial motions.

    Attributes:
        motions: (B, C, 3), active: (B, C).
        association: (B, N) nearest target point under the best motion, -1 if none is within the gate.
        target_tangents: (B, M, 2) direction of the target's surface at every point, 0 where undefined.
        reach: (B, N, C) distance of every point from the segment by which a mover was found, see `beyond_reach`: 0 where the point
            may well belong to it, up to `FARTHEST`; of the background 0, but for points of a side that slides. Used as
            `FeatureConfig.reach` says. None: 0 everywhere.
        log_odds: (B, C) score of every mover, including those that the score alone would reject (and that are not `active`);
            -inf for empty slots, inf for the background. None: `active` is final.
    """

    motions: Tensor
    active: Tensor
    association: Tensor
    target_tangents: Tensor
    reach: Tensor | None = None
    log_odds: Tensor | None = None

    @classmethod
    def at(cls, batch: ScanPairBatch, motions: Tensor, active: Tensor) -> Start:
        """The start at given motions; associations and directions of the surfaces follow from them.

        motions: (B, C, 3), active: (B, C). Control flow does not depend on tensor values.
        """
        tangents, is_found = surface_tangents(batch.target, batch.target_mask, batch.range_noise)
        association = nearest_association(batch, motions, active)
        return cls(motions, active, association, torch.where(is_found[..., None], tangents, torch.zeros_like(tangents)))

    def considered(self) -> Start:
        """The same with all movers that the score does not rule out, for the model to select from."""
        return self if self.log_odds is None else replace(self, active=self.log_odds > -torch.inf)

    def background_alone(self) -> Start:
        """The start of CRF-Matching, which has one motion."""
        return replace(self, motions=self.motions[:, :1], active=self.active[:, :1], reach=None, log_odds=None)

    def scaled(self, factor: Tensor) -> Start:
        """The same start in another unit of length; factor: (B,) scale of each pair."""
        return replace(self, motions=scale_motions(self.motions, factor))


def beyond_reach(points: Tensor, members: Tensor, unit: Tensor) -> Tensor:
    """How far points are from an object, given some of its points, less the object's reach: half its extent and a few units.

    Differentiable in the points, at fixed nearest members and away from the cap.

    Args:
        points: (B, N, 2). members: (B, C, N) known points of every cluster. unit: (B,) metres.

    Returns:
        (B, N, C) in reaches, from 0 to `FARTHEST`; 0 for the background.
    """
    spread = points[:, None].masked_fill(~members[..., None], torch.nan)  # (B, C, N, 2)
    low = spread.nan_to_num(nan=torch.inf).amin(2)
    high = spread.nan_to_num(nan=-torch.inf).amax(2)
    extent = torch.linalg.vector_norm((high - low).clamp(min=0), dim=-1)  # (B, C)
    reach = (REACH_EXTENT * extent + REACH_UNITS * unit[:, None]).clamp(min=SHORTEST)[:, None]  # (B, 1, C)
    nearest = torch.stack([squared_distances(points, points, members[:, c]).amin(-1) for c in range(members.shape[1])], dim=-1)
    nearest = nearest.maximum(reach.square()).minimum(((1 + FARTHEST) * reach).square())  # a root has no slope at 0
    beyond = (nearest.sqrt() / reach - 1).clamp(min=0)
    return torch.cat([torch.zeros_like(beyond[..., :1]), beyond[..., 1:]], dim=-1)


def nearest_association(
    batch: ScanPairBatch, motions: Tensor, active: Tensor, reach: Tensor | None = None, gate: float = ASSOCIATION_GATE
) -> Tensor:
    """(B, N) nearest target point under any motion within reach, -1 beyond `gate` units of footprint and noise.

    reach: (B, N, C) of `Start.reach`, of which 0 alone is within; None: all.
    """
    possible = possible_clusters(active, None if reach is None else reach <= 0, batch.source.shape[1])  # (B, N, D)
    nearest = batch.source.new_full(batch.source.shape[:2], torch.inf)
    index = torch.zeros_like(nearest, dtype=torch.int64)
    for c in range(motions.shape[1]):
        moved = se2.apply(motions[:, c], batch.source)
        distance, place = squared_distances(moved, batch.target, batch.target_mask).min(-1)
        nearer = possible[..., c] & (distance < nearest)
        nearest, index = torch.where(nearer, distance, nearest), torch.where(nearer, place, index)
    footprint = torch.linalg.vector_norm(batch.source, dim=-1) * FOOTPRINT
    unit = footprint / 2 + 2 * batch.range_noise[:, None]
    return index.masked_fill((nearest.sqrt() > gate * unit) | ~batch.source_mask, -1)
