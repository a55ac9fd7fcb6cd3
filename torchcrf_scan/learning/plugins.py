"""Plug-ins of learning: motions and labels treated as observed, as accurate as those met in use (A-11, A-28)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features.potentials import resolution
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.pseudo_likelihood import PlugIns, true_plugins
from torchcrf_scan.inference.start import Start, beyond_reach
from torchcrf_scan.learning.settings import LearningConfig

TRAVEL_SHARE, LEAST_GAP = 0.15, 0.05  # tolerance of a motion: a share of the travel, and metres on top of twice the noise


def training_plugins(batch: ScanPairBatch, start: Start, config: LearningConfig, generator: torch.Generator) -> PlugIns:
    """True motions with noise for some pairs, InitialiseRT's for the others; spare slots hold its spurious movers (spec 2.5, 6.2).

    A found motion replaces a true one if it moves that cluster's points nearly alike. Labels are the annotated ones, and reaches
    those of the true points: with those of the found segments the fitted model finds fewer movers.
    """
    truth = true_plugins(batch, start.motions.shape[1])
    noise = torch.randn(truth.motions.shape, generator=generator, dtype=torch.float64).to(truth.motions)
    noise = noise * noise.new_tensor([config.rotation_noise, config.translation_noise, config.translation_noise])
    noisy = truth.motions + noise
    use_start = torch.rand(len(batch), generator=generator) < config.start_share
    stands_for = match_start(batch, start, truth)  # (B, C true, C found) bool
    found = torch.einsum("bgk,bkc->bgc", stands_for.to(noisy), start.motions)
    take = stands_for.any(-1) & use_start.to(noisy.device)[:, None]
    motions = torch.where(take[..., None], found, noisy)
    return fill_spare_slots(replace(truth, motions=motions), batch, start, stands_for)


def match_start(batch: ScanPairBatch, start: Start, truth: PlugIns) -> Tensor:
    """(B, C, C') whether found motion k' matches true cluster k: at most one each, within `matching_tolerance`."""
    clusters = torch.arange(truth.motions.shape[1], device=truth.label.device)
    members = (truth.label[:, None] == clusters[:, None]).to(batch.source)  # (B, C, N)
    share = members / members.sum(-1, keepdim=True).clamp(min=1)
    true_points = se2.apply(truth.motions, batch.source[:, None])  # (B, C, N, 2)
    found_points = se2.apply(start.motions, batch.source[:, None])
    offset = torch.linalg.vector_norm(true_points[:, :, None] - found_points[:, None], dim=-1)  # (B, C, C', N)
    error = (offset * share[:, :, None]).sum(-1)  # (B, C, C')
    travel = (torch.linalg.vector_norm(true_points - true_points[:, :1], dim=-1) * share).sum(-1)  # (B, C)
    error = error.masked_fill(~(truth.active & (members.sum(-1) > 0))[:, :, None] | ~start.active[:, None], torch.inf)
    best = error == error.amin(-1, keepdim=True)
    both = best & (error == error.amin(1, keepdim=True))
    return both & (error < matching_tolerance(batch, travel)[..., None])


def matching_tolerance(batch: ScanPairBatch, travel: Tensor) -> Tensor:
    """(B, C) metres up to which a motion matches that of a cluster which travels so far (B, C)."""
    return torch.maximum(TRAVEL_SHARE * travel, 2 * batch.range_noise[:, None] + LEAST_GAP)


def fill_spare_slots(plugins: PlugIns, batch: ScanPairBatch, start: Start, stands_for: Tensor) -> PlugIns:
    """Fills empty slots with unmatched found movers, so that the weights learn to ignore such."""
    spurious = start.active & ~stands_for.any(1)
    spurious[:, 0] = False  # a wrong background is not a mover
    motions, active = plugins.motions.clone(), plugins.active.clone()
    reach = reach_of_truth(plugins, batch)
    for b in range(len(motions)):
        free, extra = (~active[b]).nonzero()[:, 0], spurious[b].nonzero()[:, 0]
        many = min(len(free), len(extra))
        motions[b, free[:many]], active[b, free[:many]] = start.motions[b, extra[:many]], True
        if start.reach is not None:
            reach[b][:, free[:many]] = start.reach[b][:, extra[:many]]
    return replace(plugins, motions=motions, active=active, reach=None if start.reach is None else reach)


def reach_of_truth(plugins: PlugIns, batch: ScanPairBatch) -> Tensor:
    """(B, N, C) `beyond_reach` of the true points of every cluster."""
    clusters = torch.arange(plugins.motions.shape[1], device=plugins.label.device)
    return beyond_reach(batch.source, plugins.label[:, None] == clusters[:, None], resolution(batch))


def mix_associations(plugins: PlugIns, predicted: Tensor, share: float, generator: torch.Generator) -> PlugIns:
    """Predicted (B, N) associations for a share of the pairs: with the true ones C3 and C4 separate perfectly (A-28)."""
    chosen = torch.rand(len(predicted), generator=generator).to(predicted.device) < share
    return replace(plugins, association=torch.where(chosen[:, None], predicted, plugins.association))
