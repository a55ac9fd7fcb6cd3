"""What the model says: of a batch, as padded tensors, and of one pair, by beam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.batch import scale_motions
from torchcrf_scan.scan import Floats, Ints, PairPrediction, ScanPair
from torchcrf_scan.tree import tensor_tree

LEAST_SHARE = 0.02  # of the best possible information per point; in a direction with less the motion counts as not observed


@tensor_tree
@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How well the motions of a batch are known.

    A small motion away from cluster c's own is (theta L, x, y): a turn about the centroid of its moved points, times their root
    mean square distance L from it, then a shift in the target frame; all in metres. `directions` are given in these.

    Attributes:
        covariance: (B, C, 3, 3) of (theta, tx, ty), radians and metres; large but finite where nothing is observed.
        information: (B, C, 3) ascending, what a point says of each of the `directions`, 1 = as much as a point can say of a shift.
            No gradient.
        directions: (B, C, 3, 3), row d is the unit direction of information[..., d]. No gradient.
    """

    covariance: Tensor
    information: Tensor
    directions: Tensor

    @property
    def degenerate(self) -> Tensor:
        """(B, C, 3) bool, the directions in which the motion is not observed."""
        return self.information < LEAST_SHARE

    @property
    def is_turn_unobserved(self) -> Tensor:
        """(B, C) bool, whether nothing is known of the rotation: no points, one point, a pole, a tube seen from its middle."""
        return self._unobserved[..., 0, 0] > 0.5

    @property
    def unobserved_shift(self) -> Tensor:
        """(B, C, 2) unit vector, in the target frame, along which the cluster may have slid unseen (a corridor's, a car's side).

        0 where there is none; where no shift is observed at all, any of the directions.
        """
        values, vectors = torch.linalg.eigh(self._unobserved[..., 1:, 1:])
        return vectors[..., -1] * (values[..., -1:] > 0.5)

    @property
    def _unobserved(self) -> Tensor:
        """(B, C, 3, 3) projection onto the degenerate directions."""
        rows = self.directions * self.degenerate[..., None]
        return rows.mT @ rows

    def scaled(self, factor: Tensor) -> Uncertainty:
        """The same in another unit of length, a factor (B,) a pair."""
        unit = torch.stack([torch.ones_like(factor), factor, factor], -1)[:, None]  # (B, 1, 3)
        return replace(self, covariance=self.covariance * unit[..., None] * unit[..., None, :])

    def inflated(self, factor: Tensor) -> Uncertainty:
        """All covariances times a factor ()."""
        return replace(self, covariance=self.covariance * factor)

    def of_pair(self, b: int) -> Uncertainty:
        """That of pair b alone, without gradient, on the CPU."""
        row = slice(b, b + 1)
        return Uncertainty(*(values[row].detach().cpu() for values in (self.covariance, self.information, self.directions)))


@tensor_tree
@dataclass(frozen=True, slots=True)
class Prediction:
    """What the model says of a batch; tensors of points, batch first. The README tells what every output's gradient is and costs.

    Whole numbers and booleans have no gradient, and nothing has where compiled code answered or by the `flooding` schedule.

    Attributes:
        association: (B, N) int64 target point, -1 outlier.
        cluster: (B, N) int64 0 background, 1..D-2 movers, -1 outlier.
        motions: (B, D-1, 3) `T_target_source` of background and movers. Gradients reach what was learned only if
            `motion_weights` is soft; with hard ones they reach the points alone and, point-to-line, the start's motions.
        active: (B, D-1) bool, the clusters that exist. The others' motions are those of the start or of their last points.
        candidates: (B, N, K) int64 target point that every inlier association state stands for.
        log_association: (B, N, K+1) normalised log-beliefs of the association chain, last = outlier; uniform in the padding.
            Differentiable at the candidates that there are; kinks where labellings tie, but only at temperature 0.
        log_cluster: (B, N, D) normalised log-beliefs of the clustering chain, last = outlier; likewise.
        converged: (B,) bool, whether labels and motions had settled.
        iterations: (B,) int64 rounds done.
        association_confidence: (B, N) in [0, 1], to be right within two target points; calibrated. None: the beliefs themselves.
            Gradient of the beliefs, at the label as it is.
        cluster_confidence: (B, N) in [0, 1], calibrated. None: the beliefs themselves. Gradient likewise.
        uncertainty: covariances of the motions and what of them was not observed; None for methods that do not say. Of these only
            the covariances have a gradient.
    """

    association: Tensor
    cluster: Tensor
    motions: Tensor
    active: Tensor
    candidates: Tensor
    log_association: Tensor
    log_cluster: Tensor
    converged: Tensor
    iterations: Tensor
    association_confidence: Tensor | None = None
    cluster_confidence: Tensor | None = None
    uncertainty: Uncertainty | None = None

    def scaled(self, factor: Tensor) -> Prediction:
        """The same in another unit of length, a factor (B,) a pair."""
        uncertainty = self.uncertainty and self.uncertainty.scaled(factor)
        return replace(self, motions=scale_motions(self.motions, factor), uncertainty=uncertainty)

    def pair(self, b: int, pair: ScanPair) -> PairPrediction:
        """Pair b by beam, its movers numbered 1.. by falling size, the vacuous ones left out."""
        n = len(pair.source)
        given = (self.association_confidence, self.log_association), (self.cluster_confidence, self.log_cluster)
        confidences = [(log.exp().amax(-1) if sure is None else sure)[b, :n].detach().cpu().double().numpy() for sure, log in given]
        return pair_prediction(
            pair,
            self.association[b, :n].cpu().numpy(),
            self.cluster[b, :n].cpu().numpy(),
            self.motions[b].detach().cpu().double().numpy(),
            confidences,
            bool(self.converged[b]),
            self.uncertainty and self.uncertainty.of_pair(b),
        )


def pair_prediction(
    pair: ScanPair,
    association: Ints,
    cluster: Ints,
    motions: Floats,
    confidences: Sequence[Floats],
    converged: bool,
    uncertainty: Uncertainty | None,
) -> PairPrediction:
    """The answer for one pair by beam, its movers numbered 1.. by falling size, the vacuous ones left out.

    Args:
        association: (N,) target point, cluster: (N,); -1 outlier. motions: (C, 3). confidences: (N,) of both.
        uncertainty: of one pair, on the CPU; None: nothing is said of it.
    """
    sizes = np.bincount(cluster[cluster > 0], minlength=len(motions))
    movers = [k for k in np.argsort(-sizes, kind="stable") if k > 0 and sizes[k] > 0]
    number = np.full(len(motions) + 1, -1)  # the last entry keeps -1 at -1
    number[[0, *movers]] = np.arange(len(movers) + 1)
    beam_of_point = np.append(pair.target.beam, -1)
    rows = [0, *movers]
    certainty = {}
    if uncertainty is not None:
        certainty["covariances"] = uncertainty.covariance[0].double().numpy()[rows]
        certainty["unobserved_turn"] = uncertainty.is_turn_unobserved[0].numpy()[rows]
        certainty["unobserved_shift"] = uncertainty.unobserved_shift[0].double().numpy()[rows]
    return PairPrediction(
        association=pair.source.to_beams(beam_of_point[association], -1),
        cluster=pair.source.to_beams(number[cluster], -1),
        motions=motions[rows],
        association_confidence=pair.source.to_beams(confidences[0], 0.0),
        cluster_confidence=pair.source.to_beams(confidences[1], 0.0),
        converged=converged,
        **certainty,
    )
