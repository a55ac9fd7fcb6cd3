"""Features of the lattice: association and clustering joined into super-nodes (j, k), spec 7.7.

A super-node's states are pairs of an association state j (K candidates, the outlier last: A = K + 1) and a cluster k (C clusters,
the outlier last: D = C + 1). The named weights are those of two chains, but without plug-ins: features use their own j and k.
Transitions (j, k) -> (j', k') are never formed as an A D x A D table. They are A(j, j') + C(k, k') and, for stiffness and
elongation, a third term of both labels, which depends on k and k' only by the kind of transition: same inlier cluster, two
different ones, or the outlier.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcrf_scan.features import association, clustering
from torchcrf_scan.features.extension import association_extension, clustering_extension
from torchcrf_scan.features.free_space import FreeSpace, look
from torchcrf_scan.features.learned import LearnedInputs, add_log, association_extra, clustering_extra
from torchcrf_scan.features.potentials import AssociationStates, Boosters, PairView, outlier_margin, state_mask, unary_at
from torchcrf_scan.features.scales import Scales, robust_square
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.names import (
    ASSOCIATION_UNARY,
    ASSOCIATION_WEIGHTS,
    BOOSTING,
    CLUSTERING_UNARY,
    CLUSTERING_WEIGHTS,
    ELASTIC,
    LOCAL_CHANNELS,
    STATIC_CHANNELS,
)

# Positions of the features' weights in the joined vector, association before clustering.
FIRST_CLUSTERING = len(ASSOCIATION_WEIGHTS)
FIRST_EDGE = FIRST_CLUSTERING + CLUSTERING_UNARY
_DATA_BOOSTING, _OUTLIER_BOOSTING = (ASSOCIATION_WEIGHTS.index(name) for name in BOOSTING)
STATIC_WEIGHTS = (*range(STATIC_CHANNELS), _OUTLIER_BOOSTING)
MOVING_WEIGHTS = (
    *(*range(STATIC_CHANNELS, len(LOCAL_CHANNELS)), _DATA_BOOSTING),
    *range(_OUTLIER_BOOSTING + 1, ASSOCIATION_UNARY),  # the association's extension
    *range(FIRST_CLUSTERING, FIRST_EDGE),
)
ASSOCIATION_PAIRWISE = slice(ASSOCIATION_UNARY, FIRST_CLUSTERING)
CLUSTER_PAIRWISE = slice(FIRST_EDGE, None)
_FIRST_ELASTIC = FIRST_CLUSTERING + CLUSTERING_WEIGHTS.index(ELASTIC[0])
ELASTIC_WEIGHTS = slice(_FIRST_ELASTIC, _FIRST_ELASTIC + len(ELASTIC))  # Q4..Q6, also among CLUSTER_PAIRWISE

SAME, DIFFERENT, TOUCHING = range(3)  # kinds of cluster transitions: one inlier cluster, two, the outlier at an end
ELASTIC_KINDS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))  # Q4..Q6 by kind


def transition_kinds(clusters: int, device: torch.device | None = None) -> Tensor:
    """(D, D) kind of every cluster transition; D = `clusters`, the outlier last."""
    kinds = torch.full((clusters, clusters), DIFFERENT, device=device)
    kinds.fill_diagonal_(SAME)
    kinds[-1], kinds[:, -1] = TOUCHING, TOUCHING
    return kinds


@dataclass(frozen=True, slots=True)
class LatticePotentials:
    """Log potentials of a chain of super-nodes, factored.

    Attributes:
        log_unary: (B, N, A, D).
        log_association: (B, N-1, A, A, 3) association transitions, by the kind of cluster transition that goes with them.
        log_cluster: (B, N-1, D, D) cluster transitions.
    """

    log_unary: Tensor
    log_association: Tensor
    log_cluster: Tensor

    def double(self) -> LatticePotentials:
        """The same in float64."""
        return LatticePotentials(self.log_unary.double(), self.log_association.double(), self.log_cluster.double())

    def cut(self, known: Tensor) -> LatticePotentials:
        """Unknown nodes (False in known: (B, N)) become padding, without their edges."""
        edge = (known[:, 1:] & known[:, :-1])[..., None, None]
        none = torch.zeros((), dtype=self.log_unary.dtype, device=known.device)
        return LatticePotentials(
            torch.where(known[..., None, None], self.log_unary, none),
            torch.where(edge[..., None], self.log_association, none),
            torch.where(edge, self.log_cluster, none),
        )


@dataclass(frozen=True, slots=True)
class LatticeFeatures:
    """Features of super-nodes and their transitions.

    Attributes:
        static: (B, N, A, 12) features of j alone: L1..L11 and the outlier booster's margin.
        moving: (B, N, A, D, 20) registered translation, the data booster's margin, the association's extension, C1..C4, the
            clustering's extension.
        pairwise_association: (B, N-1, A, A, 4) P1..P4.
        elastic: (B, N-1, A, A, 3) Q4..Q6 of two candidates, for the kinds of cluster transitions to which they apply.
        pairwise_cluster: (B, N-1, D, D, 8) Q1..Q8, without Q4..Q6.
        mask: (B, N, A, D) possible states.
    """

    static: Tensor
    moving: Tensor
    pairwise_association: Tensor
    elastic: Tensor
    pairwise_cluster: Tensor
    mask: Tensor

    def potentials(self, weights: Tensor) -> LatticePotentials:
        """Log potentials. weights: (44,), association before clustering."""
        log_unary = (self.static @ weights[list(STATIC_WEIGHTS)])[..., None] + self.moving @ weights[list(MOVING_WEIGHTS)]
        by_kind = weights[ELASTIC_WEIGHTS, None] * weights.new_tensor(ELASTIC_KINDS)  # (3 features, 3 kinds)
        log_association = (self.pairwise_association @ weights[ASSOCIATION_PAIRWISE])[..., None] + self.elastic @ by_kind
        log_cluster = self.pairwise_cluster @ weights[CLUSTER_PAIRWISE]
        found = (log_unary.masked_fill(~self.mask, -torch.inf), log_association, log_cluster)
        return LatticePotentials(*(value.to(self.static) for value in found))  # autocast ends here, as with two chains


def lattice_features(
    view: PairView,
    states: AssociationStates,
    motions: Tensor,
    nearest: Tensor,
    possible: Tensor,
    scales: Scales,
    boosters: Boosters,
    reach: Tensor | None = None,
    found: AssociationStates | None = None,
) -> LatticeFeatures:
    """Features of every super-node, its point moved by its own cluster's motion.

    A point in the outlier cluster has no motion: its registered channel is the best over the possible clusters, candidate by
    candidate (A-12), and so are the inputs of the outlier booster, whose margin therefore does not depend on k. C2 takes the
    nearest target point under the possible motions. Needs B N K^2 and B N K D; dense candidates are for small scans.

    Args:
        states: candidates (B, N, K) with their static features. motions: (B, C, 3).
        nearest: (B, N, C) nearest target point under every motion. possible: (B, N, D) clusters that are not ruled out.
        reach: (B, N, C) as in `features.potentials.contradictions`.
        found: the states that inference would find, for the inputs of the outlier booster; None: `states`.
    """
    batch = view.batch
    nobody = torch.full_like(nearest[..., 0], -1)
    at = clustering.correspond(batch.source, batch.target, motions, nearest, nobody)
    partner, distance, registered, best = registered_under_all(at.moved, batch.target, states.candidates, possible, scales)
    margin = None
    if found is not None:
        of_found = registered_under_all(at.moved, batch.target, found.candidates, possible, scales)
        margin = outlier_margin(found, of_found[-1], boosters)
    registered = torch.cat([registered, best[..., None]], dim=-1)  # (B, N, K, D)
    of_association, of_cluster = extension_channels(view, states, at, distance, motions, possible, scales, reach)
    residual = at.residual.masked_fill(~possible[..., :-1], torch.inf).amin(-1)
    scans = batch.source, batch.target
    return LatticeFeatures(
        static=unary_at(states, best, scales, boosters, margin)[..., list(STATIC_WEIGHTS)],
        moving=torch.cat(
            [
                registered_channels(registered, states.static_margin, scales, boosters),
                of_association,
                cluster_channels(robust_square(distance, scales.cluster_distance), residual > scales.outlier_threshold),
                of_cluster,
            ],
            dim=-1,
        ),
        pairwise_association=association.pairwise_features(*scans, states.candidates, scales, has_lengths=view.has_lengths),
        elastic=elastic_features(batch.source, partner, scales),
        pairwise_cluster=clustering.pairwise_features(batch.source, at, scales),
        mask=state_mask(states.mask)[..., None] & possible[:, :, None],
    )


def registered_under_all(
    moved: Tensor, target: Tensor, candidates: Tensor, possible: Tensor, scales: Scales
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Candidates under every motion: points (B, N, K, 2), distances and L12 (B, N, K, C), the best L12 of a possible one (B, N, K).

    moved: (B, N, C, 2) source points.
    """
    partner = gather_points(target, candidates)
    distance = torch.linalg.vector_norm(moved[:, :, None] - partner[..., None, :], dim=-1)
    registered = robust_square(distance, scales.local[STATIC_CHANNELS])
    return partner, distance, registered, registered.masked_fill(~possible[:, :, None, :-1], -torch.inf).amax(-1)


