"""The rounds of whole pairs, one thread per pair, without gradients: from the start to the prediction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.fast.arrays import Decoded, Fitted, Settings
from torchcrf_scan.fast.decode import decode_nothing, decode_pair
from torchcrf_scan.features.learned import LearnedInputs
from torchcrf_scan.inference.start import Start
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.pair import Pair, PairStart, array_of, padded, pair_of
from torchcrf_scan.loops.threads import for_each
from torchcrf_scan.prediction import Prediction, Uncertainty, pair_prediction
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.search.pairs import start_arrays


class Extra(NamedTuple):
    """(N,) log potentials of `features.learned.ExtraLogUnary` for one pair, 0 without learned inputs."""

    outlier: Array
    moving: Array

    def plus_moving(self, log_moving: Array) -> Extra:
        """With more log potential of moving, (N,)."""
        return self._replace(moving=self.moving + log_moving)


def decode_pairs(
    pairs: Sequence[Pair], starts: Sequence[PairStart], extras: Sequence[Extra], fitted: Fitted, settings: Settings
) -> list[Decoded]:
    """Labels, motions and beliefs of every pair."""

    def answer(b: int) -> Decoded:
        pair, start, extra = pairs[b], starts[b], extras[b]
        decode = decode_pair if pair.fewest_points > 0 else decode_nothing
        return decode(pair, start, *extra, fitted, settings)

    return for_each(answer, range(len(pairs)))


def predict(batch: ScanPairBatch, start: Start, fitted: Fitted, settings: Settings, inputs: LearnedInputs | None) -> Prediction:
    """`JointScanCRF.forward` from a start: labels, motions and beliefs of every pair. inputs: without embeddings."""
    pairs = [pair_of(batch, b) for b in range(len(batch))]
    starts = [start_arrays(start, b, pair) for b, pair in enumerate(pairs)]
    extras = extras_of([len(pair.source) for pair in pairs], inputs)
    return prediction_of(decode_pairs(pairs, starts, extras, fitted, settings), batch)


def extras_of(points: Sequence[int], inputs: LearnedInputs | None) -> list[Extra]:
    """The log potentials of pairs with the given numbers of source points."""
    given = (None, None) if inputs is None else (inputs.outlier, inputs.moving)
    return [Extra(*(np.zeros(n) if of is None else array_of(of[b, :n]) for of in given)) for b, n in enumerate(points)]


def prediction_of(answers: Sequence[Decoded], batch: ScanPairBatch) -> Prediction:
    """The results of all pairs of a batch as padded tensors; padding is labelled as outliers, with uniform log-beliefs."""
    N, like = batch.source.shape[1], batch.source
    K = max(answer.candidates.shape[1] for answer in answers)
    D = answers[0].log_cluster.shape[1]

    def stack(name: str) -> Tensor:
        return torch.from_numpy(np.stack([getattr(answer, name) for answer in answers]))

    def pad(name: str, value: float, *shape: int) -> Tensor:
        return padded([getattr(answer, name) for answer in answers], (N, *shape), value)

    log_association = [with_states(answer.log_association, K + 1) for answer in answers]
    return Prediction(
        association=pad("association", -1),
        cluster=pad("cluster", -1),
        motions=stack("motions").to(like),
        active=stack("active"),
        candidates=pad("candidates", 0, K),
        log_association=padded(log_association, (N, K + 1), -math.log(K + 1)).to(like),
        log_cluster=pad("log_cluster", -math.log(D), D).to(like),
        converged=stack("converged"),
        iterations=stack("iterations"),
        association_confidence=pad("association_confidence", 0.0).to(like),
        cluster_confidence=pad("cluster_confidence", 0.0).to(like),
        uncertainty=Uncertainty(*(stack(name).to(like) for name in ("covariance", "information", "directions"))),
    )


def by_beam(answer: Decoded, pair: ScanPair) -> PairPrediction:
    """The prediction of one pair by beam."""
    uncertainty = Uncertainty(
        *(torch.from_numpy(part)[None] for part in (answer.covariance, answer.information, answer.directions))
    )
    confidences = answer.association_confidence, answer.cluster_confidence
    return pair_prediction(
        pair, answer.association, answer.cluster, answer.motions, confidences, bool(answer.converged), uncertainty
    )


def with_states(log_beliefs: Array, states: int) -> Array:
    """(N, S) beliefs with more states, all impossible, before the last one."""
    some = log_beliefs.shape[1] - 1
    if some == states - 1:
        return log_beliefs
    impossible = np.full((len(log_beliefs), states - 1 - some), -np.inf)
    return np.concatenate([log_beliefs[:, :some], impossible, log_beliefs[:, some:]], axis=1)
