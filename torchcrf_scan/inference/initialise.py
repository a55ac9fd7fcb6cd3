"""InitialiseRT: where the iterations start (Algorithm 1, line 1). It decides the result, so it is looked for with care.

`survey` looks at the scans: the background by shape-only matching with RANSAC and registrations from a grid of starts, the best by
what it leaves unexplained over the whole scene (`background.py`), and the hypothesised motions of what it does not explain
(`hypotheses.py`). `choose` keeps those that the learned score does not rule out (`movers.py`). No gradient passes through
the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.features.candidates import squared_distances
from torchcrf_scan.features.potentials import PairView, possible_clusters, resolution
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import background_pool, follow, unit_length
from torchcrf_scan.inference.cold import ransac_motions, shape_association
from torchcrf_scan.inference.hypotheses import Hypotheses, hypothesise
from torchcrf_scan.inference.hypothesis_features import hypothesis_features
from torchcrf_scan.inference.movers import HypothesisScore, select
from torchcrf_scan.inference.surface import Surface
from torchcrf_scan.inference.uncertainty import surface_tangents
from torchcrf_scan.tree import tensor_tree

CONSIDERED = 0.1  # probability from which a mover is considered; the score alone accepts from its own threshold
FEWEST_POINTS = 3  # a scan with fewer says nothing of the motion
RANSAC_STARTS = 4
RANSAC_GATE = 3.0  # units of registration error
ASSOCIATION_GATE = 3.0  # units of footprint and noise beyond which a point has no associate
CERTAIN = 1e-6  # probabilities are kept this far from 0 and 1
REACH_EXTENT = 0.5  # of an object's seen extent, and
REACH_UNITS = 4.0  # units of resolution beyond it may still be the object
FOOTPRINT = 0.0175  # radians; spacing of a one-degree scanner on a surface that faces it


@tensor_tree
@dataclass(frozen=True, slots=True)
class Start:
    """Motions to begin with.

    Attributes:
        motions: (B, C, 3), active: (B, C).
        association: (B, N) nearest target point under the best motion, -1 where none comes near.
        target_tangents: (B, M, 2) direction of the target's surface at every point, 0 where it has none.
        reach: (B, N, C) bool, points near enough to the segment that a mover was found by: an object is in one place. None: any.
        log_odds: (B, C) what the score says of every mover, those that it alone would not accept (and that are not `active`)
            included; -inf where there is none, inf for the background. None: `active` has been decided.
    """

    motions: Tensor
    active: Tensor
    association: Tensor
    target_tangents: Tensor
    reach: Tensor | None = None
    log_odds: Tensor | None = None

    @classmethod
    def at(cls, batch: ScanPairBatch, motions: Tensor, active: Tensor) -> Start:
        """The start where somebody else knows the motions; associations and the surfaces' directions follow from them.

        motions: (B, C, 3), active: (B, C). No step depends on a tensor's value.
        """
        tangents, is_found = surface_tangents(batch.target, batch.target_mask, batch.range_noise)
        association = nearest_association(batch, motions, active)
        return cls(motions, active, association, torch.where(is_found[..., None], tangents, torch.zeros_like(tangents)))

    def considered(self) -> Start:
        """The same with all movers that the score does not rule out, for the model to decide about."""
        return self if self.log_odds is None else replace(self, active=self.log_odds > -torch.inf)

    def background_alone(self) -> Start:
        """The start of CRF-Matching, which has one motion."""
        return replace(self, motions=self.motions[:, :1], active=self.active[:, :1], reach=None, log_odds=None)

    def scaled(self, factor: Tensor) -> Start:
        """The same start in another unit of length, a factor (B,) a pair."""
        return replace(self, motions=scale_motions(self.motions, factor))


@dataclass(frozen=True, slots=True)
class Survey:
    """What the scans of one pair say before anything learned is asked; it costs nearly all the time of InitialiseRT.

    Attributes:
        source, target: surfaces of N and M points.
        background: (3,) the background's motion.
        hypotheses: H motions that movers may have. features: (H, F) what `HypothesisScore` judges them by.
    """

    source: Surface
    target: Surface
    background: Tensor
    hypotheses: Hypotheses
    features: Tensor


def initialise(batch: ScanPairBatch, score: HypothesisScore, clusters: int) -> Start:
    """Background and up to `clusters` - 1 movers of every pair; `batch.initial_motion` is one more guess, not trusted blindly."""
    return choose(batch, survey(batch), score, clusters)


@torch.no_grad()
def survey(batch: ScanPairBatch) -> list[Survey | None]:
    """Surfaces, background and hypotheses of every pair; None where a scan has fewer than three points.

    A guess of the background's motion is followed first; only where it explains too little, or there is none, is the motion
    searched for.
    """
    surfaces = [_surfaces(batch, b) for b in range(len(batch))]
    backgrounds = [_follow_guess(pair, guess) for pair, guess in zip(surfaces, batch.initial_motion, strict=True)]
    lost = {b: pair for b, pair in enumerate(surfaces) if pair is not None and backgrounds[b] is None}
    if lost:
        matches = shape_association(PairView.of(batch.select(torch.tensor([*lost])), length_unit="spacing"))
        for (b, scans), match in zip(lost.items(), matches, strict=True):
            backgrounds[b] = find_background(*scans, batch.initial_motion[b], match[: len(scans[0])])
    found: list[Survey | None] = []
    for pair, background, dt in zip(surfaces, backgrounds, batch.dt, strict=True):
        if pair is None or background is None:
            found.append(None)
            continue
        hypotheses = hypothesise(*pair, background, float(dt))
        found.append(Survey(*pair, background, hypotheses, hypothesis_features(hypotheses, *pair, background)))
    return found


def _surfaces(batch: ScanPairBatch, b: int) -> tuple[Surface, Surface] | None:
    """Both scans of pair b; None where one has fewer than three points."""
    n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
    if min(n, m) < FEWEST_POINTS:
        return None
    source = Surface.of(batch.source[b, :n], batch.range_noise[b], bool(batch.source_closed[b]))
    target = Surface.of(batch.target[b, :m], batch.range_noise[b], bool(batch.target_closed[b]), batch.target_origin[b])
    return source, target


def _follow_guess(pair: tuple[Surface, Surface] | None, guess: Tensor) -> Tensor | None:
    """(3,) what a guess (3,) leads to; None without one: the identity says nothing."""
    return follow(guess, *pair) if pair is not None and bool(guess.any()) else None


@torch.no_grad()
def choose(batch: ScanPairBatch, surveys: Sequence[Survey | None], score: HypothesisScore, clusters: int) -> Start:
    """The start from what was surveyed: the background and the up to `clusters` - 1 movers that the score accepts."""
    motions = batch.initial_motion[:, None].repeat(1, clusters, 1)
    active = torch.zeros(motions.shape[:2], dtype=torch.bool, device=motions.device)
    active[:, 0] = True
    log_odds = torch.where(active, torch.inf, -torch.inf).to(motions)
    members = torch.zeros(len(batch), clusters, batch.source.shape[1], dtype=torch.bool, device=motions.device)
    tangents = torch.zeros_like(batch.target)
    for b, seen in enumerate(surveys):
        if seen is None:
            continue
        found = select(seen.hypotheses, score(seen.features), seen.source, seen.target, threshold=CONSIDERED, most=clusters - 1)
        slots = slice(1, 1 + len(found.motions))
        motions[b, 0], motions[b, slots] = seen.background, found.motions
        active[b, slots] = found.probabilities >= score.threshold
        log_odds[b, slots] = found.probabilities.logit(CERTAIN)
        members[b, slots, : len(seen.source)] = found.members
        tangents[b, : len(seen.target)] = seen.target.tangent
    reach = within_reach(batch.source, members, resolution(batch))
    return Start(motions, active, nearest_association(batch, motions, active, reach), tangents, reach, log_odds)


def find_background(source: Surface, target: Surface, guess: Tensor, match: Tensor) -> Tensor:
    """(3,) the background's motion. guess: (3,); match: (P,) shape associations, -1 none."""
    matched = match >= 0
    gate = RANSAC_GATE * unit_length(source, target)
    ransac = ransac_motions(source.points[matched], target.points[match[matched]], gate, RANSAC_STARTS)
    return background_pool(source, target, guess, ransac)[0]


