"""Start and gated nearest neighbour: motions without a random field, every point labelled by its nearest target point.

`match_start` uses the motions of InitialiseRT and shows the contribution of the random field; `match_static`
uses the identity. The labels carry no belief: the confidences of valid beams are 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from torchcrf_scan.batch import ScanPairBatch, batches
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import PairPrediction, ScanPair


@torch.no_grad()
def match_start(model: JointScanCRF, pairs: Sequence[ScanPair], batch_size: int = 16) -> list[PairPrediction]:
    """Predictions from `model.initialise` alone: no chains, no iterations. On the model's device and in its dtype."""
    reference = next(model.parameters())
    found = []
    for part in batches(pairs, batch_size):
        batch = ScanPairBatch.collate(part, reference.dtype).without_truth().to(reference.device)
        prediction = label_nearest(batch, model.initialise(batch))
        found += prediction.of_pairs(part)
    return found


@torch.no_grad()
def match_static(pairs: Sequence[ScanPair], batch_size: int = 16) -> list[PairPrediction]:
    """Predictions of a static world and sensor: background everywhere, nearest points inside the gate."""
    found = []
    for part in batches(pairs, batch_size):
        batch = ScanPairBatch.collate(part).without_truth()
        motions = batch.initial_motion.new_zeros(len(batch), 1, 3)
        active = torch.ones(len(batch), 1, dtype=torch.bool)
        start = Start(motions, active, nearest_association(batch, motions, active), torch.zeros_like(batch.target))
        prediction = label_nearest(batch, start)
        found += prediction.of_pairs(part)
    return found


def label_nearest(batch: ScanPairBatch, start: Start) -> Prediction:
    """Keeps the start's associations; the cluster is the active motion that brings the point nearest to its target point.

    C motions give D = C+1 clusters. The beliefs are certain: log-belief 0 of the label, -inf of all others.
    """
    association = start.association
    is_outlier = association < 0  # (B, N)
    motion_count = start.motions.shape[1]
    cluster = nearest_motion(batch, start)
    states = torch.stack([~is_outlier, is_outlier], dim=-1)  # (B, N, 2): the only candidate, outlier
    labels = functional.one_hot(cluster.masked_fill(is_outlier, motion_count), motion_count + 1)  # (B, N, D)
    return Prediction(
        association=association,
        cluster=cluster.masked_fill(is_outlier, -1),
        motions=start.motions,
        active=start.active,
        candidates=association.clamp(min=0)[..., None],  # (B, N, 1)
        log_association=states.to(start.motions).log(),
        log_cluster=labels.to(start.motions).log(),
        converged=torch.ones(len(batch), dtype=torch.bool, device=association.device),
        iterations=torch.zeros(len(batch), dtype=torch.int64, device=association.device),
    )


def nearest_motion(batch: ScanPairBatch, start: Start) -> Tensor:
    """(B, N) the active motion with the smallest residual to the associated target point; the first of equal ones."""
    partner = gather_points(batch.target, start.association.clamp(min=0))  # (B, N, 2)
    moved = se2.apply(start.motions, batch.source[:, None])  # (B, C, N, 2)
    residual = torch.linalg.vector_norm(moved - partner[:, None], dim=-1)  # (B, C, N)
    return residual.masked_fill(~start.active[..., None], torch.inf).argmin(1)
