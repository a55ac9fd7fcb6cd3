"""Exact messages on a chain of super-nodes (j, k), without forming its A D x A D transitions (spec 7.7).

A message is reduced over the association states for each kind of cluster transition, then over the clusters:

    m(j', k') = max_k [ C(k, k') + max_j [ b(j, k) + A_kind(k,k')(j, j') ] ]

so a step costs 3 A^2 D + A D^2 instead of A^2 D^2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features.candidates import Candidates
from torchcrf_scan.features.learned import add_log
from torchcrf_scan.features.potentials import AssociationStates, PairView, possible_clusters
from torchcrf_scan.inference.joint import association_labels, cluster_labels, update_motions
from torchcrf_scan.inference.messages import normalise, normalise_beliefs, reduce_states
from torchcrf_scan.inference.objective import dual_bound
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.variants.lattice_features import LatticePotentials, lattice_extra, lattice_features, transition_kinds


@dataclass(frozen=True, slots=True)
class LatticeBeliefs:
    """Normalised log-beliefs of super-nodes.

    Attributes:
        log_joint: (B, N, A, D) of both labels.
        log_association: (B, N, A), log_cluster: (B, N, D) of one label, reduced over the other; max-marginals at temperature 0.
    """

    log_joint: Tensor
    log_association: Tensor
    log_cluster: Tensor

    def best(self) -> tuple[Tensor, Tensor]:
        """(B, N) association and cluster states: the best cluster, and the best association in it.

        At temperature 0 that is the best super-node. Above, an inlier's belief is spread over similar candidates, an outlier's is
        not, so the best single super-node would too often be the outlier.
        """
        cluster = self.log_cluster.argmax(-1)
        in_cluster = self.log_joint.gather(-1, cluster[:, :, None, None].expand(-1, -1, self.log_joint.shape[2], 1))[..., 0]
        return in_cluster.argmax(-1), cluster


def both_directions(forward: Tensor, *, is_edge: bool) -> Tensor:
    """(2B, ...) a chain's tensor and that of the reversed chain. forward: (B, N, ...), or (B, N-1, S, S, ...) with `is_edge`."""
    backward = forward.flip(1)
    return torch.cat([forward, backward.transpose(2, 3) if is_edge else backward])


def lattice_messages(potentials: LatticePotentials, temperature: float = 0.0) -> tuple[Tensor, Tensor]:
    """(B, N, A, D) messages into every super-node from before and from after it; as `chain_messages`."""
    unary = both_directions(potentials.log_unary, is_edge=False)
    association = both_directions(potentials.log_association, is_edge=True)
    cluster = both_directions(potentials.log_cluster, is_edge=True)
    D = unary.shape[-1]
    kind_and_cluster = transition_kinds(D, unary.device) * D + torch.arange(D, device=unary.device)[:, None]
    message = torch.zeros_like(unary[:, 0])
    messages = [message]
    for here, by_kind, between in zip(unary[:, :-1].unbind(1), association.unbind(1), cluster.unbind(1), strict=True):
        of_kinds = reduce_states((here + message)[:, :, None, None] + by_kind[..., None], 1, temperature)  # (2B, A', 3, D)
        of_pairs = of_kinds.flatten(2).index_select(-1, kind_and_cluster.flatten()).unflatten(-1, (D, D))  # (2B, A', D, D')
        message = reduce_states(of_pairs + between[:, None], 2, temperature)
        message = normalise(message.flatten(1)).view_as(here)
        messages.append(message)
    forward, backward = torch.stack(messages, dim=1).unflatten(0, (2, potentials.log_unary.shape[0])).unbind()
    return forward, backward.flip(1)


def lattice_beliefs(potentials: LatticePotentials, mask: Tensor, temperature: float = 0.0) -> LatticeBeliefs:
    """Beliefs of super-nodes and of either label; padding is ignored. mask: (B, N)."""
    potentials = potentials.cut(mask)
    forward, backward = lattice_messages(potentials, temperature)
    beliefs = potentials.log_unary + forward + backward
    return LatticeBeliefs(
        normalise_beliefs(beliefs.flatten(2), temperature).view_as(beliefs),
        normalise_beliefs(reduce_states(beliefs, 3, temperature), temperature),
        normalise_beliefs(reduce_states(beliefs, 2, temperature), temperature),
    )


def lattice_score(potentials: LatticePotentials, association: Tensor, cluster: Tensor) -> Tensor:
    """(B,) score of one labelling. association, cluster: (B, N) states."""
    A, D = potentials.log_unary.shape[2:]
    j, k = association, cluster
    kind = transition_kinds(D, k.device)[k[:, :-1], k[:, 1:]]
    states = (
        (potentials.log_unary.flatten(2), j * D + k),
        (potentials.log_association.flatten(2), (j[:, :-1] * A + j[:, 1:]) * 3 + kind),
        (potentials.log_cluster.flatten(2), k[:, :-1] * D + k[:, 1:]),
    )
    return torch.stack([values.gather(-1, state[..., None]).sum((1, 2)) for values, state in states]).sum(0)


def lattice_bound(potentials: LatticePotentials) -> Tensor:
    """(B,) `inference.objective.dual_bound` of the chain of super-nodes at its max-product messages."""
    kinds = transition_kinds(potentials.log_cluster.shape[-1], potentials.log_cluster.device)
    factors = zip(potentials.log_association.unbind(1), potentials.log_cluster.unbind(1), strict=True)
    tables = ((by_kind[..., kinds] + between[:, None, None]).transpose(2, 3) for by_kind, between in factors)  # (B, A, D, A', D')
    edges = (table.flatten(3).flatten(1, 2) for table in tables)
    return dual_bound(potentials.log_unary.flatten(2), edges, lattice_messages(potentials)[0].flatten(2))


