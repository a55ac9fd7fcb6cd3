"""The extensions' features: against plain loops, in both chains, and what must not change them."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
import scenes
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.extension import association_extension, clustering_extension, with_outlier
from torchcrf_scan.features.free_space import FreeSpace
from torchcrf_scan.features.potentials import (
    AssociationStates,
    Boosters,
    PairView,
    association_unary,
    clustering_unary,
    find_candidates,
)
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.names import ASSOCIATION_UNARY, ASSOCIATION_WEIGHTS, CLUSTERING_UNARY, CLUSTERING_WEIGHTS

SEEDS = st.integers(0, 10_000)
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3], [0.2, -0.2, -1.0]], dtype=torch.float64)
OF_ASSOCIATION, OF_CLUSTER = slice(14, ASSOCIATION_UNARY), slice(4, CLUSTERING_UNARY)


def random(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def make_scales() -> Scales:
    scales = Scales().double()
    scales.cluster_distance.fill_(0.4)
    scales.gate.fill_(0.7)
    return scales


def sight(*shape: int, seed: int) -> FreeSpace:
    """Certain of something, of nothing, or in between."""
    return FreeSpace(*((2 * random(*shape, seed=seed + k) - 0.5).clamp(0, 1) for k in range(2)))


def both(of: FreeSpace, *at: int) -> list:
    """[seen through, hidden] of a point, or of it under every motion."""
    return torch.stack([of.seen_through[at], of.hidden[at]], -1).tolist()


# --- the functions ------------------------------------------------------------------------------------------------------------


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 4), SEEDS)
def test_the_associations_equal_the_loops(B: int, N: int, K: int, seed: int) -> None:
    scales, distance, seen = make_scales(), 2 * random(B, N, K, seed=seed), sight(B, N, seed=seed)
    mask = random(B, N, K, seed=seed + 9) < 0.7
    found = association_extension(distance, mask, seen, scales)
    assert found.shape == (B, N, K + 1, 5)
    for b, i in np.ndindex(B, N):
        real = mask[b, i].tolist()
        expected = oracles.association_extension(
            distance[b, i].tolist(), real, both(seen, b, i), float(scales.cluster_distance), float(scales.gate)
        )
        assert_close(found[b, i][[*real, True]], expected[[*real, True]])
    assert found.isfinite().all()


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 4), SEEDS)
def test_the_clusters_equal_the_loops(B: int, N: int, C: int, seed: int) -> None:
    scales, residual = make_scales(), 2 * random(B, N, C, seed=seed)
    ahead, back, is_inlier = sight(B, N, C, seed=seed), sight(B, N, C, seed=seed + 5), random(B, N, seed=seed) < 0.5
    reach = (4 * random(B, N, C, seed=seed + 7) - 1).clamp(0, 3)
    found = clustering_extension(residual, ahead, back, is_inlier, reach, scales)
    assert found.shape == (B, N, C + 1, 9)
    for b, i in np.ndindex(B, N):
        sights = both(ahead, b, i), both(back, b, i)
        inlier, reaches = bool(is_inlier[b, i]), reach[b, i].tolist()
        expected = oracles.clustering_extension(residual[b, i].tolist(), *sights, float(scales.gate), inlier, reaches)
        assert_close(found[b, i], expected)


def test_features_have_the_names_of_their_weights() -> None:
    scales, one, none = make_scales(), torch.ones(1, 1).double(), torch.zeros(1, 1).double()
    association = ASSOCIATION_WEIGHTS[OF_ASSOCIATION]
    distance, mask = torch.tensor([[[0.0, 9.0]]]).double(), torch.ones(1, 1, 2, dtype=torch.bool)
    far = association_extension(distance, mask, FreeSpace(one, none), scales)
    values = [dict(zip(association, row, strict=True)) for row in far[0, 0].round().tolist()]
    assert values[1] == dict.fromkeys(association, 0) | {"excess": -3, "gate": -1}
    assert values[2] == dict.fromkeys(association, 0) | {"outlier_bias": 1, "outlier_seen_through": 1}
    cluster = CLUSTERING_WEIGHTS[OF_CLUSTER]
    nothing, everything = FreeSpace(none[..., None], none[..., None]), FreeSpace(one[..., None], one[..., None])
    is_inlier = torch.ones(1, 1, dtype=torch.bool)
    for ahead, back, inlier, outlier in (
        (everything, nothing, {"seen_through": -1, "hidden": -1}, {"outlier_seen_through": 1, "outlier_hidden": 1}),
        (nothing, everything, {"seen_through_back": -1, "hidden_back": -1}, {}),
    ):
        found = clustering_extension(9 * one[..., None], ahead, back, is_inlier, 2 * one[..., None], scales)[0, 0]
        values = [dict(zip(cluster, row, strict=True)) for row in found.round().tolist()]
        assert values[0] == dict.fromkeys(cluster, 0) | {"gate": -1, "reach": -4} | inlier
        assert values[1] == dict.fromkeys(cluster, 0) | {"outlier_bias": 1} | outlier


def test_an_unreal_candidate_is_nobodys_nearest() -> None:
    distance, mask = torch.tensor([[[0.1, 0.5]]]).double(), torch.tensor([[[False, True]]])
    none = torch.zeros(1, 1).double()
    found = association_extension(distance, mask, FreeSpace(none, none), make_scales())
    assert float(found[0, 0, 1, 0]) == 0
    nobody = association_extension(distance, torch.zeros_like(mask), FreeSpace(none, none), make_scales())
    assert nobody.isfinite().all()


def test_inliers_and_outliers_share_no_feature() -> None:
    found = with_outlier(normal(2, 3, 4, 5), normal(2, 3, 2))
    assert found.shape == (2, 3, 5, 7)
    assert not found[:, :, :-1, 5:].any()
    assert not found[:, :, -1, :5].any()


def test_the_gate_is_half_open_at_the_gate() -> None:
    distance, none = torch.tensor([[[0.5, 0.7, 0.9]]], dtype=torch.float64), torch.zeros(1, 1).double()
    mask = torch.ones(1, 1, 3, dtype=torch.bool)
    found = association_extension(distance, mask, FreeSpace(none, none), make_scales())[0, 0, :3, 1]
    assert_close(found[1], -0.5)
    assert float(found[0]) > -0.01
    assert float(found[2]) < -0.99


# --- in the chains ------------------------------------------------------------------------------------------------------------


def make_batch(seed: int = 0, n: int = 50, m: int = 40) -> ScanPairBatch:
    """One pair that does not fit, so that there is something in front of beams and behind them."""
    return scenes.make_batch(make_points(n, seed)[None], make_points(m, seed + 20)[None])


def features(
    batch: ScanPairBatch,
    motions: Tensor,
    cluster: Tensor,
    association: Tensor,
    candidates: int = 0,
    reach: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Both chains' extensions (1, N, K+1, 5) and (1, N, D, 9) at motions (C, 3) and labels (N,), -1 moved with the background."""
    view, scales, motions, cluster = PairView.of(batch, reach="soft"), make_scales(), motions[None], cluster[None]
    active = torch.ones(motions.shape[:2], dtype=torch.bool)
    found = find_candidates(view, motions, active, InferenceConfig(candidates=candidates))
    states = AssociationStates.of(view, found.index, found.mask, scales, Boosters(1).double())
    own = motions.gather(1, cluster.clamp(min=0)[..., None].expand(-1, -1, 3))
    moved = se2.apply(own, batch.source[:, :, None])[:, :, 0]
    of_association = association_unary(view, states, moved, scales, Boosters(1).double())
    at = clustering.correspond(batch.source, batch.target, motions, found.nearest, association[None])
    of_cluster = clustering_unary(view, at, motions, active, scales, reach_of(batch) if reach is None else reach)
    assert of_association.shape[-1] == ASSOCIATION_UNARY
    assert of_cluster.shape[-1] == CLUSTERING_UNARY
    return of_association[..., OF_ASSOCIATION], of_cluster[..., OF_CLUSTER]


