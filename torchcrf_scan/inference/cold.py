"""Matching by shape alone, when nothing is known of the motion (design finding 2a): an association chain, then RANSAC."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcrf_scan.features import association
from torchcrf_scan.features.potentials import PairView, most_alike, state_mask
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference.messages import chain_beliefs

CANDIDATES = 32
OUTLIER_SCORE = -3.0  # mean channel value below which a place is no better than none
SAMPLES = 256
SEQUENCE, SWITCHING, DISTANCE = 2.0, -1.0, 0.5  # weights of the pairwise features; translation is not invariant


def shape_association(view: PairView) -> Tensor:
    """(B, N) associations, -1 outlier, of a chain that knows shapes and distances along the scan, not positions.

    Nothing in it is learned: in a view in the unit `spacing` the default scales fit any scanner. Unchanged when either scan moves.
    Costs N M for the choice of candidates.
    """
    batch, scales = view.batch, Scales().to(view.batch.source)
    index, mask, score = most_alike(view, CANDIDATES)
    log_unary = torch.cat([score, score.new_full((*score.shape[:2], 1), OUTLIER_SCORE)], dim=-1)
    log_unary = log_unary.masked_fill(~state_mask(mask), -torch.inf)
    pairwise = association.pairwise_features(batch.source, batch.target, index, scales)
    weights = pairwise.new_tensor([SEQUENCE, SWITCHING, DISTANCE, 0.0])
    beliefs = chain_beliefs(log_unary, pairwise @ weights, batch.source_mask)
    best = beliefs.argmax(-1)
    padded = torch.cat([index, torch.full_like(index[..., :1], -1)], dim=-1)
    return padded.gather(-1, best[..., None])[..., 0].masked_fill(~batch.source_mask, -1)


def ransac_motions(source: Tensor, target: Tensor, gate: Tensor, count: int) -> Tensor:
    """The `count` two-point motions that agree with most associations.

    Args:
        source, target: (P, 2) associated points. gate: () metres.

    Returns:
        (count or fewer, 3); none for fewer than two points. The samples are the same for the same P.
    """
    if len(source) < 2:
        return source.new_zeros(0, 3)
    generator = torch.Generator().manual_seed(0)
    pick = torch.randint(len(source), (SAMPLES, 2), generator=generator).to(source.device)
    pairs, partners = source[pick], target[pick]  # (SAMPLES, 2, 2)
    motions = kabsch(pairs, partners, torch.ones_like(pairs[..., 0]))
    agree = torch.linalg.vector_norm(se2.apply(motions, source) - target, dim=-1) < gate  # (SAMPLES, P)
    return motions[agree.sum(-1).topk(min(count, SAMPLES)).indices]
