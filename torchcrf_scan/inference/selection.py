"""Selection of hypothesised movers by the clustering chain and the hypotheses' scores together (design finding 14).

Every hypothesis begins as a cluster, the paper's "start with many clusters, discard the vacuous". A cluster stays if the
evidence of the chain for it and its score outweigh a bias:

    bias + explains * log(1 + log Z of the chain with it - log Z without it) + score * log-odds of the hypothesis > 0

Only the cluster of least worth is removed at a time, because of two that explain the same points neither adds to the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.learned import clustering_extra
from torchcrf_scan.features.potentials import PairView, clustering_potentials, contradictions, find_candidates, possible_clusters
from torchcrf_scan.inference.messages import log_partition, silence_padding
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.loops.chains import totals_without
from torchcrf_scan.loops.choice import is_readable


@torch.no_grad()
def discard_vacuous(view: PairView, start: Start, state: State, parameters: Parameters, config: InferenceConfig) -> State:
    """The state without the clusters of negative worth. Movers only; needs `start.log_odds`."""
    assert start.log_odds is not None
    chain = ConsideredChain.of(view, start, state, parameters, config)
    active = state.motions.active
    ends_early = config.stop_early or (config.backend != "eager" and is_readable(active))
    for _ in range(active.shape[1] - 1):
        if ends_early and not bool(active[:, 1:].any()):
            break
        worth = parameters.potential(chain.evidence(active), start.log_odds)  # (B, C)
        is_mover = torch.arange(worth.shape[1], device=worth.device) > 0
        least, which = worth.masked_fill(~(active & is_mover), torch.inf).min(-1)
        is_vacuous = (which[:, None] == torch.arange(worth.shape[1], device=worth.device)) & (least < 0)[:, None]
        if ends_early and not bool(is_vacuous.any()):
            break
        active = active & ~is_vacuous
    return replace(state, motions=replace(state.motions, active=active))


@torch.no_grad()
def evidence(view: PairView, start: Start, state: State, parameters: Parameters, config: InferenceConfig) -> Tensor:
    """`ConsideredChain.evidence` of the state's own clusters."""
    return ConsideredChain.of(view, start, state, parameters, config).evidence(state.motions.active)


@dataclass(frozen=True, slots=True)
class ConsideredChain:
    """The clustering chain at one state's motions and associations, for any subset of its clusters.

    Attributes:
        view, start, parameters: as in `joint.decode`.
        at: moved points and their residuals. beside_local: (B, N, D, 9) features that do not depend on the set of clusters.
        pairwise: (B, N-1, D, D, 8). in_loops: totals are computed by the loops where they can read tensors.
    """

    view: PairView
    start: Start
    parameters: Parameters
    at: clustering.Correspondence
    beside_local: Tensor
    pairwise: Tensor
    in_loops: bool

    @classmethod
    def of(cls, view: PairView, start: Start, state: State, parameters: Parameters, config: InferenceConfig) -> ConsideredChain:
        """Arguments as in `discard_vacuous`."""
        batch, motions, scales = view.batch, state.motions, parameters.scales
        found = find_candidates(view, motions.value, motions.active, config)
        at = clustering.correspond(batch.source, batch.target, motions.value, found.nearest, state.association)
        pairwise = clustering.pairwise_features(batch.source, at, scales)
        beside = contradictions(view, at, motions.value, scales, start.reach)
        return cls(view, start, parameters, at, beside, pairwise, config.backend != "eager")

    def evidence(self, active: Tensor) -> Tensor:
        """(B, C) log Z of the chain with all active clusters minus log Z without the cluster; 0 for inactive ones.

        The removed cluster's points still count as explained (C2); otherwise its removal would favour the outlier state there.

        active: (B, C), a subset of the state's.
        """
        mask = self.view.batch.source_mask
        B, C = active.shape
        local = torch.cat([clustering.local_features(self.at, active, self.parameters.scales), self.beside_local], dim=-1)
        within = self.view.within(self.start.reach)
        possible = possible_clusters(active, within, mask.shape[1])  # (B, N, D)
        extra = clustering_extra(self.view.learned, C + 1)
        every = torch.ones_like(possible)
        log_unary, log_pairwise = clustering_potentials(local, self.pairwise, every, self.parameters.clustering, extra)
        if self.in_loops and is_readable(log_unary, log_pairwise):
            potentials = silence_padding(log_unary.masked_fill(~possible, -torch.inf), log_pairwise, mask)
            whole, without = totals_without(*potentials)
            is_mover = active & (torch.arange(C) > 0)
            return torch.where(is_mover, whole[:, None] - without[:, :-1], 0.0)
        is_other = ~torch.eye(C, dtype=torch.bool, device=active.device)
        is_other = torch.cat([torch.ones_like(is_other[:1]), is_other[1:]])  # row 0: all clusters; row k: without cluster k
        there = active & is_other[:, None]  # (C, B, C)
        possible = torch.stack([possible_clusters(row, within, mask.shape[1]) for row in there])  # (C, B, N, D)
        totals = log_partition(
            *silence_padding(
                log_unary.masked_fill(~possible, -torch.inf).flatten(0, 1),
                log_pairwise.expand(C, *log_pairwise.shape).flatten(0, 1),
                mask.expand(C, *mask.shape).flatten(0, 1),
            )
        ).view(C, B)
        return (totals[0] - totals).mT
