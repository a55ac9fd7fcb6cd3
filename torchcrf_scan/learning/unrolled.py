"""The objective `unrolled`: losses on soft read-outs after a fixed number of rounds, at the inferred motions.

    association, cluster   cross-entropy of the true labels under log-beliefs / temperature
    rotation, translation  log(1 + (error / scale)^2) of every true cluster's motion: its angle, and its moved centroid

Gradients pass through messages, the candidates' scores, the steps that fit motions (with soft weights here) and the features
at the new motions. Labels that cannot be predicted are left out: unannotated points, true targets that are no candidate, true
clusters that are impossible at a point, and the points of true movers unmatched by a predicted cluster. Unmatched predicted
movers count as wrong labels. Control flow does not depend on tensor values, so a batch with its start can be compiled or exported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import State
from torchcrf_scan.learning.objectives import Objective, start_of
from torchcrf_scan.learning.plugins import matching_tolerance
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.learning.settings import Config, UnrolledConfig
from torchcrf_scan.model import JointScanCRF

LEAST_LIKENESS = 0.5  # least similarity of a match: half of the points, or a motion just within the tolerance


@dataclass(frozen=True, slots=True)
class Sum:
    """The numerator and denominator of a mean, so that parts of a batch can be combined.

    Attributes:
        total: () sum of losses. count: () number of annotated items, without gradient.
    """

    total: Tensor
    count: Tensor

    def __add__(self, other: Sum) -> Sum:
        return Sum(self.total + other.total, self.count + other.count)

    def times(self, factor: float) -> Sum:
        """The same with its weight multiplied by a factor."""
        return Sum(factor * self.total, factor * self.count)

    @property
    def mean(self) -> Tensor:
        """() the mean; 0 for an empty sum."""
        return self.total / torch.where(self.count > 0, self.count, torch.ones_like(self.count))

    @classmethod
    def over(cls, losses: Tensor, known: Tensor) -> Sum:
        """losses, known: (...)."""
        return cls(torch.where(known, losses, torch.zeros_like(losses)).sum(), known.sum().to(losses))


def make_unrolled(config: Config) -> Objective:
    """The objective: `unrolled_loss` at the starts of the portion."""

    def unrolled(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
        return unrolled_loss(model, portion.batch, config.unrolled, start_of(model, portion))

    return unrolled


def unrolled_loss(
    model: JointScanCRF, batch: ScanPairBatch, config: UnrolledConfig, start: Start | None = None, **layer_inputs: Any
) -> dict[str, Tensor]:
    """The terms `association`, `cluster`, `rotation`, `translation`, means over annotated items, and the weighted `total`: ().

    Args:
        batch: annotated pairs.
        config: overrides the model's rounds, motion weights and `detach_motion`.
        start: initial motions; None: from InitialiseRT.
        layer_inputs: `source_embedding`, `target_embedding`, `extra_log_unary` as in `forward`.
    """
    return mean_terms(unrolled_sums(model, batch, config, start, **layer_inputs), config)


def mean_terms(sums: dict[str, Sum], config: UnrolledConfig) -> dict[str, Tensor]:
    """Means, and their weighted `total`. sums: of a batch, or added up over its parts."""
    terms = {name: of.mean for name, of in sums.items()}
    return terms | {"total": torch.stack([getattr(config, name) * value for name, value in terms.items()]).sum()}


def unrolled_sums(
    model: JointScanCRF, batch: ScanPairBatch, config: UnrolledConfig, start: Start | None = None, **layer_inputs: Any
) -> dict[str, Sum]:
    """The terms of `unrolled_loss` as sums and counts. A chain missing in the model has count 0."""
    if batch.truth is None:
        raise TorchCRFScanError("batch.truth: expected annotated pairs, got a batch without truth")
    start = start or model.initialise(batch)
    weights = round_weights(config)
    learned = model.learned_inputs(batch, start, **layer_inputs)
    done = model.unroll(batch, start, learned, unrolled_settings(model.config, config), len(weights))
    states = [of.state for of in done.rounds]
    slots = match_clusters(done.batch, states[-1], config.temperature)
    found = [
        {
            "association": association_sum(done.batch, state, config).times(float(model.config.has_association)),
            "cluster": cluster_sum(done.batch, state, slots, config).times(float(model.config.has_clusters)),
            **motion_sums(done.batch, state, slots, config),
        }
        for state in states
    ]
    return {name: add([of[name].times(w) for of, w in zip(found, weights, strict=True)]) for name in found[0]}


def add(sums: Sequence[Sum]) -> Sum:
    """Adds several sums."""
    return reduce(Sum.__add__, sums)


def unrolled_settings(model: ModelConfig, config: UnrolledConfig) -> ModelConfig:
    """The model's settings with rounds through which gradients pass."""
    model.require("has_gradient", "for the objective unrolled")
    inference = replace(
        model.inference,
        iterations=config.iterations,
        stop_early=False,
        motion_weights="soft",
        detach_motion=config.detach_motion,
    )
    return replace(model, inference=inference)


