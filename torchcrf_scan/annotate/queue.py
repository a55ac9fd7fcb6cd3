"""The order in which pairs are annotated: those the model is least sure of first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from torchcrf_scan.scan import Floats, PairPrediction, ScanPair


def sureness(pair: ScanPair, prediction: PairPrediction | None) -> Floats:
    """(N,) the lesser confidence, in [0, 1], of each point's association and cluster; 1 without an answer."""
    if prediction is None:
        return np.ones(len(pair.source))
    return np.minimum(prediction.association_confidence, prediction.cluster_confidence)[pair.source.beam]


def confidence_of(pair: ScanPair, prediction: PairPrediction | None) -> float:
    """Mean confidence of a pair's points; 1 for a pair without points, 0 without an answer."""
    return 0.0 if prediction is None else float(np.mean(sureness(pair, prediction))) if len(pair.source) else 1.0


def order(confidences: Mapping[str, float], done: Sequence[str]) -> list[str]:
    """The names of pairs not done, by rising confidence, then those done, the last one last: a ring."""
    left = sorted((name for name in confidences if name not in done), key=lambda name: (confidences[name], name))
    return [*left, *(name for name in done if name in confidences)]
