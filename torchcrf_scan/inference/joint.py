"""Algorithm 1 in blocks: exact passes over each chain, motions between them, for a number of rounds (spec 7.2, `sweep`).

    candidates -> clustering chain -> motions -> association chain -> motions -> again, until labels and motions converge

A pair that has converged is frozen, so its result does not depend on the other pairs of the batch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import MOTION_METRICS
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.association import pairwise_features, registered_distance
from torchcrf_scan.features.candidates import Candidates, with_targets
from torchcrf_scan.features.learned import association_extra, clustering_extra
from torchcrf_scan.features.potentials import (
    AssociationStates,
    PairView,
    association_potentials,
    association_unary,
    clustering_potentials,
    clustering_unary,
    find_candidates,
    possible_clusters,
    registered_points,
)
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.motion import Motions, estimate, hard_support, retire_empty, soft_support, trim
from torchcrf_scan.inference.selection import discard_vacuous
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, Round, State
from torchcrf_scan.inference.uncertainty import motion_covariance
from torchcrf_scan.loops.choice import is_readable
from torchcrf_scan.prediction import Prediction

MERGE_ROTATION = 0.01  # radians
SELECTION_ROUNDS = 2  # that begin with the selection of movers
ROBUST_SHARE = 0.3  # of a point's usual residual: errors across a surface are smaller than point-to-point errors


class Update(Protocol):
    """One round's update of both chains: the coupling of the model."""

    def __call__(
        self, view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, model: ModelConfig
    ) -> State:
        """New labels, beliefs and motions. found: the candidates at the state's motions."""


def update_in_turns(
    view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, model: ModelConfig
) -> State:
    """Clustering chain, motions, association chain, motions: each chain is decoded with the other's labels fixed.

    A chain that the model does not have is left out.
    """
    config = model.inference
    if model.has_clusters:
        state = update_clusters(view, start, state, found, parameters, config)
        state = update_motions(view, start, state, parameters, config)
    if model.has_association:
        state = hold_motions(state, config)
        state = update_association(view, state, found, parameters, config)
        state = state if model.has_clusters else inliers_are_background(state)
        state = update_motions(view, start, state, parameters, config, trimmed=not model.has_clusters)
    return state


def decode(
    view: PairView, start: Start, parameters: Parameters, model: ModelConfig, update: Update = update_in_turns
) -> Prediction:
    """Labels and motions of a batch by the sweep schedule; differentiable through beliefs and, where soft, through motions."""
    last = settle(view, start, parameters, model, update)
    return read_out(view.batch, start, last.state, parameters, model.inference, last.converged, last.iterations)


def settle(view: PairView, start: Start, parameters: Parameters, model: ModelConfig, update: Update = update_in_turns) -> Round:
    """State of B pairs after the last round, with clusters of equal motion merged."""
    last = rounds(view, start, parameters, model, update)[-1]
    looks = model.inference.backend != "eager"
    return replace(last, state=merge_alike(view, last.state, parameters.scales.cluster_distance, looks=looks))


def rounds(
    view: PairView, start: Start, parameters: Parameters, model: ModelConfig, update: Update = update_in_turns
) -> list[Round]:
    """The start and every round after it. With `stop_early` off always `iterations` rounds, without data-dependent branches."""
    batch, config = view.batch, model.inference
    is_chosen = config.movers == "threshold" or start.log_odds is None or not model.has_clusters
    start = start if is_chosen else start.considered()
    state = first_state(view, start, config)
    before = state
    converged = torch.zeros_like(batch.source_closed)
    iterations = torch.zeros_like(converged, dtype=torch.int64)
    found = [Round(state, converged, iterations)]
    for done in range(config.iterations):
        if done < SELECTION_ROUNDS and not is_chosen:
            state = discard_vacuous(view, start, state, parameters, config)
        after = step(view, start, state, parameters, model, update)
        if config.stop_early:
            after = damp(after, state, before)
            after = keep_settled(after, state, converged)
        before, state = state, after
        iterations = iterations + ((~converged).long() if config.stop_early else 1)
        converged = converged | has_settled(state, before, config)
        found.append(Round(state, converged, iterations))
        if config.stop_early and bool(converged.all()):
            break
    return found


