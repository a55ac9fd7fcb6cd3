"""Pseudo-likelihood of an annotation: every label given its neighbours' true labels (spec 6.2).

It needs the features only, as one tensor per chain: `Chain.design`, rows = nodes, columns = states. The objective is that of a
conditional logit model, convex in the weights; learning builds the designs once and optimises on them. `Chain` keeps the
transitions too, for the exact likelihood (spec 6.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features import candidates as candidate_search
from torchcrf_scan.features import clustering
from torchcrf_scan.features.association import edge_features, pairwise_features
from torchcrf_scan.features.learned import add_log, association_extra, clustering_extra
from torchcrf_scan.features.potentials import (
    AssociationStates,
    Boosters,
    PairView,
    association_unary,
    clustering_unary,
    find_candidates,
    possible_clusters,
    registered_points,
    state_mask,
)
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.messages import chain_score, log_partition
from torchcrf_scan.inference.state import Parameters


@dataclass(frozen=True, slots=True)
class PlugIns:
    """Motions and labels that the features treat as observed while the weights are learned (spec 2.5, 4.1).

    Attributes:
        motions: (B, C, 3), active: (B, C).
        association: (B, N) hat x_a in the clustering features, -1 outlier.
        cluster: (B, N) hat x_c in the registered channel, -1 outlier (moved with the background).
        label: (B, N) true cluster as a slot of `motions`, -1 outlier.
        known: (B, N) bool, annotated nodes.
        reach: (B, N, C) as in `Start`; None: 0 everywhere.
    """

    motions: Tensor
    active: Tensor
    association: Tensor
    cluster: Tensor
    label: Tensor
    known: Tensor
    reach: Tensor | None = None


@dataclass(frozen=True, slots=True)
class Design:
    """A chain's features at the true labels of the neighbours.

    Attributes:
        features: (B, N, S, W). mask: (B, N, S) possible states. label: (B, N) true state. known: (B, N) annotated nodes.
        extra: (B, N, S) log potentials without a weight, from learned inputs; None: none.
        counts: (B, N) how much every node counts; None: 1.
    """

    features: Tensor
    mask: Tensor
    label: Tensor
    known: Tensor
    extra: Tensor | None = None
    counts: Tensor | None = None

    def log_likelihood(self, weights: Tensor) -> Tensor:
        """(B, N) log p(true state | neighbours, observation), as it counts; 0 for unannotated nodes. weights: (W,)."""
        score = add_log(self.features @ weights, self.extra).masked_fill(~self.mask, -torch.inf)
        chosen = torch.log_softmax(score, dim=-1).gather(-1, self.label[..., None])[..., 0]
        chosen = chosen if self.counts is None else self.counts * chosen
        return torch.where(self.known, chosen, torch.zeros_like(chosen))

    def design(self) -> Design:
        """Itself: all that the pseudo-likelihood needs of a chain."""
        return self


@dataclass(frozen=True, slots=True)
class Chain:
    """A chain's features in every state and transition.

    Attributes:
        unary: (B, N, S, U), pairwise: (B, N-1, S, S, P) features; their weights are U + P.
        mask: (B, N, S) possible states. label: (B, N) true state. known: (B, N) annotated nodes; the others cut the chain.
        extra: as in `Design`.
        axes, labels: the tensors' axes after B (n nodes, e edges, s states), and the states that a label indexes; for stacking.
    """

    axes: ClassVar[dict[str, str]] = {"unary": "ns", "pairwise": "ess", "mask": "ns", "label": "n", "known": "n", "extra": "ns"}
    labels: ClassVar[dict[str, str]] = {"label": "s"}

    unary: Tensor
    pairwise: Tensor
    mask: Tensor
    label: Tensor
    known: Tensor
    extra: Tensor | None = None

    def scored(self, weights: Tensor) -> Chain:
        """The chain with one feature of nodes and one of edges, the weighted sums of these. weights: (U + P,)."""
        split = self.unary.shape[-1]
        unary, pairwise = self.unary @ weights[:split], self.pairwise @ weights[split:]
        return replace(self, unary=unary[..., None], pairwise=pairwise[..., None])

    def design(self) -> Design:
        """The features of the pseudo-likelihood."""
        features = torch.cat([self.unary, at_true_neighbours(self.pairwise, self.label, self.known)], dim=-1)
        return Design(features, self.mask, self.label, self.known, self.extra)

    def log_likelihood(self, weights: Tensor) -> Tensor:
        """(B,) exact log p(true labels | observation) by the forward recursion (spec 6.5); 0 for unannotated nodes.

        weights: (U + P,).
        """
        split = self.unary.shape[-1]
        log_unary = add_log(self.unary @ weights[:split], self.extra).masked_fill(~self.mask, -torch.inf)
        log_unary = torch.where(self.known[..., None], log_unary, torch.zeros_like(log_unary))
        free = (~self.known).sum(-1).to(log_unary) * math.log(self.mask.shape[2])  # an unknown node adds log S to log Z
        both = self.known[:, 1:] & self.known[:, :-1]
        log_pairwise = (self.pairwise @ weights[split:]) * both[..., None, None]
        return chain_score(log_unary, log_pairwise, self.label) + free - log_partition(log_unary, log_pairwise)


def true_plugins(batch: ScanPairBatch, clusters: int) -> PlugIns:
    """Plug-ins from the annotation (the faithful reading, A-11); movers beyond the `clusters` slots are unknown."""
    truth = _truth_of(batch)
    B, G = truth.motions.shape[:2]
    slots = min(G, clusters)
    given = truth.motions[:, :slots].isfinite().all(-1)
    motions = torch.zeros(B, clusters, 3, dtype=truth.motions.dtype, device=truth.motions.device)
    motions[:, :slots] = truth.motions[:, :slots].nan_to_num()
    active = torch.zeros(B, clusters, dtype=torch.bool, device=motions.device)
    active[:, :slots] = given
    active[:, 0] = True
    covered = active.gather(1, truth.cluster.clamp(0, clusters - 1)) & (truth.cluster < clusters)
    known = truth.known & (covered | (truth.cluster < 0))
    label = truth.cluster.masked_fill(~known, -1)
    return PlugIns(motions, active, truth.association, label, label, known)


def _truth_of(batch: ScanPairBatch) -> Truth:
    assert batch.truth is not None
    return batch.truth


def association_chain(
    view: PairView,
    plugins: PlugIns,
    scales: Scales,
    boosters: Boosters,
    config: InferenceConfig,
    found: candidate_search.Candidates | None = None,
) -> Chain:
    """The association chain's 19 + 4 features; states are the candidates of inference and the true target point.

    found: the candidates at the plug-ins' motions; None: they are searched.
    """
    unary, states, label = association_nodes(view, plugins, scales, boosters, config, found)
    points = view.batch.source, view.batch.target
    pairwise = pairwise_features(*points, states.candidates, scales, has_lengths=view.has_lengths)
    extra = association_extra(view.learned, states.candidates)
    return Chain(unary, pairwise, state_mask(states.mask), label, plugins.known & view.batch.source_mask, extra)


def association_design(view: PairView, plugins: PlugIns, scales: Scales, boosters: Boosters, config: InferenceConfig) -> Design:
    """The design of `association_chain`, from the edges to the true neighbours alone: costs N K instead of N K^2."""
    unary, states, label = association_nodes(view, plugins, scales, boosters, config)
    batch, known = view.batch, plugins.known & view.batch.source_mask
    true = _truth_of(batch).association[..., None]
    target, is_outlier = true.clamp(min=0), (true[..., 0] < 0).long()  # two states of a neighbour: its true target, the outlier

    def edges(before: Tensor, after: Tensor) -> Tensor:
        return edge_features(batch.source, batch.target, before[:, :-1], after[:, 1:], scales, has_lengths=view.has_lengths)

    before, after = beside_neighbours(edges(target, states.candidates), edges(states.candidates, target), is_outlier, known)
    extra = association_extra(view.learned, states.candidates)
    return Design(torch.cat([unary, before + after], dim=-1), state_mask(states.mask), label, known, extra)


def association_nodes(
    view: PairView,
    plugins: PlugIns,
    scales: Scales,
    boosters: Boosters,
    config: InferenceConfig,
    found: candidate_search.Candidates | None = None,
) -> tuple[Tensor, AssociationStates, Tensor]:
    """The 19 features of every node and state of `association_chain`, its states, and (B, N) the true ones."""
    batch = view.batch
    found = found or find_candidates(view, plugins.motions, plugins.active, config)
    as_found, states, label = states_with_truth(view, found, scales, boosters)
    C = plugins.motions.shape[1]
    one_hot = torch.nn.functional.one_hot(plugins.cluster.clamp(min=0), C + 1).to(batch.source.dtype)
    moved = registered_points(batch.source, plugins.motions, plugins.active, one_hot)
    return association_unary(view, states, moved, scales, boosters, as_found), states, label


def states_with_truth(
    view: PairView, found: candidate_search.Candidates, scales: Scales, boosters: Boosters
) -> tuple[AssociationStates, AssociationStates, Tensor]:
    """The states of the candidates that inference would find, the same with the true targets, and (B, N) the true states.

    The outlier booster takes the first, in training as in use: its inputs must not tell which target is the true one.
    """
    association = _truth_of(view.batch).association
    index, mask, label = candidate_search.with_targets(found.index, found.mask, association)
    put = mask & ~(found.mask & (found.index == index))
    as_found = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    target = association.clamp(min=0)[..., None]
    true = AssociationStates.of(view, target, torch.ones_like(target, dtype=torch.bool), scales, boosters)
    return as_found, as_found.with_targets(true, put), label


def clustering_chain(view: PairView, plugins: PlugIns, scales: Scales, found: candidate_search.Candidates | None = None) -> Chain:
    """The clustering chain's 13 + 8 features. found: the candidates at the plug-ins' motions; None: they are searched."""
    batch = view.batch
    C = plugins.motions.shape[1]
    scans = batch.source, batch.target, batch.target_mask
    found = found or candidate_search.by_motion(*scans, plugins.motions, plugins.active, 1)
    at = clustering.correspond(batch.source, batch.target, plugins.motions, found.nearest, plugins.association)
    local = clustering_unary(view, at, plugins.motions, plugins.active, scales, plugins.reach)
    pairwise = clustering.pairwise_features(batch.source, at, scales)
    label = torch.where(plugins.label >= 0, plugins.label, C)
    known = plugins.known & batch.source_mask
    possible = possible_clusters(plugins.active, view.within(plugins.reach), label.shape[1])
    return Chain(local, pairwise, possible, label, known, clustering_extra(view.learned, C + 1))


def at_true_neighbours(pairwise: Tensor, label: Tensor, known: Tensor) -> Tensor:
    """Sum of the features of a node's two edges with the neighbours in their true states; 0 for unknown neighbours.

    Args:
        pairwise: (B, N-1, S, S, P). label: (B, N) states. known: (B, N).

    Returns:
        (B, N, S, P).
    """
    before, after = beside_true_neighbours(pairwise, label, known)
    return before + after


def beside_true_neighbours(pairwise: Tensor, label: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """The two terms of `at_true_neighbours`: the edge to the node before and the edge to the node after."""
    return beside_neighbours(pairwise, pairwise, label, known)


def beside_neighbours(before: Tensor, after: Tensor, label: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """The features of a node's two edges with its neighbours in given states; 0 for unknown neighbours.

    Args:
        before: (B, N-1, T, S, P) of every edge, its first point in T states. after: (B, N-1, S, T, P), its second point.
        label: (B, N) state, of the T, of every node as a neighbour. known: (B, N).

    Returns:
        (B, N, S, P) of the edge to the node before, and of that to the node after.
    """
    B, E, _, S, P = before.shape
    row = label[:, :-1, None, None, None].expand(B, E, 1, S, P)
    column = label[:, 1:, None, None, None].expand(B, E, S, 1, P)
    from_before = before.gather(2, row)[:, :, 0] * known[:, :-1, None, None]  # (B, E, S, P) for node i + 1
    from_after = after.gather(3, column)[:, :, :, 0] * known[:, 1:, None, None]  # for node i
    none = before.new_zeros(B, 1, S, P)
    return torch.cat([none, from_before], dim=1), torch.cat([from_after, none], dim=1)


def pseudo_log_likelihood(view: PairView, plugins: PlugIns, parameters: Parameters, config: ModelConfig) -> Tensor:
    """(B,) log pseudo-likelihood summed over nodes and over the chains of the model."""
    total = view.batch.source.new_zeros(len(view.batch))
    found = find_candidates(view, plugins.motions, plugins.active, config.inference)  # the same for both chains
    if config.has_association:
        chain = association_chain(view, plugins, parameters.scales, parameters.boosters, config.inference, found)
        total = total + pseudo_log_likelihood_of(chain, parameters.association)
    if config.has_clusters:
        chain = clustering_chain(view, plugins, parameters.scales, found)
        total = total + pseudo_log_likelihood_of(chain, parameters.clustering)
    return total


def pseudo_log_likelihood_of(chain: Chain, weights: Tensor) -> Tensor:
    """(B,) log pseudo-likelihood of one chain; weighed before the neighbours are looked up, one number instead of P features."""
    return chain.scored(weights).design().log_likelihood(weights.new_ones(2)).sum(-1)


def for_background_alone(plugins: PlugIns, batch: ScanPairBatch) -> PlugIns:
    """The plug-ins of CRF-Matching: every annotated point moves with the background, that of a mover without a slot too."""
    truth = _truth_of(batch)
    return replace(
        plugins,
        motions=plugins.motions[:, :1],
        active=plugins.active[:, :1],
        cluster=torch.zeros_like(plugins.cluster),
        label=truth.cluster.clamp(max=0).masked_fill(~truth.known, -1),
        known=truth.known,
        reach=None,
    )