def lattice_extra(learned: LearnedInputs | None, candidates: Tensor, clusters: int) -> Tensor | None:
    """Learned log potentials that broadcast to (B, N, A, D); None without learned inputs. candidates: (B, N, K); clusters: D."""
    of_association, of_cluster = association_extra(learned, candidates), clustering_extra(learned, clusters)
    by_association = None if of_association is None else of_association[..., None]
    by_cluster = None if of_cluster is None else of_cluster[:, :, None]
    return by_cluster if by_association is None else add_log(by_association, by_cluster)


def registered_channels(registered: Tensor, static_margin: Tensor, scales: Scales, boosters: Boosters) -> Tensor:
    """L12 and the data booster's margin, (B, N, A, D, 2). registered: (B, N, K, D); static_margin: (B, N, K)."""
    margin = static_margin[..., None] + boosters.data.margins(registered[..., None], first=STATIC_CHANNELS)
    outlier = torch.stack([scales.local_outlier[STATIC_CHANNELS], torch.zeros_like(scales.local_outlier[0])])
    B, N, _, D = registered.shape
    return torch.cat([torch.stack([registered, margin], dim=-1), outlier.to(registered).expand(B, N, 1, D, 2)], dim=2)


def cluster_channels(distance: Tensor, unexplained: Tensor) -> Tensor:
    """C1..C4, (B, N, A, D, 4). distance: (B, N, K, C) of inlier states; unexplained: (B, N) no motion is near a target point.

    In the training truth a point is an outlier of both labels or of none, so C3 and C4 alone separate it (A-28): only the prior
    bounds their weights.
    """
    B, N, K, C = distance.shape
    both_inliers = pad(torch.ones_like(distance), (0, 1, 0, 1))
    outlier_cluster = pad(unexplained.to(distance)[:, :, None, None].expand(B, N, K + 1, 1), (C, 0))
    both_outliers = pad(distance.new_ones(B, N, 1, 1), (C, 0, K, 0))
    return torch.stack([pad(distance, (0, 1, 0, 1)), outlier_cluster, both_inliers, both_outliers], dim=-1)