def first_state(view: PairView, start: Start, config: InferenceConfig) -> State:
    """The start as a state: every point is in the cluster whose motion brings it closest to a target point."""
    batch = view.batch
    found = find_candidates(view, start.motions, start.active, config)
    at = clustering.correspond(batch.source, batch.target, start.motions, found.nearest, start.association)
    possible = possible_clusters(start.active, view.within(start.reach), batch.source.shape[1])
    best = at.residual.masked_fill(~possible[..., :-1], torch.inf).argmin(-1)
    index, mask, place = with_targets(found.index, found.mask, start.association)
    outlier = start.association < 0
    C = start.motions.shape[1]

    def certain(label: Tensor, states: int) -> Tensor:
        is_label = label[..., None] == torch.arange(states, device=label.device)
        return torch.zeros_like(is_label, dtype=batch.source.dtype).masked_fill(~is_label, -torch.inf)

    return State(
        motions=Motions.start(start.motions, start.active),
        association=start.association,
        cluster=best.masked_fill(outlier, -1),
        candidates=index,
        candidate_mask=mask,
        log_association=certain(place, index.shape[-1] + 1),
        log_cluster=certain(best.masked_fill(outlier, C), C + 1),
    )


def step(
    view: PairView,
    start: Start,
    state: State,
    parameters: Parameters,
    model: ModelConfig,
    update: Update = update_in_turns,
) -> State:
    """One round: candidates at the present motions, update of both chains, removal of empty clusters."""
    found = find_candidates(view, state.motions.value, state.motions.active, model.inference)
    state = update(view, start, hold_motions(state, model.inference), found, parameters, model)
    return replace(state, motions=retire_empty(state.motions, count_points(state)))


def hold_motions(state: State, config: InferenceConfig) -> State:
    """The state as the features use it: with `detach_motion`, its motions without gradient."""
    if not config.detach_motion:
        return state
    return replace(state, motions=replace(state.motions, value=state.motions.value.detach()))


def count_points(state: State) -> Tensor:
    """(B, C) number of associated points of every cluster."""
    clusters = torch.arange(state.motions.value.shape[1], device=state.cluster.device)
    return ((state.cluster[:, None] == clusters[:, None]) & (state.association >= 0)[:, None]).sum(-1)


def inliers_are_background(state: State) -> State:
    """Cluster labels for CRF-Matching, which has no clusters: associated points are background, the others outliers."""
    log_inliers = state.log_association[..., :-1]
    none = (log_inliers == -torch.inf).all(-1)  # logsumexp has no gradient there
    log_inlier = log_inliers.masked_fill(none[..., None], 0.0).logsumexp(-1).masked_fill(none, -torch.inf)
    log_cluster = torch.stack([log_inlier, state.log_association[..., -1]], dim=-1)
    return replace(state, cluster=torch.where(state.association >= 0, 0, -1), log_cluster=log_cluster)


def update_clusters(
    view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, config: InferenceConfig
) -> State:
    """An exact pass over the clustering chain at fixed motions and associations."""
    mask = view.batch.source_mask
    unary, edges = clustering_at(view, start, state, found, parameters)
    log_cluster = chain_beliefs(unary, edges, mask, config.temperature, in_loops=config.backend != "eager")
    labels = cluster_labels(log_cluster.argmax(-1), log_cluster.shape[-1] - 1, mask)
    return replace(state, log_cluster=log_cluster, cluster=labels)


