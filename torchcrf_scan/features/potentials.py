"""From features to potentials: the prepared batch of both chains, and the modules fitted for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, Self, TypeVar, cast

import torch
from torch import Tensor, nn

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import association, candidates, clustering
from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.features.candidates import Candidates
from torchcrf_scan.features.extension import association_extension, clustering_extension
from torchcrf_scan.features.free_space import Sweep, look
from torchcrf_scan.features.learned import LearnedInputs, add_log
from torchcrf_scan.features.limit import SOFTNESS, Limit
from torchcrf_scan.features.scales import Scales, robust_square
from torchcrf_scan.features.shape import ShapeDescriptors, describe, local_spacing
from torchcrf_scan.geometry import se2
from torchcrf_scan.names import ASSOCIATION_UNARY, CLUSTERING_UNARY, LOCAL_CHANNELS, STATIC_CHANNELS

LARGEST_BLOCK = 500_000  # pairs of points compared in shape at once
OUTLIER_INPUTS = len(LOCAL_CHANNELS) + 2
REFERENCE_UNIT = 0.1  # metres; the resolution of a street scanner, so that scales keep their usual size in the unit `spacing`


class Boosters(nn.Module):
    """The two boosted features: `data` scores a pair of points, `outlier` a source point (spec 2.2, 2.3)."""

    def __init__(self, stumps: int = 50, *, width: float = 0.0, is_learned: bool = False) -> None:
        """width, is_learned: as in `StumpEnsemble`."""
        super().__init__()
        self.data = StumpEnsemble(len(LOCAL_CHANNELS), stumps, width=width, is_learned=is_learned)
        self.outlier = StumpEnsemble(OUTLIER_INPUTS, stumps, width=width, is_learned=is_learned)


class WithLengths(Protocol):
    """What can be given in another unit of length: a start, a prediction."""

    def scaled(self, factor: Tensor) -> Self:
        """The same with its lengths times a factor (B,)."""


Given = TypeVar("Given", bound=WithLengths | Tensor)


@dataclass(frozen=True, slots=True)
class PairView:
    """A batch and the descriptors of its scans: quantities independent of motions and candidates.

    Attributes:
        batch: the pairs in the features' unit of length.
        factor: (B,) that unit's factor on metres.
        source_sweep, target_sweep: the scans in polar coordinates about their sensors.
        learned: embeddings and extra log potentials; None: none.
        reach: as in `FeatureConfig`. has_lengths: whether the model has the association chain's features P3 and P4.
        limit: distance of outliers; None: as learned.
    """

    batch: ScanPairBatch
    source_shape: ShapeDescriptors
    target_shape: ShapeDescriptors
    factor: Tensor
    source_sweep: Sweep
    target_sweep: Sweep
    learned: LearnedInputs | None = None
    reach: str = "hard"
    has_lengths: bool = True
    limit: Limit | None = None

    @classmethod
    def of(
        cls,
        batch: ScanPairBatch,
        wrap_closed: bool = True,
        length_unit: str = "metre",
        learned: LearnedInputs | None = None,
        reach: str = "hard",
        has_lengths: bool = True,
        outlier_distance: float | Tensor | None = None,
    ) -> PairView:
        """Computes the descriptors of both scans.

        Args:
            wrap_closed: neighbours wrap on a closed scan (A-06); off, they clamp as in the paper.
            length_unit: `metre`, or `spacing`: lengths relative to the resolution of the pair's scans.
            learned, reach, has_lengths: see above.
            outlier_distance: metres, as in `InferenceConfig`.
        """
        factor = torch.ones_like(batch.dt) if length_unit == "metre" else REFERENCE_UNIT / resolution(batch)
        limit = None
        if outlier_distance is not None:
            limit = Limit(outlier_distance * factor, SOFTNESS * resolution(batch) * factor)
        batch = batch.scaled(factor)
        both = batch.source_closed, batch.target_closed
        source_closed, target_closed = both if wrap_closed else (torch.zeros_like(closed) for closed in both)
        here = torch.zeros_like(batch.target_origin)
        return cls(
            batch,
            describe(batch.source, batch.source_mask, source_closed),
            describe(batch.target, batch.target_mask, target_closed),
            factor,
            Sweep.of(batch.source, batch.source_mask, source_closed, batch.range_noise, here),
            Sweep.of(batch.target, batch.target_mask, target_closed, batch.range_noise, batch.target_origin),
            learned,
            reach,
            has_lengths,
            limit,
        )

    def within(self, reach: Tensor | None) -> Tensor | None:
        """(B, N, C) clusters that a point may be in, from `Start.reach`; None: all, unless `reach` is `hard`."""
        return reach <= 0 if reach is not None and self.reach == "hard" else None

    def in_unit(self, given: Given) -> Given:
        """A start, or motions (B, ..., 3), from metres to the features' unit of length."""
        return _scaled(given, self.factor)

    def in_metres(self, found: Given) -> Given:
        """A start, a prediction, or motions (B, ..., 3), from the features' unit of length to metres."""
        return _scaled(found, 1 / self.factor)


