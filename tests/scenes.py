"""Pairs of scans small enough to enumerate, and what must hold of any answer to them."""

from dataclasses import fields, replace

import numpy as np
import torch
from support import assert_close, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import Scan

MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3], [0.2, -0.2, -1.0]], dtype=torch.float64)
CASES = ("all outliers", "empty source", "empty target", "one point", "duplicates", "background only")


def tiny_scan(points: int) -> Scan:
    """The first few of nine beams return, from a wall four metres away."""
    return Scan.from_ranges(np.where(np.arange(9) < points, 4.0, np.inf), np.linspace(-0.5, 0.5, 9))


def make_batch(source: Tensor, target: Tensor, lengths: tuple[list[int], list[int]] | None = None) -> ScanPairBatch:
    """source: (B, N, 2), target: (B, M, 2); lengths: how many of each scan's points are real."""
    B, N, M = len(source), source.shape[1], target.shape[1]
    n, m = (torch.tensor(count)[:, None] for count in lengths or ([N] * B, [M] * B))
    source_mask, target_mask = torch.arange(N) < n, torch.arange(M) < m
    return ScanPairBatch(
        source=source * source_mask[..., None],
        target=target * target_mask[..., None],
        source_mask=source_mask,
        target_mask=target_mask,
        source_closed=torch.zeros(B, dtype=torch.bool),
        target_closed=torch.zeros(B, dtype=torch.bool),
        dt=torch.full((B,), 0.1).to(source),
        range_noise=torch.full((B,), 0.01).to(source),
        initial_motion=torch.zeros(B, 3).to(source),
    )


def make_start(batch: ScanPairBatch, motions: Tensor, association: Tensor | None = None, active: Tensor | None = None) -> Start:
    """motions: (C, 3), the same for every pair; tangents point across the beam."""
    B, C = len(batch), len(motions)
    motions = motions.to(batch.source).expand(B, C, 3)
    active = torch.ones(B, C, dtype=torch.bool) if active is None else active.expand(B, C)
    if association is None:
        association = nearest_association(batch, motions, active, gate=20.0)
    across = torch.stack([-batch.target[..., 1], batch.target[..., 0]], dim=-1)
    return Start(motions, active, association, torch.nn.functional.normalize(across, dim=-1))


def scene(n: int = 24, movers: int = 2, seed: int = 1) -> tuple[ScanPairBatch, Tensor]:
    """One pair whose points form runs that move as MOTIONS says, a little noisy, and the clusters of its points."""
    source = make_points(n, seed)
    cluster = torch.arange(n) * (2 * movers + 1) // n  # background and movers in turn
    cluster = torch.where(cluster % 2 == 1, (cluster + 1) // 2, 0)
    target = se2.apply(MOTIONS[cluster], source[:, None])[:, 0] + 0.005 * normal(n, 2, seed=seed)
    return make_batch(source[None], target[None]), cluster


def part_of(batch: ScanPairBatch, start: Start, b: int) -> tuple[ScanPairBatch, Start]:
    """Pair b without its padding."""
    n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
    alone = batch[b : b + 1]
    cut = {"source": n, "source_mask": n, "target": m, "target_mask": m}
    alone = replace(alone, **{name: getattr(alone, name)[:, :length] for name, length in cut.items()})
    here = slice(b, b + 1)
    return alone, Start(start.motions[here], start.active[here], start.association[here, :n], start.target_tangents[here, :m])


def assert_same(found: Prediction, expected: Prediction, b: int, n: int) -> None:
    """Pair b of `found` is the only pair of `expected`, n points long."""
    assert found.association[b, :n].tolist() == expected.association[0].tolist()
    assert found.cluster[b, :n].tolist() == expected.cluster[0].tolist()
    assert_close(found.motions[b], expected.motions[0])
    assert_close(found.log_cluster[b, :n], expected.log_cluster[0])
    for name in ("active", "converged", "iterations"):
        assert torch.equal(getattr(found, name)[b], getattr(expected, name)[0]), name


def assert_identical(found: Prediction, expected: Prediction) -> None:
    """Every tensor is the same to the last bit."""
    assert found.uncertainty is not None
    assert expected.uncertainty is not None
    for one, other in ((found, expected), (found.uncertainty, expected.uncertainty)):
        for f in fields(one):
            if f.name != "uncertainty":
                assert torch.equal(getattr(one, f.name), getattr(other, f.name)), f.name


def assert_sane(found: Prediction, batch: ScanPairBatch) -> None:
    """Finite motions, no NaN, labels that exist, beliefs that sum to one."""
    assert found.motions.isfinite().all()
    assert not found.log_association.isnan().any()
    assert not found.log_cluster.isnan().any()
    assert found.active[:, 0].all()
    for log in (found.log_association, found.log_cluster):
        assert_close(log[batch.source_mask].exp().sum(-1), torch.ones(int(batch.source_mask.sum())).double())
    assert (found.association[~batch.source_mask] == -1).all()
    assert (found.cluster[~batch.source_mask] == -1).all()
    assert (found.association < batch.target_mask.sum(-1, keepdim=True)).all()
    chosen = found.active.gather(1, found.cluster.clamp(min=0))
    assert (chosen | (found.cluster < 0)).all()


def poor_scene(name: str) -> tuple[ScanPairBatch, Start]:
    source, target = make_points(7, 1)[None], make_points(6, 2)[None]
    lengths = {"empty source": ([0], [6]), "empty target": ([7], [0]), "one point": ([1], [1])}.get(name, ([7], [6]))
    if name == "duplicates":
        source, target = source[:, :1].expand(1, 7, 2), source[:, :1].expand(1, 6, 2)
    batch = make_batch(source, target, lengths)
    nobody = torch.full((1, 7), -1)
    association = nobody if name == "all outliers" else None
    motions = MOTIONS[:1] if name == "background only" else MOTIONS
    if name == "all outliers":
        motions = motions + torch.tensor([0.0, 500.0, 500.0])
    start = make_start(batch, motions, association)
    return batch, start


def random_stumps(ensemble: StumpEnsemble, seed: int) -> tuple[list[int], list[float], list[float], list[float]]:
    """Fills the ensemble; returns (feature, threshold, left, right)."""
    features, count = ensemble.thresholds.shape
    feature = torch.randint(features, (count,), generator=generator(seed))
    threshold = -9 * torch.rand(count, generator=generator(seed + 1))
    left, right = normal(2, count, seed=seed).float()
    ensemble.set_stumps(feature, threshold, left, right)
    return feature.tolist(), threshold.tolist(), left.tolist(), right.tolist()