def extension_channels(
    view: PairView,
    states: AssociationStates,
    at: clustering.Correspondence,
    distance: Tensor,
    motions: Tensor,
    possible: Tensor,
    scales: Scales,
    reach: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Both chains' extensions of every super-node, (B, N, A, D, 5) and (B, N, A, D, 9).

    A point in the outlier cluster is evaluated under the background's motion. An outlier of the association is compared with the
    nearest target point. at: the points without associations; distance: (B, N, K, C).
    """
    K, C = distance.shape[2:]
    ahead = look(view.target_sweep, at.moved)
    best = distance.masked_fill(~possible[:, :, None, :-1], torch.inf).amin(-1, keepdim=True)
    chains = []
    for c in range(C + 1):
        sight = FreeSpace(ahead.seen_through[..., c % C], ahead.hidden[..., c % C])
        of_cluster = torch.cat([distance, best], dim=-1)[..., c]
        chains.append(association_extension(of_cluster, states.mask, sight, scales))
    partner = gather_points(view.batch.target, states.candidates)  # (B, N, K, 2)
    carried_back = se2.apply(se2.inverse(motions), partner.flatten(1, 2)[:, None]).transpose(1, 2)  # (B, NK, C, 2)
    back = look(view.source_sweep, carried_back)
    clusters = []
    for j in range(K + 1):
        row = slice(j % K, None, K)  # candidate j of every point
        seen = FreeSpace(back.seen_through[:, row], back.hidden[:, row])
        is_inlier = torch.full_like(at.is_inlier, j < K)
        residual = distance[:, :, j] if j < K else at.residual
        clusters.append(clustering_extension(residual, ahead, seen, is_inlier, reach if view.reach == "soft" else None, scales))
    return torch.stack(chains, dim=3), torch.stack(clusters, dim=2)


def elastic_features(source_points: Tensor, partner: Tensor, scales: Scales) -> Tensor:
    """Q4..Q6 from the candidates' own distance, (B, N-1, A, A, 3); 0 at the outlier. partner: (B, N, K, 2) candidates."""
    d1 = torch.linalg.vector_norm(source_points[:, 1:] - source_points[:, :-1], dim=-1)
    d2 = torch.linalg.vector_norm(partner[:, 1:, None] - partner[:, :-1, :, None], dim=-1)  # (B, N-1, K, K)
    stiff, elongation = clustering.elasticity(d2 - d1[..., None, None], scales)
    return pad(torch.stack([stiff, 1 - stiff, elongation], dim=-1), (0, 0, 0, 1, 0, 1))