def _scaled(given: Given, factor: Tensor) -> Given:
    return cast(Given, scale_motions(given, factor) if isinstance(given, Tensor) else given.scaled(factor))


@torch.no_grad()
def resolution(batch: ScanPairBatch) -> Tensor:
    """(B,) metres: half the usual spacing of a pair's points plus twice their noise, the size of an ordinary registration error."""
    spacing = []
    for points, mask in ((batch.source, batch.source_mask), (batch.target, batch.target_mask)):
        open_ended = torch.zeros_like(batch.source_closed)
        spacing.append(local_spacing(describe(points, mask, open_ended), mask).masked_fill(~mask, torch.nan))
    usual = torch.cat(spacing, dim=1).nanmedian(-1).values.nan_to_num(nan=0.1)
    return usual / 2 + 2 * batch.range_noise


@dataclass(frozen=True, slots=True)
class AssociationStates:
    """The inlier states of some source points and the part of their features that does not depend on the motions.

    Attributes:
        candidates, mask: (B, N, K) target points and which of them are real.
        static: (B, N, K, 11) channels L1..L11.
        static_margin: (B, N, K) data booster over them (spec 2.5.4), and the learned similarity's share in the data score.
    """

    candidates: Tensor
    mask: Tensor
    static: Tensor
    static_margin: Tensor

    @classmethod
    def of(cls, view: PairView, candidates: Tensor, mask: Tensor, scales: Scales, boosters: Boosters) -> AssociationStates:
        """Gathers the candidates' features. candidates, mask: (B, N, K)."""
        batch = view.batch
        shape = association.shape_features(view.source_shape, view.target_shape, candidates, scales)
        position = association.position_features(batch.source, batch.target, candidates, batch.initial_motion, scales)
        static = torch.cat([shape, position], dim=-1)
        margin = boosters.data.margins(static)
        if view.learned is not None and view.learned.embeddings is not None:
            margin = margin + view.learned.embeddings.data_score(candidates)
        return cls(candidates, mask, static, margin)

    def with_targets(self, targets: AssociationStates, put: Tensor) -> AssociationStates:
        """The states with the only one of `targets` in place of those where put (B, N, K) is True."""
        return AssociationStates(
            torch.where(put, targets.candidates, self.candidates),
            self.mask | put,
            torch.where(put[..., None], targets.static, self.static),
            torch.where(put, targets.static_margin, self.static_margin),
        )

    def nodes(self, part: slice) -> AssociationStates:
        """The states of a slice of source points."""
        return AssociationStates(self.candidates[:, part], self.mask[:, part], self.static[:, part], self.static_margin[:, part])


def registered_points(source_points: Tensor, motions: Tensor, active: Tensor, log_cluster: Tensor) -> Tensor:
    """(B, N, 2) source points under their best active inlier clusters (A-12); log_cluster: (B, N, D), the outlier last."""
    best = log_cluster[..., :-1].masked_fill(~active[:, None], -torch.inf).argmax(-1)  # (B, N)
    motion = motions.gather(1, best[..., None].expand(-1, -1, 3))  # (B, N, 3)
    return se2.apply(motion, source_points[:, :, None])[:, :, 0]


