"""A start with one cluster per point (D = M + 1), as the paper remarks; clusters preferred by no point are discarded (A-19)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.candidates import by_motion
from torchcrf_scan.features.potentials import PairView, possible_clusters, resolution
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.start import Start, beyond_reach
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.names import CLUSTERING_UNARY, PAPERS_CLUSTER
from torchcrf_scan.variants.paper_start import FEWEST, match_cold

PAPERS_UNARY = len(PAPERS_CLUSTER)  # C1..C4; the extensions are not used with so many clusters
EDGES = 16  # edges per block of transition tables: one has D^2 entries of 8 features


@torch.no_grad()
def points_start(view: PairView, found: Start, parameters: Parameters, config: InferenceConfig) -> Start:
    """The C largest remaining clusters of one per point; the largest is the background.

    CRF-Matching's associations from standstill give every point a translation, its motion gives all of them the rotation. One exact
    pass over the clustering chain with that many states then groups points of equal motion. Costs N D^2 = N^3 a pair.
    """
    batch, clusters = view.batch, found.motions.shape[1]
    background, association = match_cold(view, found, parameters, config)
    motions = background[:, None].repeat(1, clusters, 1)
    active = torch.zeros(motions.shape[:2], dtype=torch.bool, device=motions.device)
    active[:, 0] = True
    known = torch.zeros(*active.shape, association.shape[1], dtype=torch.bool, device=motions.device)
    for b in range(len(batch)):
        members = cluster_by_point(view, b, background[b], association[b], parameters)[:clusters]
        if len(members):
            partner = gather_points(batch.target[b : b + 1], association[b : b + 1].clamp(min=0)).expand(len(members), -1, -1)
            motions[b, : len(members)] = kabsch(batch.source[b].expand_as(partner), partner, members.to(batch.source))
            active[b, : len(members)] = True
            known[b, : len(members)] = members
    return Start(motions, active, association, found.target_tangents, beyond_reach(batch.source, known, resolution(batch)))


def cluster_by_point(view: PairView, b: int, background: Tensor, association: Tensor, parameters: Parameters) -> Tensor:
    """(G, N) members of the clusters of four or more associated points in pair b, the largest first.

    background: (3,). association: (N,), -1 outlier.
    """
    batch = view.batch
    source, target = batch.source[b : b + 1], batch.target[b : b + 1]
    partner = gather_points(target, association[None].clamp(min=0))
    shift = partner - se2.rotate(background[0], source)
    motions = torch.cat([background[0].expand(*shift.shape[:2], 1), shift], dim=-1)  # (1, N, 3)
    active = (association >= 0)[None]
    nearest = by_motion(source, target, batch.target_mask[b : b + 1], motions, active, 1).nearest
    at = clustering.correspond(source, target, motions, nearest, association[None])
    local = clustering.local_features(at, active, parameters.scales)
    possible = possible_clusters(active, None, source.shape[1])
    log_unary = (local @ parameters.clustering[:PAPERS_UNARY]).masked_fill(~possible, -torch.inf)
    log_pairwise = edge_potentials(source, at, parameters)
    mask = batch.source_mask[b : b + 1]
    label = chain_beliefs(log_unary, log_pairwise, mask).argmax(-1)[0]  # the outlier's label is not an index of a cluster here
    members = (label == torch.arange(len(association), device=label.device)[:, None]) & (association >= 0)  # (N clusters, N)
    size = members.sum(-1)
    order = size.argsort(descending=True, stable=True)
    return members[order[size[order] >= FEWEST]]


def edge_potentials(source: Tensor, at: clustering.Correspondence, parameters: Parameters) -> Tensor:
    """(1, E, D, D) log potentials of the clustering chain, a few edges at a time."""
    D = at.residual.shape[2] + 1
    parts = [source.new_zeros(1, 0, D, D)]
    for begin in range(0, source.shape[1] - 1, EDGES):
        nodes = slice(begin, begin + EDGES + 1)
        part = clustering.Correspondence(at.moved[:, nodes], at.residual[:, nodes], at.partner[:, nodes], at.is_inlier[:, nodes])
        features = clustering.pairwise_features(source[:, nodes], part, parameters.scales)
        parts.append(features @ parameters.clustering[CLUSTERING_UNARY:])
    return torch.cat(parts, dim=1)