def reach_of(batch: ScanPairBatch) -> Tensor:
    """(1, N, C) from 0 to 3."""
    return (1 + 2 * torch.sin(batch.source.norm(dim=-1)[..., None] + torch.arange(len(MOTIONS)))).clamp(min=0)


def labels(batch: ScanPairBatch, clusters: int = 3, seed: int = 0) -> tuple[Tensor, Tensor]:
    """(N,) clusters and associations, some of them -1."""
    N, M = batch.source.shape[1], batch.target.shape[1]
    return (torch.randint(-1, stop, (N,), generator=generator(seed)) for stop in (clusters, M))  # type: ignore[return-value]


@pytest.mark.parametrize("seed", range(4))
def test_both_chains_look_where_they_should(seed: int) -> None:
    batch, scales = make_batch(seed), make_scales()
    cluster, association = labels(batch, seed=seed)
    found, reach = features(batch, MOTIONS, cluster, association), reach_of(batch)
    source, target, motions = batch.source[0].tolist(), batch.target[0].tolist(), MOTIONS.tolist()
    before, after = ((points, (0.0, 0.0), False, float(batch.range_noise)) for points in (source, target))
    for i, point in enumerate(source):
        moved = [oracles.move(motion, point) for motion in motions]
        own = moved[max(int(cluster[i]), 0)]
        away = [float(np.hypot(own[0] - q[0], own[1] - q[1])) for q in target]
        expected = oracles.association_extension(
            away, [True] * len(target), oracles.look(after, own), float(scales.cluster_distance), float(scales.gate)
        )
        assert_close(found[0][0, i], expected)
        partner = int(association[i])
        met = [oracles.partner(motion, np.array(point), np.array(target), partner) for motion in motions]
        residuals = [float(np.hypot(p[0] - q[0], p[1] - q[1])) for p, q in zip(moved, met, strict=True)]
        back = [oracles.look(before, oracles.invert(motion, target[partner])) for motion in motions]
        ahead = [oracles.look(after, p) for p in moved]
        assert_close(
            found[1][0, i],
            oracles.clustering_extension(residuals, ahead, back, float(scales.gate), partner >= 0, reach[0, i].tolist()),
        )
    for value in found:
        assert (value != 0).flatten(0, 2).any(0).all()  # nothing was left untried


