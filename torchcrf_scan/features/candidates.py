"""Candidate target points of every source point: K of them, or all (spec 7.7)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.candidates import candidates_of
from torchcrf_scan.loops.choice import is_readable
from torchcrf_scan.loops.pair import array_of, padded
from torchcrf_scan.loops.threads import for_each

LARGEST_BLOCK = 2_000_000  # number of distances in memory at once


@dataclass(frozen=True, slots=True)
class Candidates:
    """The inlier states of the association chain, ascending in target index.

    Attributes:
        index: (B, N, K) target points.
        mask: (B, N, K) bool, real candidates (fewer than K where the target scan is short).
        nearest: (B, N, C) nearest target point under every active motion; 0 for inactive ones.
    """

    index: Tensor
    mask: Tensor
    nearest: Tensor


def squared_distances(moved: Tensor, target_points: Tensor, target_mask: Tensor) -> Tensor:
    """(B, ..., M) squared distances, inf to padding; by one matrix product, so accurate to about 1e-7 of the squared scan extent.

    moved: (B, ..., 2); target_points: (B, M, 2); target_mask: (B, M).
    """
    flat = moved.flatten(1, -2)
    far = target_points.square().sum(-1).masked_fill(~target_mask, torch.inf)[:, None]  # (B, 1, M)
    product = torch.baddbmm(far, flat, target_points.mT, alpha=-2)
    return (product + flat.square().sum(-1, keepdim=True)).clamp_(min=0).unflatten(1, moved.shape[1:-1])


def by_motion(
    source_points: Tensor,
    target_points: Tensor,
    target_mask: Tensor,
    motions: Tensor,
    active: Tensor,
    count: int,
    *,
    in_loops: bool = True,
) -> Candidates:
    """The `count` nearest target points under any active motion; all of them when count is 0 (dense).

    Args:
        source_points: (B, N, 2); target_points: (B, M, 2); target_mask: (B, M); motions: (B, C, 3); active: (B, C).
        count: K.
        in_loops: by a search where the values can be read; otherwise from all distances, in time B C N M.
    """
    scans = source_points.detach(), target_points.detach(), target_mask  # a choice of states has no gradient
    if in_loops and target_mask.numel() > 0 and is_readable(*scans, motions, active):
        return _by_search(*scans, motions, active, count)
    return by_distance(*scans, motions, active, count)


def _by_search(
    source_points: Tensor, target_points: Tensor, target_mask: Tensor, motions: Tensor, active: Tensor, count: int
) -> Candidates:
    """`by_motion` pair by pair."""
    B, N, M = *source_points.shape[:2], target_points.shape[1]
    real = target_mask.sum(-1).tolist()
    source, target, by = array_of(source_points), array_of(target_points), array_of(motions)
    found = for_each(
        lambda b: candidates_of(source[b], target[b, : real[b]].copy(), by[b], active[b].numpy().copy(), count), range(B)
    )
    index, mask, nearest = ([of[part] for of in found] for part in range(3))
    K = M if count == 0 or count >= M else count
    every = Candidates(padded(index, (N, K), 0), padded(mask, (N, K), False), torch.from_numpy(np.stack(nearest)))
    return replace(every, index=every_target(source_points, target_mask)[0]) if K == M else every


@torch.no_grad()
def by_distance(
    source_points: Tensor, target_points: Tensor, target_mask: Tensor, motions: Tensor, active: Tensor, count: int
) -> Candidates:
    """`by_motion` from the distances of all points, in tensors alone."""
    if torch.compiler.is_compiling():  # a compiled program serves any number of pairs, so the block size cannot depend on it
        return _by_motion(source_points, target_points, target_mask, motions, active, count)
    size = max(1, LARGEST_BLOCK // max(1, target_mask.numel()))
    blocks = [_by_motion(part, target_points, target_mask, motions, active, count) for part in source_points.split(size, dim=1)]
    return Candidates(*(torch.cat([getattr(block, f.name) for block in blocks], dim=1) for f in fields(Candidates)))


def _by_motion(
    source_points: Tensor, target_points: Tensor, target_mask: Tensor, motions: Tensor, active: Tensor, count: int
) -> Candidates:
    B, C = active.shape
    closest_under = []
    over_motions = source_points.new_full((B, source_points.shape[1], target_points.shape[1]), torch.inf)
    for c in range(C):  # one motion at a time, so that the largest tensor is (B, N, M)
        distance = squared_distances(se2.apply(motions[:, c], source_points), target_points, target_mask)
        closest_under.append(torch.where(active[:, c, None], distance.argmin(-1), 0))
        over_motions = torch.where(active[:, c, None, None], torch.minimum(over_motions, distance), over_motions)
    nearest = torch.stack(closest_under, dim=-1)
    if count == 0 or count >= target_points.shape[1]:
        return Candidates(*every_target(source_points, target_mask), nearest)
    closest, index = over_motions.topk(count, dim=-1, largest=False)
    mask = closest < torch.inf
    order = torch.where(mask, index, target_points.shape[1]).argsort(-1)  # real ones first, ascending
    return Candidates(index.gather(-1, order), mask.gather(-1, order), nearest)


def every_target(source_points: Tensor, target_mask: Tensor) -> tuple[Tensor, Tensor]:
    """Index and mask (B, N, M) of the dense model."""
    shape = (*source_points.shape[:2], target_mask.shape[1])
    return torch.arange(shape[2], device=target_mask.device).expand(shape), target_mask[:, None].expand(shape)


def with_targets(index: Tensor, mask: Tensor, association: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Adds a given target to every point's candidates, replacing the last if it is missing, and returns its position.

    Args:
        index, mask: (B, N, K). association: (B, N), -1 outlier.

    Returns:
        index, mask, and (B, N) the state of that target, K for an outlier.
    """
    K = index.shape[-1]
    is_inlier = association >= 0
    there = (index == association[..., None]) & mask
    missing = is_inlier & ~there.any(-1)
    last = torch.arange(K, device=index.device) == K - 1
    put = missing[..., None] & last
    index = torch.where(put, association[..., None], index)
    mask = mask | put
    place = ((index == association[..., None]) & mask).int().argmax(-1)
    return index, mask, torch.where(is_inlier, place, K)


def by_score(score: Tensor, target_mask: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Index and mask (B, N, K) of the best `count` targets by a (B, N, M) score: used when no motion is known."""
    masked = score.masked_fill(~target_mask[:, None], -torch.inf)
    best, index = masked.topk(min(count, score.shape[-1]), dim=-1)
    mask = best > -torch.inf
    order = torch.where(mask, index, score.shape[-1]).argsort(-1)
    return index.gather(-1, order), mask.gather(-1, order)