def association_unary(
    view: PairView,
    states: AssociationStates,
    moved: Tensor,
    scales: Scales,
    boosters: Boosters,
    found: AssociationStates | None = None,
) -> Tensor:
    """Features of every state, the outlier last: 12 channels, data and outlier boosting (spec 2.4, 5.1), the extensions.

    Args:
        moved: (B, N, 2) source points under their own motion.
        found: the states that inference would find, for the inputs of the outlier booster; None: `states`.

    Returns:
        (B, N, K+1, 19).
    """
    target = view.batch.target
    distance = association.registered_distance(moved, target, states.candidates)
    registered = robust_square(distance, scales.local[STATIC_CHANNELS])
    margin = None
    if found is not None:
        margin = outlier_margin(found, association.registered_feature(moved, target, found.candidates, scales), boosters)
    extension = association_extension(distance, states.mask, look(view.target_sweep, moved), scales)
    return torch.cat([unary_at(states, registered, scales, boosters, margin), extension], dim=-1)


def local_channels(states: AssociationStates, registered: Tensor, boosters: Boosters) -> tuple[Tensor, Tensor]:
    """(B, N, K, 12) channels and (B, N, K) data booster's margin of the candidates. registered: (B, N, K)."""
    registered = registered[..., None]
    margin = states.static_margin + boosters.data.margins(registered, first=STATIC_CHANNELS)
    return torch.cat([states.static, registered], dim=-1), margin


def outlier_margin(states: AssociationStates, registered: Tensor, boosters: Boosters) -> Tensor:
    """(B, N) the outlier booster's margin over the candidates. registered: (B, N, K)."""
    local, margin = local_channels(states, registered, boosters)
    return boosters.outlier(association.outlier_inputs(local, margin, states.candidates, states.mask))


def unary_at(
    states: AssociationStates, registered: Tensor, scales: Scales, boosters: Boosters, of_outlier: Tensor | None = None
) -> Tensor:
    """The paper's 14 features of `association_unary` from the registered channel (B, N, K) of the candidates.

    of_outlier: (B, N) the outlier booster's margin; None: over these candidates.
    """
    local, margin = local_channels(states, registered, boosters)
    if of_outlier is None:
        of_outlier = boosters.outlier(association.outlier_inputs(local, margin, states.candidates, states.mask))
    inliers = torch.cat([local, margin[..., None], torch.zeros_like(margin)[..., None]], dim=-1)
    B, N = of_outlier.shape
    outlier = torch.cat(
        [scales.local_outlier.expand(B, N, -1), torch.zeros_like(of_outlier)[..., None], of_outlier[..., None]], dim=-1
    )
    return torch.cat([inliers, outlier[:, :, None]], dim=2)


def state_mask(mask: Tensor) -> Tensor:
    """Adds the outlier state, which is always possible. mask: (B, N, K). Returns (B, N, K+1)."""
    return torch.cat([mask, mask.new_ones(*mask.shape[:2], 1)], dim=-1)