def clustering_at(view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Log potentials (B, N, D) and (B, N-1, D, D) of the clustering chain at the state's motions and associations."""
    batch, scales = view.batch, parameters.scales
    at = clustering.correspond(batch.source, batch.target, state.motions.value, found.nearest, state.association)
    local = clustering_unary(view, at, state.motions.value, state.motions.active, scales, start.reach)
    pairwise = clustering.pairwise_features(batch.source, at, scales)
    possible = possible_clusters(state.motions.active, view.within(start.reach), batch.source.shape[1])
    extra = clustering_extra(view.learned, possible.shape[-1])
    unary, edges = clustering_potentials(local, pairwise, possible, parameters.clustering, extra)
    if view.limit is not None:
        unary = view.limit.joined(unary, clustering.nearest_distance(at, batch.target, found.nearest))
    return unary, edges


def cluster_labels(best: Tensor, outlier: int, mask: Tensor) -> Tensor:
    """(B, N) cluster of the best state, -1 for the outlier and for padding. best: (B, N)."""
    return best.masked_fill((best == outlier) | ~mask, -1)


def update_association(view: PairView, state: State, found: Candidates, parameters: Parameters, config: InferenceConfig) -> State:
    """An exact pass over the association chain, every point moved by its cluster's motion."""
    mask = view.batch.source_mask
    unary, edges = association_at(view, state, found, parameters)
    log_association = chain_beliefs(unary, edges, mask, config.temperature, in_loops=config.backend != "eager")
    labels = association_labels(log_association.argmax(-1), found.index, mask)
    return replace(state, candidates=found.index, candidate_mask=found.mask, log_association=log_association, association=labels)


def association_at(view: PairView, state: State, found: Candidates, parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Log potentials (B, N, K+1) and (B, N-1, K+1, K+1) of the association chain at the state's motions and clusters."""
    batch, scales, boosters = view.batch, parameters.scales, parameters.boosters
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    moved = registered_points(batch.source, state.motions.value, state.motions.active, state.log_cluster)
    unary = association_unary(view, states, moved, scales, boosters)
    pairwise = pairwise_features(batch.source, batch.target, found.index, scales, has_lengths=view.has_lengths)
    extra = association_extra(view.learned, found.index)
    unary, edges = association_potentials(unary, pairwise, found.mask, parameters.association, extra)
    if view.limit is not None:
        unary = view.limit.joined(unary, registered_distance(moved, batch.target, found.index))
    return unary, edges


def associate(view: PairView, start: Start, cluster: Tensor, parameters: Parameters, config: InferenceConfig) -> Tensor:
    """(B, N) associations of one exact pass over the association chain at the start's motions. cluster: (B, N), -1 outlier."""
    state = first_state(view, start, config)
    one_hot = torch.nn.functional.one_hot(cluster.clamp(min=0), start.motions.shape[1] + 1).to(start.motions)
    found = find_candidates(view, start.motions, start.active, config)
    return update_association(view, replace(state, log_cluster=one_hot), found, parameters, config).association


def association_labels(best: Tensor, candidates: Tensor, mask: Tensor) -> Tensor:
    """(B, N) target point of the best state, -1 for the outlier and for padding. best: (B, N)."""
    padded = torch.cat([candidates, torch.full_like(candidates[..., :1], -1)], dim=-1)
    return padded.gather(-1, best[..., None])[..., 0].masked_fill(~mask, -1)


def update_motions(
    view: PairView, start: Start, state: State, parameters: Parameters, config: InferenceConfig, *, trimmed: bool = False
) -> State:
    """ComputeRT. trimmed: Kabsch without the worst fifth, for a cluster that contains movers too (spec 9.2)."""
    metric = MOTION_METRICS[config.motion_metric]
    if not metric.is_fitted:
        return state
    batch = view.batch
    geometry = (batch.source, batch.target, start.target_tangents)
    support = hard_support(*geometry, state.association, state.cluster, state.motions.value.shape[1])
    if config.motion_weights == "soft":
        support = soft_support(*geometry, support, state.candidates, state.log_association, state.log_cluster)
    if trimmed and not metric.along_surface:
        support = trim(batch.source, support)
    scale = ROBUST_SHARE * parameters.scales.cluster_distance
    motions = estimate(batch.source, support, state.motions, metric=config.motion_metric, scale=scale, min_extent=config.min_extent)
    return replace(state, motions=motions)


def select_state(chosen: Tensor, yes: State, no: State) -> State:
    """`yes` for the pairs where chosen (B,) is True, else `no`."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(chosen.view(-1, *[1] * (a.dim() - 1)), a, b)

    motions = Motions(
        pick(yes.motions.value, no.motions.value),
        pick(yes.motions.active, no.motions.active),
        pick(yes.motions.empty_for, no.motions.empty_for),
    )
    names = ("association", "cluster", "candidates", "candidate_mask", "log_association", "log_cluster")
    return State(motions, *(pick(getattr(yes, name), getattr(no, name)) for name in names))


def keep_settled(after: State, before: State, converged: Tensor) -> State:
    """`before` for the pairs that have converged (B,), else `after`."""
    return select_state(converged, before, after)


def same_labels(a: State, b: State) -> Tensor:
    """(B,) whether both chains' labels agree."""
    return (a.association == b.association).all(-1) & (a.cluster == b.cluster).all(-1)


def swings(after: State, before: State, older: State) -> Tensor:
    """(B,) whether the labels equal those of two rounds ago and not the last ones."""
    return same_labels(after, older) & ~same_labels(after, before)


def damp(after: State, before: State, older: State) -> State:
    """Halves the motions' step if the labels swing (the guard against cycles of spec 7.6)."""
    turn = se2.wrap(after.motions.value[..., :1] - before.motions.value[..., :1])
    half = before.motions.value + torch.cat([turn, after.motions.value[..., 1:] - before.motions.value[..., 1:]], -1) / 2
    damped = replace(after, motions=replace(after.motions, value=half))
    return select_state(swings(after, before, older), damped, after)


def has_settled(after: State, before: State, config: InferenceConfig) -> Tensor:
    """(B,) labels unchanged and motions within the tolerances (spec 7.6)."""
    rotation, translation = se2.distance(after.motions.value.detach(), before.motions.value.detach())
    still = (rotation < config.rotation_tolerance) & (translation < config.translation_tolerance)
    still = (still | ~after.motions.active).all(-1)
    return same_labels(after, before) & still


def merge_alike(view: PairView, state: State, scale: Tensor, *, looks: bool = False) -> State:
    """Merges clusters with equal motions into the one with the lower number, after the last round only (spec 7.5).

    Motions are equal if their rotations differ by less than 0.01 rad and, over the points of both, their translations by less than
    `scale`. A cluster without points is not merged. looks: where values can be read, nothing is computed for what is not merged.
    """
    motions = replace(state.motions, value=state.motions.value.detach())  # the decision to merge has no gradient
    C = motions.value.shape[1]
    members = (state.cluster[..., None] == torch.arange(C, device=state.cluster.device)).to(motions.value)
    moved = se2.apply(motions.value, view.batch.source[:, None])  # (B, C, N, 2)
    total = members.sum(1)  # (B, C)
    usable = motions.active & (total > 0)
    for low in range(C - 1):
        later = slice(low + 1, C)
        rotation, _ = se2.distance(motions.value[:, low, None], motions.value[:, later])  # (B, C - low - 1)
        gap = torch.linalg.vector_norm(moved[:, low, None] - moved[:, later], dim=-1)  # (B, C - low - 1, N)
        of_low = (gap * members[:, None, :, low]).sum(-1) / total[:, low, None].clamp(min=1)
        of_later = (gap * members[..., later].mT).sum(-1) / total[:, later].clamp(min=1)
        is_near = (rotation < MERGE_ROTATION) & (torch.maximum(of_low, of_later) < scale)
        alike = usable[:, low, None] & usable[:, later] & is_near
        if looks and is_readable(alike) and not bool(alike.any()):
            continue
        for high in range(low + 1, C):
            state = join(state, alike[:, high - low - 1], low, high)
    return state


def join(state: State, chosen: Tensor, low: int, high: int) -> State:
    """Merges cluster `high` into `low` in the pairs where chosen (B,) is True."""
    cluster = torch.where(chosen[:, None] & (state.cluster == high), low, state.cluster)
    columns = list(state.log_cluster.unbind(-1))
    neither = torch.isneginf(columns[low]) & torch.isneginf(columns[high])  # logaddexp has no gradient there
    together = torch.logaddexp(columns[low].masked_fill(neither, 0.0), columns[high].masked_fill(neither, 0.0))
    together = together.masked_fill(neither, -torch.inf)
    columns[low] = torch.where(chosen[:, None], together, columns[low])
    columns[high] = columns[high].masked_fill(chosen[:, None], -torch.inf)
    is_high = torch.arange(state.motions.active.shape[1], device=chosen.device) == high
    active = state.motions.active & ~(chosen[:, None] & is_high)
    return replace(state, cluster=cluster, log_cluster=torch.stack(columns, -1), motions=replace(state.motions, active=active))


def read_out(
    batch: ScanPairBatch,
    start: Start,
    state: State,
    parameters: Parameters,
    config: InferenceConfig,
    converged: Tensor,
    iterations: Tensor,
) -> Prediction:
    """The `Prediction` of a state, with confidences and covariances. batch: in the unit of the features, as the state is."""
    motions = state.motions.value
    geometry = (batch.source, batch.target, start.target_tangents)
    support = hard_support(*geometry, state.association, state.cluster, motions.shape[1])
    scale = ROBUST_SHARE * parameters.scales.cluster_distance
    sure = motion_covariance(
        batch.source, support, motions, metric=config.motion_metric, scale=scale, noise=batch.range_noise
    ).inflated(parameters.calibration.covariance_factor)
    association_confidence, cluster_confidence = parameters.calibration(state)
    return Prediction(
        association=state.association,
        cluster=state.cluster,
        motions=state.motions.value,
        active=state.motions.active,
        candidates=state.candidates,
        log_association=state.log_association,
        log_cluster=state.log_cluster,
        converged=converged,
        iterations=iterations,
        association_confidence=association_confidence,
        cluster_confidence=cluster_confidence,
        uncertainty=sure,
    )