def lattice_log_partition(potentials: LatticePotentials) -> Tensor:
    """(B,) log of the summed score of all labellings. Gradients are the marginals; not differentiable twice."""
    return _LogPartition.apply(potentials.log_unary, potentials.log_association, potentials.log_cluster)


class _LogPartition(torch.autograd.Function):
    """Sum-product by small matrix products, and its gradient from forward and backward messages.

    Several times as fast as differentiating `lattice_messages`. Transitions more than about 700 (float32: 80) below the best of
    their edge underflow to 0.
    """

    @staticmethod
    def forward(ctx: Any, log_unary: Tensor, log_association: Tensor, log_cluster: Tensor) -> Tensor:
        tables = log_association.permute(0, 1, 4, 2, 3)  # (B, E, 3, A, A)
        peaks = tables.amax((2, 3, 4)), log_cluster.amax((2, 3))  # (B, E) each
        tables = torch.exp(tables - peaks[0][..., None, None, None])
        kinds = torch.nn.functional.one_hot(transition_kinds(log_cluster.shape[-1], log_cluster.device), 3).permute(2, 0, 1)
        clusters = torch.exp(log_cluster - peaks[1][..., None, None])[:, :, None] * kinds  # (B, E, 3, D, D)
        before, after = _sum_messages(log_unary, tables, clusters)
        last = (log_unary[:, -1] + before[:, -1]).flatten(1)
        ctx.save_for_backward(log_unary, before, after, tables, clusters)
        return last.logsumexp(-1) + peaks[0].sum(-1) + peaks[1].sum(-1)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, ...]:
        log_unary, before, after, tables, clusters = ctx.saved_tensors
        beliefs = (log_unary + before + after).flatten(2)
        of_nodes = torch.softmax(beliefs, dim=-1).view_as(log_unary)
        left, _ = _exp_shifted((log_unary + before)[:, :-1])
        right, _ = _exp_shifted((log_unary + after)[:, 1:])
        left, right = left[:, :, None], right[:, :, None]  # (B, E, 1, A, D)
        of_tables = tables * (left @ clusters @ right.mT)  # (B, E, 3, A, A')
        of_clusters = (clusters * (left.mT @ tables @ right)).sum(2)  # (B, E, D, D')
        total = of_clusters.sum((2, 3), keepdim=True)
        return (
            slope[:, None, None, None] * of_nodes,
            slope[:, None, None, None, None] * (of_tables / total[..., None]).permute(0, 1, 3, 4, 2),
            slope[:, None, None, None] * (of_clusters / total),
        )


def _exp_shifted(log_values: Tensor) -> tuple[Tensor, Tensor]:
    """exp(x - peak) over the last two axes, and the peak."""
    peak = log_values.amax((-2, -1), keepdim=True)
    return torch.exp(log_values - peak), peak


def _sum_messages(log_unary: Tensor, tables: Tensor, clusters: Tensor) -> tuple[Tensor, Tensor]:
    """`lattice_messages` at temperature 1, unnormalised, from exp of the transitions (B, E, 3, A, A), (B, E, 3, D, D)."""
    unary = both_directions(log_unary, is_edge=False)
    tables = torch.cat([tables.mT, tables.flip(1)])  # (2B, E, 3, A', A)
    clusters = torch.cat([clusters, clusters.flip(1).mT])
    message = torch.zeros_like(unary[:, 0])
    messages = [message]
    for here, table, cluster in zip(unary[:, :-1].unbind(1), tables.unbind(1), clusters.unbind(1), strict=True):
        outgoing, peak = _exp_shifted(here + message)
        message = torch.log((table @ outgoing[:, None] @ cluster).sum(1)) + peak
        messages.append(message)
    forward, backward = torch.stack(messages, dim=1).unflatten(0, (2, log_unary.shape[0])).unbind()
    return forward, backward.flip(1)


def update(view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, model: ModelConfig) -> State:
    """The coupling `lattice` of `inference.joint.Update`: both labels of a point at once (spec 7.7), then the motions."""
    state = update_labels(view, start, state, found, parameters, model.inference)
    return update_motions(view, start, state, parameters, model.inference)


def update_labels(
    view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, config: InferenceConfig
) -> State:
    """An exact pass over the chain of super-nodes, which decides both labels of a point at once (spec 7.7)."""
    mask = view.batch.source_mask
    potentials = lattice_at(view, start, state, found, parameters)
    beliefs = lattice_beliefs(potentials, mask, config.temperature)
    place, cluster = beliefs.best()
    return replace(
        state,
        association=association_labels(place, found.index, mask),
        cluster=cluster_labels(cluster, beliefs.log_cluster.shape[-1] - 1, mask),
        candidates=found.index,
        candidate_mask=found.mask,
        log_association=beliefs.log_association,
        log_cluster=beliefs.log_cluster,
    )


def lattice_at(view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters) -> LatticePotentials:
    """The lattice's log potentials at the state's motions."""
    motions, fitted = state.motions, (parameters.scales, parameters.boosters)
    states = AssociationStates.of(view, found.index, found.mask, *fitted)
    possible = possible_clusters(motions.active, view.within(start.reach), view.batch.source.shape[1])
    features = lattice_features(view, states, motions.value, found.nearest, possible, *fitted, start.reach)
    potentials = features.potentials(torch.cat([parameters.association, parameters.clustering]))
    extra = lattice_extra(view.learned, found.index, possible.shape[-1])
    return replace(potentials, log_unary=add_log(potentials.log_unary, extra))