def round_weights(config: UnrolledConfig) -> list[float]:
    """Weights of the rounds in the loss, the last one's being 1."""
    if config.deep_supervision == 0:
        return [1.0]
    return [config.deep_supervision**age for age in reversed(range(config.iterations))]


def association_sum(batch: ScanPairBatch, state: State, config: UnrolledConfig) -> Sum:
    """Cross-entropy of the true target, or of the outlier, over the points whose true target is a candidate."""
    truth = _truth_of(batch)
    there = (state.candidates == truth.association[..., None]) & state.candidate_mask  # (B, N, K)
    is_outlier = truth.association < 0
    place = torch.where(is_outlier, there.shape[-1], there.int().argmax(-1))
    known = truth.known & batch.source_mask & (is_outlier | there.any(-1))
    return cross_entropy(state.log_association, place, known, config.temperature)


def cluster_sum(batch: ScanPairBatch, state: State, slots: Tensor, config: UnrolledConfig) -> Sum:
    """Cross-entropy of the slot matched to the true cluster, or of the outlier. slots: (B, G) of `match_clusters`."""
    truth = _truth_of(batch)
    slot = slots.gather(1, truth.cluster.clamp(min=0))  # (B, N)
    label = torch.where(truth.cluster < 0, state.log_cluster.shape[-1] - 1, slot)
    known = truth.known & batch.source_mask & (label >= 0)
    return cross_entropy(state.log_cluster, label.clamp(min=0), known, config.temperature)


def cross_entropy(log_beliefs: Tensor, label: Tensor, known: Tensor, temperature: float) -> Sum:
    """Cross-entropy of the possible labels. log_beliefs: (B, N, S); label: (B, N); known: (B, N)."""
    chosen = soften(log_beliefs, known, temperature).gather(-1, label[..., None])[..., 0]
    known = known & (chosen > -torch.inf)
    return Sum.over(-torch.where(known, chosen, torch.zeros_like(chosen)), known)


def soften(log_beliefs: Tensor, known: Tensor, temperature: float) -> Tensor:
    """(B, N, S) log-beliefs at a read-out temperature; uniform at unannotated points. known: (B, N)."""
    beliefs = torch.where(known[..., None], log_beliefs, torch.zeros_like(log_beliefs))
    return torch.log_softmax(beliefs / temperature, dim=-1)


