"""Output of the model: of a batch, as padded tensors, and of one pair, by beam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.batch import scale_motions
from torchcrf_scan.scan import Floats, Ints, PairPrediction, ScanPair
from torchcrf_scan.tree import tensor_tree

LEAST_SHARE = 0.02  # of the largest possible information per point; below it a direction of the motion counts as unobserved


@tensor_tree
@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Uncertainty of the motions of a batch.

    A small deviation from the motion of cluster c is (theta L, x, y): a rotation about the centroid of its moved points, times
    their root mean square distance L from it, then a translation in the target frame; all in metres. `directions` are given in
    these coordinates.

    Attributes:
        covariance: (B, C, 3, 3) of (theta, tx, ty), radians and metres; large but finite where nothing is observed.
        information: (B, C, 3) ascending, information per point about each of the `directions`; 1 = the most that a point can give
            about a translation. No gradient.
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
        """(B, C) bool, whether the rotation is unobserved: no points, one point, a pole, a tube seen from its middle."""
        return self._unobserved[..., 0, 0] > 0.5

    @property
    def unobserved_shift(self) -> Tensor:
        """(B, C, 2) unit vector, in the target frame, of the unobserved translation (along a corridor, along a car's side).

        0 where there is none; if no translation is observed at all, an arbitrary one of the directions.
        """
        values, vectors = torch.linalg.eigh(self._unobserved[..., 1:, 1:])
        return vectors[..., -1] * (values[..., -1:] > 0.5)

    @property
    def _unobserved(self) -> Tensor:
        """(B, C, 3, 3) projection onto the degenerate directions."""
        rows = self.directions * self.degenerate[..., None]
        return rows.mT @ rows

    def scaled(self, factor: Tensor) -> Uncertainty:
        """The same in another unit of length; factor: (B,) scale of each pair."""
        unit = torch.stack([torch.ones_like(factor), factor, factor], -1)[:, None]  # (B, 1, 3)
        return replace(self, covariance=self.covariance * unit[..., None] * unit[..., None, :])

    def inflated(self, factor: Tensor) -> Uncertainty:
        """The same with all covariances multiplied by factor: ()."""
        return replace(self, covariance=self.covariance * factor)

    def of_pair(self, b: int) -> Uncertainty:
        """The uncertainty of pair b alone, without gradient, on the CPU."""
        row = slice(b, b + 1)
        return Uncertainty(*(values[row].detach().cpu() for values in (self.covariance, self.information, self.directions)))


@tensor_tree
@dataclass(frozen=True, slots=True)
class Prediction:
    """Output of the model for a batch; tensors by point, batch first, each with its gradient.

    Integers and booleans have no gradient; no output has one with the schedule `flooding`.

    Attributes:
        association: (B, N) int64 target point, -1 outlier.
        cluster: (B, N) int64 0 background, 1..D-2 movers, -1 outlier.
        motions: (B, D-1, 3) `T_target_source` of background and movers. With soft `motion_weights` the gradient reaches all that
            the beliefs depend on; with hard ones (default) nothing learned, the points alone and, point-to-line, the start's
            motions. Rows that are not active, and all with `motion_metric` given, are the start's. They jump where a cluster
            falls below three points or `min_extent`.
        active: (B, D-1) bool, the clusters that exist. The others' motions are those of the start or of their last points.
        candidates: (B, N, K) int64 target point of every inlier association state.
        log_association: (B, N, K+1) normalised log-beliefs of the association chain, last = outlier; uniform in the padding.
            Differentiable at fixed candidates, 0 where -inf; jumps where a point's candidates change; kinks where the best
            labellings tie, but only at temperature 0.
        log_cluster: (B, N, D) normalised log-beliefs of the clustering chain, last = outlier; likewise; jumps where two clusters
            are merged.
        converged: (B,) bool, whether labels and motions had converged.
        iterations: (B,) int64 number of rounds.
        association_confidence: (B, N) in [0, 1], calibrated probability that the association is within two target points of the
            true one. None: the beliefs themselves. Gradient of the beliefs, at fixed labels; log-beliefs below -50 count as -50.
        cluster_confidence: (B, N) in [0, 1], calibrated. None: the beliefs themselves. Gradient likewise.
        uncertainty: covariances and unobserved directions of the motions; None for methods that do not provide them. Of these the
            covariances have a gradient, which jumps where a direction begins to count as not observed: no good goal of a loss.
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
        """The same in another unit of length; factor: (B,) scale of each pair."""
        uncertainty = self.uncertainty and self.uncertainty.scaled(factor)
        return replace(self, motions=scale_motions(self.motions, factor), uncertainty=uncertainty)

    def of_pairs(self, pairs: Sequence[ScanPair]) -> list[PairPrediction]:
        """Predictions by beam of the pairs that the batch was made of."""
        return [self.pair(b, pair) for b, pair in enumerate(pairs)]

    def pair(self, b: int, pair: ScanPair) -> PairPrediction:
        """Prediction of pair b by beam, its movers numbered 1.. by falling size, without the vacuous ones."""
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
    """The prediction of one pair by beam, its movers numbered 1.. by falling size, without the vacuous ones.

    Args:
        association: (N,) target point, cluster: (N,); -1 outlier. motions: (C, 3). confidences: (N,) of both.
        uncertainty: of one pair, on the CPU; None: not provided.
    """
    sizes = np.bincount(cluster[cluster > 0], minlength=len(motions))
    movers = [k for k in np.argsort(-sizes, kind="stable") if k > 0 and sizes[k] > 0]
    number = np.full(len(motions) + 1, -1)  # the last entry maps -1 to -1
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
