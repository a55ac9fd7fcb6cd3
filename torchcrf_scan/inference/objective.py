"""The joint objective of the rounds, and what no labels can exceed at given motions.

The objective of labels and motions is the sum of the log potentials of both chains (spec 6.1), every node and every edge once:

    J(x_a, x_c; x_RT) = S_a(x_a; x_RT, x_c) + S_c(x_c; x_RT, x_a)

Each chain takes the labels of the other as observed: S_a registers a point by its cluster's motion (L12 and what follows from it;
an outlier by its best inlier cluster, A-12), S_c has residuals, C3, C4 and Q4 to Q6 from the associations (A-09). A pass over a
chain makes the chain's own score as large as it can be, whatever the new labels do to the score of the other one, and the motions
make errors in metres small. So J may fall in any step. It is no part of the rounds: only measured.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchcrf_scan.config import ModelConfig
from torchcrf_scan.features.candidates import Candidates, with_targets
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference.joint import association_at, clustering_at, update_association, update_clusters, update_motions
from torchcrf_scan.inference.messages import chain_messages, chain_score, silence_padding
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State


def chain_scores(view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters) -> Tensor:
    """(B, 2) S_a and S_c of the state's labels at its motions, in float64; J is their sum.

    -inf for labels that are impossible, such as a cluster that the selection has discarded. An association that is no candidate, as
    the motions have gone on since, stands in for the last one.

    found: the candidates and nearest targets of the round.
    """
    index, mask, place = with_targets(found.index, found.mask, state.association)
    associations = association_at(view, state, replace(found, index=index, mask=mask), parameters)
    clusters = clustering_at(view, start, state, found, parameters)
    states = place, state.cluster.masked_fill(state.cluster < 0, clusters[0].shape[-1] - 1)
    both = zip((associations, clusters), states, strict=True)
    return torch.stack([chain_score(*prepared(view, chain), labels) for chain, labels in both], dim=-1)


def prepared(view: PairView, chain: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Log potentials of a chain in float64, 0 for padding."""
    return silence_padding(chain[0].double(), chain[1].double(), view.batch.source_mask)


def chain_bound(log_unary: Tensor, log_pairwise: Tensor) -> Tensor:
    """(B,) `dual_bound` at the chain's max-product messages. Arguments as in `chain_messages`."""
    return dual_bound(log_unary, log_pairwise.unbind(1), chain_messages(log_unary, log_pairwise)[0])


def dual_bound(log_unary: Tensor, log_pairwise: Iterable[Tensor], log_messages: Tensor) -> Tensor:
    """(B,) an upper bound on the score of all labellings: the dual of a chain's linear programming relaxation at some messages.

    The messages only move potentials from nodes to edges and on, which changes the score of no labelling:

        sum_i max_{s,t} [ u_i(s) + m_i(s) + A_i(s, t) - m_{i+1}(t) ] + max_s [ u_N(s) + m_N(s) ]

    Whatever they are, no labelling and no point of the local polytope exceeds the sum of the maxima. Labels that reach it are
    therefore the best, and the relaxation is tight (weak duality).

    Args:
        log_unary: (B, N, S). log_pairwise: N-1 of (B, S, S). log_messages: (B, N, S) into every node from the one before, finite;
            0 into the first.
    """
    bound = (log_unary + log_messages)[:, -1:].amax(-1).sum(-1)
    for i, edge in enumerate(log_pairwise):
        given = (log_unary[:, i] + log_messages[:, i])[:, :, None]
        bound = bound + (given + edge - log_messages[:, i + 1, None]).amax((1, 2))
    return bound


@dataclass(slots=True)
class Watched:
    """`joint.update_in_turns` that keeps, of every round, what it does to the objective. For models with both chains.

    Attributes:
        scores: (B, 5, 2) of each round: `chain_scores` before it, and after clusters, motions, associations and motions.
        gaps: (B, 2) of each round: how much the best labels of the relaxed chain exceed those decoded, of S_a and S_c.
    """

    scores: list[Tensor] = field(default_factory=list)
    gaps: list[Tensor] = field(default_factory=list)

    @torch.no_grad()
    def __call__(
        self, view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, model: ModelConfig
    ) -> State:
        """An `Update`."""
        config = model.inference
        clustered = update_clusters(view, start, state, found, parameters, config)
        moved = update_motions(view, start, clustered, parameters, config)
        associated = update_association(view, moved, found, parameters, config)
        last = update_motions(view, start, associated, parameters, config)
        steps = (state, clustered, moved, associated, last)
        scores = torch.stack([chain_scores(view, start, of, found, parameters) for of in steps], dim=1)
        chains = association_at(view, moved, found, parameters), clustering_at(view, start, state, found, parameters)
        bounds = torch.stack([chain_bound(*prepared(view, chain)) for chain in chains], dim=-1)
        self.scores.append(scores)
        self.gaps.append(bounds - torch.stack([scores[:, 3, 0], scores[:, 1, 1]], dim=-1))
        return last