def motion_sums(batch: ScanPairBatch, state: State, slots: Tensor, config: UnrolledConfig) -> dict[str, Sum]:
    """Robust losses of the motions of true clusters that have points, a known motion and a slot. slots: (B, G)."""
    truth = _truth_of(batch)
    members = members_of(batch)  # (B, G, N)
    known = (slots >= 0) & truth.motions.isfinite().all(-1) & (members.sum(-1) > 0)
    true = truth.motions.nan_to_num()
    found = state.motions.value.gather(1, slots.clamp(min=0)[..., None].expand(-1, -1, 3))  # (B, G, 3)
    centroid = (members @ batch.source / members.sum(-1, keepdim=True).clamp(min=1))[:, :, None]  # (B, G, 1, 2)
    gap = (se2.apply(found, centroid) - se2.apply(true, centroid))[:, :, 0]
    turn = se2.wrap(found[..., 0] - true[..., 0])
    return {
        "rotation": Sum.over(torch.log1p((turn / config.rotation_scale) ** 2), known),
        "translation": Sum.over(torch.log1p((gap**2).sum(-1) / config.translation_scale**2), known),
    }


def members_of(batch: ScanPairBatch) -> Tensor:
    """(B, G, N) 1 for the annotated points of every true cluster, else 0."""
    truth = _truth_of(batch)
    clusters = torch.arange(truth.motions.shape[1], device=truth.cluster.device)
    is_known = truth.known & batch.source_mask
    return ((truth.cluster[:, None] == clusters[:, None]) & is_known[:, None]).to(batch.source)


@torch.no_grad()
def match_clusters(batch: ScanPairBatch, state: State, temperature: float) -> Tensor:
    """(B, G) cluster of the state matched to every true one, -1 none. One to one, the most similar first; 0 is matched to 0.

    The similarity of a predicted mover is its soft share of the true one's points (its belief there) plus the agreement of motions:
    1 / (1 + (error / tolerance)^2) of the moved points. So a mover found by the start remains the label of its points even if
    the present weights assign them to the background.
    """
    motions = state.motions
    members = members_of(batch)  # (B, G, N)
    share = members / members.sum(-1, keepdim=True).clamp(min=1)
    belief = soften(state.log_cluster, batch.source_mask, temperature).exp()[..., :-1]  # (B, N, C)
    alike = share @ belief + closeness(batch, share, motions.value)
    ask = (members.sum(-1) > 0)[..., None] & motions.active[:, None]  # (B, G, C)
    G, C = ask.shape[1:]
    row, column = torch.arange(G, device=ask.device), torch.arange(C, device=ask.device)
    alike = torch.where(ask & (row > 0)[:, None] & (column > 0), alike, 0.0)
    slots = torch.where(row > 0, -1, 0).expand(batch.source.shape[0], G)
    for _ in range(min(G, C) - 1):
        most, place = alike.flatten(1).max(-1)
        is_row, is_column = row == (place // C)[:, None], column == (place % C)[:, None]  # (B, G), (B, C)
        slots = torch.where(is_row & (most >= LEAST_LIKENESS)[:, None], (place % C)[:, None], slots)
        alike = alike.masked_fill(is_row[..., None] | is_column[:, None], 0.0)
    return slots


def closeness(batch: ScanPairBatch, share: Tensor, motions: Tensor) -> Tensor:
    """(B, G, C) agreement of motions with a true cluster's on its points: 1 if equal, 1/2 at `matching_tolerance`.

    share: (B, G, N) of the cluster's points; motions: (B, C, 3). 0 where the true motion is unknown.
    """
    truth = _truth_of(batch)
    true_points = se2.apply(truth.motions.nan_to_num(), batch.source[:, None])  # (B, G, N, 2)
    points = se2.apply(motions, batch.source[:, None])  # (B, C, N, 2)
    error = torch.stack(
        [(torch.linalg.vector_norm(true_points - points[:, c, None], dim=-1) * share).sum(-1) for c in range(motions.shape[1])], -1
    )  # one motion at a time, so that the largest tensor is (B, G, N, 2)
    travel = (torch.linalg.vector_norm(true_points - true_points[:, :1], dim=-1) * share).sum(-1)
    tolerance = matching_tolerance(batch, travel)
    is_known = truth.motions.isfinite().all(-1)
    return torch.where(is_known[..., None], 1 / (1 + (error / tolerance[..., None]) ** 2), 0.0)


def _truth_of(batch: ScanPairBatch) -> Truth:
    assert batch.truth is not None
    return batch.truth
