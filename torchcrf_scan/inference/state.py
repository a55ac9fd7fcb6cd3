"""."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from torchcrf_scan.features.potentials import Boosters
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.motion import Motions
from torchcrf_scan.inference.selection import ClusterPotential
from torchcrf_scan.inference.uncertainty import Calibration


@dataclass(frozen=True, slots=True)
class Parameters:
    """What was learned: weights (23,) and (20,), the features' scales and boosters, honest confidences, a mover's worth."""

    association: Tensor
    clustering: Tensor
    scales: Scales
    boosters: Boosters
    calibration: Calibration = field(default_factory=Calibration)
    potential: ClusterPotential = field(default_factory=ClusterPotential)


@dataclass(frozen=True, slots=True)
class State:
    """One round's state of B pairs. Gradients reach the log-beliefs and, where soft, the motions; labels have none.

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
    """What B pairs had come to after a round.

    Attributes:
        state: labels, beliefs and motions.
        converged: (B,) bool, settled. iterations: (B,) rounds done.
    """

    state: State
    converged: Tensor
    iterations: Tensor
