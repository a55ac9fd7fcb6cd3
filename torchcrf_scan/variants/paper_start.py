"""The start of the paper's configuration (spec 7.3, A-19): the association chain alone, then runs of points with other motions."""

from __future__ import annotations

import copy
from dataclasses import replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features.potentials import PairView, resolution
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.start import Start, beyond_reach
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.pair import array_of
from torchcrf_scan.names import ASSOCIATION_NODE, SHAPE, SHAPE_CHANNELS
from torchcrf_scan.search.cold import ransac_motions

INDEX_GAP = 3  # points
SPATIAL_GAP = 0.75  # as the next one in the unit of the features: metres for the paper, which says `length_unit: metre`
EXPLAINED = 0.3
FEWEST = 4  # points of a run
ROUNDS = 3
COLD_CANDIDATES = 32


@torch.no_grad()
def paper_start(view: PairView, found: Start, parameters: Parameters, config: InferenceConfig) -> Start:
    """CRF-Matching's motion as background, and up to C - 1 movers from the runs of its residuals.

    Args:
        found: any start of C clusters; its association and tangents begin the search, its motions are not used.
    """
    clusters = found.motions.shape[1]
    background, association = match_cold(view, found, parameters, config)
    return movers_from_associations(view, background, association, parameters, clusters, found.target_tangents)


def match_cold(view: PairView, found: Start, parameters: Parameters, config: InferenceConfig) -> tuple[Tensor, Tensor]:
    """Step 1 of spec 7.3: the association chain from standstill (or odometry), and the motion that most associations support.

    By shape alone: position channels would pull the background to standstill, and movers to the background (design finding 2). No
    motion is known at first, so the candidates are the most similar in shape too (finding 5).

    Returns:
        (B, 3) motion of the background and (B, N) associations.
    """
    batch = view.batch
    nothing = torch.full_like(found.association, -1)
    start = Start(batch.initial_motion[:, None], found.active[:, :1], nothing, found.target_tangents)
    search = replace(config, candidate_search="shape", candidates=config.candidates and max(config.candidates, COLD_CANDIDATES))
    shapes = by_shape_alone(parameters)
    for _ in range(ROUNDS):
        association = joint.associate(view, start, torch.zeros_like(nothing), shapes, search)
        start = replace(start, motions=agreed_motion(batch, start.motions, association))
        search = config
    return start.motions[:, 0], association


def by_shape_alone(parameters: Parameters) -> Parameters:
    """The parameters without the association chain's terms that depend on positions: of L1..L12 and of their boosted score only
    the share of L1..L9 is left, of the outlier state its constants; the terms of edges stay.
    """
    weights, boosters = parameters.association.clone(), copy.deepcopy(parameters.boosters)
    weights[[k for k, name in enumerate(ASSOCIATION_NODE) if name not in (*SHAPE, "data_boosting")]] = 0.0
    boosters.data.table[SHAPE_CHANNELS:] = 0.0
    return replace(parameters, association=weights, boosters=boosters)


def agreed_motion(batch: ScanPairBatch, before: Tensor, association: Tensor) -> Tensor:
    """(B, 1, 3) the two-point motion with most inlier associations, refined by Kabsch on those; `before` if there is none."""
    motions = before.clone()
    for b in range(len(batch)):
        index = (association[b] >= 0).nonzero()[:, 0]
        source, partner = batch.source[b, index], batch.target[b, association[b, index]]
        best = torch.from_numpy(ransac_motions(array_of(source), array_of(partner), EXPLAINED, 1)).to(source)
        if len(best):
            agree = torch.linalg.vector_norm(se2.apply(best[0], source) - partner, dim=-1) < EXPLAINED
            motions[b, 0] = kabsch(source, partner, agree.to(source))
    return motions


@torch.no_grad()
def movers_from_associations(
    view: PairView, background: Tensor, association: Tensor, parameters: Parameters, clusters: int, tangents: Tensor
) -> Start:
    """Steps 2 to 4 of spec 7.3. background: (B, 3); association: (B, N), -1 outlier; clusters: C, background included."""
    batch = view.batch
    partner = gather_points(batch.target, association.clamp(min=0))
    residual = torch.linalg.vector_norm(se2.apply(background, batch.source) - partner, dim=-1)
    near = torch.maximum(parameters.scales.outlier_threshold, 3 * parameters.scales.cluster_distance)
    elsewhere = (association >= 0) & (residual > near) & batch.source_mask
    motions = background[:, None].repeat(1, clusters, 1)
    active = torch.zeros(motions.shape[:2], dtype=torch.bool, device=motions.device)
    active[:, 0] = True
    members = torch.zeros(*active.shape, residual.shape[1], dtype=torch.bool, device=motions.device)
    for b in range(len(batch)):
        index = elsewhere[b].nonzero()[:, 0]
        found, runs = (of[: clusters - 1] for of in run_motions(batch.source[b, index], partner[b, index], index))
        motions[b, 1 : 1 + len(found)], active[b, 1 : 1 + len(found)] = found, True
        members[b, 1 : 1 + len(found), index] = runs
    return Start(motions, active, association, tangents, beyond_reach(batch.source, members, resolution(batch)))


def run_motions(source: Tensor, partner: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """(G, 3) motions and (G, P) points of runs of associated points, those that another explains left out, the largest first.

    Args:
        source, partner: (P, 2). index: (P,) ascending point numbers; a run ends at a gap in number or in space.
    """
    if len(source) < FEWEST:
        return source.new_zeros(0, 3), source.new_zeros(0, len(source), dtype=torch.bool)
    apart = (index.diff() > INDEX_GAP) | (torch.linalg.vector_norm(source.diff(dim=0), dim=-1) > SPATIAL_GAP)
    run = torch.cat([apart.new_zeros(1, dtype=torch.int64), apart.long().cumsum(0)])
    members = run == torch.arange(int(run[-1]) + 1, device=run.device)[:, None]  # (R, P)
    members = members[members.sum(-1) >= FEWEST]
    members = members[members.sum(-1).argsort(descending=True, stable=True)]
    kept, runs = [source.new_zeros(0, 3)], [members[:0]]
    while len(members):
        motion = kabsch(source, partner, members[0].to(source))
        error = torch.linalg.vector_norm(se2.apply(motion, source) - partner, dim=-1)
        medians = torch.where(members, error, torch.nan).nanmedian(-1).values
        kept.append(motion[None])
        runs.append(members[:1])
        members = members[1:][medians[1:] > EXPLAINED]
    return torch.cat(kept), torch.cat(runs)