def within_reach(points: Tensor, members: Tensor, unit: Tensor) -> Tensor:
    """Points that may belong to the object some of whose points are known: within half its extent and a few units of them.

    Args:
        points: (B, N, 2). members: (B, C, N) known points of every cluster. unit: (B,) metres.

    Returns:
        (B, N, C); everything is in reach of the background.
    """
    spread = points[:, None].masked_fill(~members[..., None], torch.nan)  # (B, C, N, 2)
    low = spread.nan_to_num(nan=torch.inf).amin(2)
    high = spread.nan_to_num(nan=-torch.inf).amax(2)
    extent = torch.linalg.vector_norm((high - low).clamp(min=0), dim=-1)  # (B, C)
    nearest = torch.stack(
        [squared_distances(points, points, members[:, c]).amin(-1) for c in range(members.shape[1])], dim=-1
    ).sqrt()  # (B, N, C)
    reach = nearest <= (REACH_EXTENT * extent + REACH_UNITS * unit[:, None])[:, None]
    reach[..., 0] = True
    return reach


def nearest_association(
    batch: ScanPairBatch, motions: Tensor, active: Tensor, reach: Tensor | None = None, gate: float = ASSOCIATION_GATE
) -> Tensor:
    """(B, N) target point that comes nearest under any possible motion, -1 beyond `gate` units of footprint and noise."""
    possible = possible_clusters(active, reach, batch.source.shape[1])  # (B, N, D)
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