def association_potentials(
    unary: Tensor, pairwise: Tensor, mask: Tensor, weights: Tensor, extra: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Log potentials (B, N, K+1) and (B, N-1, K+1, K+1) of the association chain.

    Args:
        unary: (B, N, K+1, 19). pairwise: (B, N-1, K+1, K+1, 4). mask: (B, N, K) real candidates. weights: (23,).
        extra: (B, N, K+1) learned log potentials to add; None: none.
    """
    log_unary = (unary @ weights[:ASSOCIATION_UNARY]).to(unary)  # autocast would carry its precision on through the messages
    log_unary = add_log(log_unary, extra).masked_fill(~state_mask(mask), -torch.inf)
    return log_unary, (pairwise @ weights[ASSOCIATION_UNARY:]).to(pairwise)


def clustering_unary(
    view: PairView, at: clustering.Correspondence, motions: Tensor, active: Tensor, scales: Scales, reach: Tensor | None = None
) -> Tensor:
    """Features of every cluster, the outlier last: C1..C4 (spec 4.1) and the extensions.

    at: the source points under the motions (B, C, 3), of which `active` (B, C) exist. reach: as in `contradictions`. Returns
    (B, N, D, 13).
    """
    return torch.cat([clustering.local_features(at, active, scales), contradictions(view, at, motions, scales, reach)], dim=-1)


def contradictions(
    view: PairView, at: clustering.Correspondence, motions: Tensor, scales: Scales, reach: Tensor | None = None
) -> Tensor:
    """(B, N, D, 9) the clustering chain's extensions, which do not depend on the set of active clusters.

    reach: (B, N, C) of `Start.reach`, a feature if the view's `reach` is `soft`; None: all points are within reach.
    """
    carried_back = se2.apply(se2.inverse(motions), at.partner[:, None]).transpose(1, 2)  # (B, N, C, 2)
    sight = look(view.target_sweep, at.moved), look(view.source_sweep, carried_back)
    return clustering_extension(at.residual, *sight, at.is_inlier, reach if view.reach == "soft" else None, scales)


def possible_clusters(active: Tensor, reach: Tensor | None, points: int) -> Tensor:
    """(B, N, D) states of the clustering chain that are not ruled out; the outlier never is.

    active: (B, C). reach: (B, N, C) bool, clusters within reach of a point, None: all. points: N.
    """
    inliers = active[:, None].expand(-1, points, -1)
    if reach is not None:
        inliers = inliers & reach
    return torch.cat([inliers, inliers.new_ones(*inliers.shape[:2], 1)], dim=-1)


def clustering_potentials(
    local: Tensor, pairwise: Tensor, possible: Tensor, weights: Tensor, extra: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Log potentials (B, N, D) and (B, N-1, D, D) of the clustering chain (spec 7.5: inactive clusters are impossible).

    Args:
        local: (B, N, D, 13). pairwise: (B, N-1, D, D, 8). possible: (B, N, D) bool. weights: (21,).
        extra: (B, N, D) learned log potentials to add; None: none.
    """
    log_unary = (local @ weights[:CLUSTERING_UNARY]).to(local)
    log_unary = add_log(log_unary, extra).masked_fill(~possible, -torch.inf)
    return log_unary, (pairwise @ weights[CLUSTERING_UNARY:]).to(pairwise)


def find_candidates(view: PairView, motions: Tensor, active: Tensor, config: InferenceConfig) -> Candidates:
    """The association chain's inlier states, `config.candidates` of them or all (0), and the nearest target under every motion.

    motions: (B, C, 3), active: (B, C): candidates are the nearest under these (`motion`); otherwise used for `nearest` only.
    """
    batch = view.batch
    near = partial(candidates.by_motion, batch.source, batch.target, batch.target_mask, in_loops=config.backend != "eager")
    if config.candidate_search == "motion" or config.candidates == 0:
        return near(motions, active, config.candidates)
    nearest = near(motions, active, 1).nearest
    if config.candidate_search == "position":
        guess = batch.initial_motion[:, None]
        return replace(near(guess, torch.ones_like(active[:, :1]), config.candidates), nearest=nearest)
    index, mask, _ = most_alike(view, config.candidates)
    return Candidates(index, mask, nearest)


@torch.no_grad()
def shape_score(view: PairView, rows: slice = slice(None)) -> Tensor:
    """(B, n, M) similarity in shape of a slice of source points and all target points: mean of L1..L9 with a street's scales."""
    source = view.source_shape
    some = ShapeDescriptors(source.distance[:, rows], source.geodesic[:, rows], source.angle[:, rows], source.radius[:, rows])
    every, _ = candidates.every_target(some.radius, view.batch.target_mask)
    scales = Scales().to(view.batch.source)
    return association.shape_features(some, view.target_shape, every, scales).mean(-1)


def most_alike(view: PairView, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Index, mask and score (B, N, K) of the `count` target points most similar in shape, a block of source points at a time."""
    N, target_mask = view.batch.source.shape[1], view.batch.target_mask
    size = max(1, LARGEST_BLOCK // max(1, target_mask.numel()))
    blocks = []
    for begin in range(0, max(N, 1), size):
        score = shape_score(view, slice(begin, begin + size))
        index, mask = candidates.by_score(score, target_mask, count)
        blocks.append((index, mask, score.gather(-1, index)))
    index, mask, score = (torch.cat(parts, dim=1) for parts in zip(*blocks, strict=True))
    return index, mask, score
