"""Inputs and state of the rounds: learned parameters, and the labels, beliefs and motions after each round."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from torchcrf_scan.features.potentials import Boosters
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.motion import Motions
from torchcrf_scan.inference.uncertainty import Calibration

CAPPED = 5.0  # cap on the log-odds of a hypothesis


class ClusterPotential(nn.Module):
    """Log-linear potential of a mover's cluster; its three weights are fitted with the others (`learning.selection_fit`).

    Attributes:
        explains: () weight of log(1 + increase of the clustering chain's log Z by the cluster).
        score: () weight of the hypothesis' log-odds. bias: ().
    """

    explains: Tensor
    score: Tensor
    bias: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("explains", torch.tensor(1.0))
        self.register_buffer("score", torch.tensor(1.0))
        self.register_buffer("bias", torch.tensor(-2.0))

    def forward(self, evidence: Tensor, log_odds: Tensor) -> Tensor:
        """(...) worth; clusters below 0 are discarded. evidence, log_odds: (...)."""
        explained, scored = self.terms(evidence, log_odds).unbind(-1)
        return self.bias + self.explains * explained + self.score * scored

    @staticmethod
    def terms(evidence: Tensor, log_odds: Tensor) -> Tensor:
        """(..., 2) features of the weights `explains` and `score`."""
        return torch.stack([evidence.clamp(min=0).log1p(), log_odds.clamp(-CAPPED, CAPPED)], dim=-1)


@dataclass(frozen=True, slots=True)
class Parameters:
    """Learned parameters: weights (23,) and (21,), scales, boosters, calibration, potential of a mover's cluster."""

    association: Tensor
    clustering: Tensor
    scales: Scales
    boosters: Boosters
    calibration: Calibration = field(default_factory=Calibration)
    potential: ClusterPotential = field(default_factory=ClusterPotential)


@dataclass(frozen=True, slots=True)
class State:
    """State of B pairs after a round. Gradients reach the log-beliefs and, where soft, the motions; labels have none.

    Attributes:
        motions: motions and which clusters exist.
        association: (B, N) hat x_a, target point or -1. cluster: (B, N) hat x_c, cluster or -1.
        candidates: (B, N, K) inlier states of the association chain, candidate_mask: which are real.
        log_association: (B, N, K+1), log_cluster: (B, N, D) log-beliefs.
    """

    motions: Motions
    association: Tensor
    cluster: Tensor
    candidates: Tensor
    candidate_mask: Tensor
    log_association: Tensor
    log_cluster: Tensor


@dataclass(frozen=True, slots=True)
class Round:
    """State and convergence of B pairs after a round.

    Attributes:
        state: labels, beliefs and motions.
        converged: (B,) bool. iterations: (B,) number of rounds.
    """

    state: State
    converged: Tensor
    iterations: Tensor