def test_the_order_of_the_movers_is_the_order_of_the_features() -> None:
    batch = make_batch()
    cluster, association = labels(batch)
    order = [0, 2, 1]
    one = features(batch, MOTIONS, cluster, association)
    renamed = torch.tensor([*order, -1])[cluster]  # the permutation is its own inverse
    other = features(batch, MOTIONS[order], renamed, association, reach=reach_of(batch)[..., order])
    assert_close(other[0], one[0])
    assert_close(other[1], one[1][:, :, [*order, 3]])


def test_the_frame_of_the_target_does_not_matter() -> None:
    batch = make_batch()
    cluster, association = labels(batch)
    offset = torch.tensor([[2.5, 4.0, -7.0]]).double()
    one = features(batch, MOTIONS, cluster, association)
    there = batch.displaced(offset)
    assert there.target_origin.tolist() == [[4.0, -7.0]]
    other = features(there, se2.compose(offset.expand(3, 3), MOTIONS), cluster, association)
    for found, expected in zip(other, one, strict=True):
        assert_close(found, expected, tolerance=1e-6)
    left_behind = replace(there, target_origin=torch.zeros(1, 2).double())
    wrong = features(left_behind, se2.compose(offset.expand(3, 3), MOTIONS), cluster, association)
    assert not torch.allclose(wrong[0], one[0], atol=1e-3)


def test_turning_the_source_does_not_matter() -> None:
    batch = make_batch()
    cluster, association = labels(batch)
    turn = torch.tensor([2.5, 0.0, 0.0]).double()
    one = features(batch, MOTIONS, cluster, association)
    turned = replace(batch, source=se2.apply(turn, batch.source[0])[None])
    other = features(turned, se2.compose(MOTIONS, -turn.expand(3, 3)), cluster, association)
    for found, expected in zip(other, one, strict=True):
        assert_close(found, expected, tolerance=1e-6)


def test_padding_is_invisible() -> None:
    batch = make_batch()
    cluster, association = labels(batch)
    one = features(batch, MOTIONS, cluster, association, candidates=4)

    def wider(value: Tensor, fill: float) -> Tensor:
        return torch.cat([value, torch.full_like(value[:, :3], fill)], 1)

    scans = {name: wider(getattr(batch, name), 1.5) for name in ("source", "target")}
    masks = {name: wider(getattr(batch, name), False) for name in ("source_mask", "target_mask")}
    more = torch.tensor([-1, 0, 1])
    other = features(replace(batch, **scans, **masks), MOTIONS, torch.cat([cluster, more]), torch.cat([association, more]), 4)
    for found, expected in zip(other, one, strict=True):
        assert_close(found[:, : batch.source.shape[1]], expected)
        assert found.isfinite().all()


def test_the_gradient_in_the_motions_equals_differences() -> None:
    batch = make_batch()
    cluster, association = labels(batch)
    motions = MOTIONS.clone().requires_grad_()

    def sums(motions: Tensor) -> tuple[Tensor, ...]:
        return tuple((value * normal(*value.shape)).sum((0, 1, 2)) for value in features(batch, motions, cluster, association))

    assert torch.autograd.gradcheck(sums, motions)
