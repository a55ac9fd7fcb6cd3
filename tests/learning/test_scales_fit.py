"""Scales and constants: medians by hand, and the worst tenth of what is true."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.pseudo_likelihood import PlugIns, true_plugins
from torchcrf_scan.learning.scales_fit import CLUSTER_FLOOR, FLOOR, fit_gate, fit_scales, own_motion, robust_scale, true_errors

N = 40
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3]], dtype=torch.float64)


def annotated(noise: float, seed: int = 0, *, outliers: int = 5) -> tuple[PairView, PlugIns]:
    """One pair: background, a mover in its middle, outliers at its end, partners off by `noise`."""
    source = make_points(N, seed)[None]
    cluster = torch.zeros(1, N, dtype=torch.int64)
    cluster[0, 10:20] = 1
    target = se2.apply(MOTIONS[cluster[0]], source[0, :, None])[None, :, 0] + noise * normal(1, N, 2, seed=seed)
    association = torch.arange(N)[None].clone()
    if outliers:
        association[0, -outliers:], cluster[0, -outliers:] = -1, -1
    truth = Truth(association, cluster, MOTIONS[None], torch.ones(1, N, dtype=torch.bool))
    batch = ScanPairBatch(
        source=source,
        target=target,
        source_mask=torch.ones(1, N, dtype=torch.bool),
        target_mask=torch.ones(1, N, dtype=torch.bool),
        source_closed=torch.zeros(1, dtype=torch.bool),
        target_closed=torch.zeros(1, dtype=torch.bool),
        dt=torch.full((1,), 0.1).double(),
        range_noise=torch.full((1,), 0.01).double(),
        initial_motion=torch.zeros(1, 3).double(),
        truth=truth,
    )
    return PairView.of(batch), true_plugins(batch, 3)


def mad(errors: Tensor | np.ndarray) -> float:
    ordered = np.sort(np.abs(np.asarray(errors)))
    return 1.4826 * float(ordered[(len(ordered) - 1) // 2])  # of an even number the lower


@pytest.mark.parametrize(("errors", "expected"), [([], 0.02), ([0.0, 0.0], 0.02), ([-3.0, 1.0, 2.0], 2 * 1.4826), ([0.001], 0.02)])
def test_robust_scale(errors: list[float], expected: float) -> None:
    assert_close(robust_scale(torch.tensor(errors, dtype=torch.float64), 0.02), expected)


def test_scales_are_medians_of_the_true_errors() -> None:
    view, plugins = annotated(0.3)
    scales = fit_scales([view], [plugins])
    batch = view.batch
    inlier = slice(0, N - 5)
    source, partner = batch.source[0, inlier], batch.target[0, inlier]
    residual = torch.linalg.vector_norm(own_motion(plugins, batch.source)[0, inlier] - partner, dim=-1)
    step, partner_step = source.diff(dim=0), partner.diff(dim=0)
    elongation = torch.linalg.vector_norm(partner_step, dim=-1) - torch.linalg.vector_norm(step, dim=-1)
    same = torch.ones(N - 6, dtype=torch.bool)
    same[[9, 19]] = False
    expected = {
        ("local", 9): mad(torch.linalg.vector_norm(source, dim=-1) - torch.linalg.vector_norm(partner, dim=-1)),
        ("local", 10): mad(torch.linalg.vector_norm(source - partner, dim=-1)),
        ("local", 11): mad(residual),
        ("cluster_distance", None): mad(residual),
        ("pairwise", 0): mad(elongation),
        ("pairwise", 1): mad(torch.linalg.vector_norm(step - partner_step, dim=-1)),
        ("neighbour_distance", None): mad(elongation[same]),
        ("neighbour_weight", None): 2 * mad(torch.linalg.vector_norm(step, dim=-1)) / 1.4826,
        ("outlier_threshold", None): max(0.3, 3 * mad(residual)),
    }
    for (name, place), value in expected.items():
        found = getattr(scales, name) if place is None else getattr(scales, name)[place]
        assert_close(found, value)


def errors_of(gate: float, matched: list[float], unmatched: list[float]) -> int:
    """True pairs that a gate keeps out, and outliers that it lets in."""
    return sum(d > gate for d in matched) + sum(d <= gate for d in unmatched)


DISTANCES = st.lists(st.integers(0, 12).map(lambda k: k / 8), max_size=8)  # many of them alike


@given(DISTANCES, DISTANCES)
def test_no_gate_makes_fewer_errors(matched: list[float], unmatched: list[float]) -> None:
    found = float(fit_gate(*(torch.tensor(values, dtype=torch.float64) for values in (matched, unmatched))))
    assert found >= CLUSTER_FLOOR
    least = min(errors_of(gate, matched, unmatched) for gate in (CLUSTER_FLOOR, *matched, *unmatched) if gate >= CLUSTER_FLOOR)
    assert errors_of(found, matched, unmatched) == least


def test_the_gate_is_between_true_pairs_and_outliers() -> None:
    view, plugins = annotated(0.02)
    far = view.batch.target.clone()
    far[0, -5:] += 50.0  # the outliers' former partners are gone
    view = PairView.of(replace(view.batch, target=far))
    errors = true_errors(view, plugins)
    assert len(errors["unmatched"]) == 5
    assert float(fit_scales([view], [plugins]).gate) == pytest.approx(max(float(errors["cluster"].max()), CLUSTER_FLOOR))
    moved = own_motion(plugins, view.batch.source)[0, -5:]
    nearest = torch.cdist(moved, view.batch.target[0]).amin(-1)
    assert_close(errors["unmatched"], nearest, tolerance=1e-6)


def test_shape_scales_are_medians_over_both_sides() -> None:
    view, plugins = annotated(0.3, outliers=0)
    scales = fit_scales([view], [plugins])
    difference = view.source_shape.distance - view.target_shape.distance  # (1, N, 3, 2), partner i is point i
    for order in range(3):
        assert_close(scales.local[order], mad(difference[0, :, order].flatten()))
    turned = se2.wrap(view.source_shape.angle - view.target_shape.angle)
    for order in range(3):
        assert_close(scales.local[3 + order], mad(turned[0, :, order]))


def test_perfect_pairs_stay_on_the_floor() -> None:
    scales = fit_scales(*map(list, zip(annotated(0.0, outliers=0), strict=True)))
    assert_close(scales.local[11], FLOOR)
    assert_close(scales.cluster_distance, CLUSTER_FLOOR)
    assert_close(scales.neighbour_distance, CLUSTER_FLOOR)
    assert_close(scales.outlier_threshold, 0.3)


def test_constants_are_the_worst_tenth_of_the_true_pairs() -> None:
    view, plugins = annotated(0.3)
    scales = fit_scales([view], [plugins])
    batch = view.batch
    residual = torch.linalg.vector_norm(own_motion(plugins, batch.source) - batch.target, dim=-1)[0, : N - 5]
    value = -np.minimum((residual.numpy() / float(scales.local[11])) ** 2, 9.0)
    assert_close(scales.local_outlier[11], float(np.quantile(value, 0.1)), tolerance=1e-4)
    assert ((scales.local_outlier <= 0) & (scales.local_outlier >= -9)).all()
    assert ((scales.pairwise_outlier <= 0) & (scales.pairwise_outlier >= -9)).all()


def test_many_batches_are_one_sample() -> None:
    views, plugins = zip(*(annotated(0.3, seed) for seed in (0, 1, 2)), strict=True)
    together = fit_scales(views, plugins)
    pooled = torch.cat([true_errors(view, plug)["radius"] for view, plug in zip(views, plugins, strict=True)])
    assert_close(together.local[9], mad(pooled))
    assert all(value.isfinite().all() for value in together.state_dict().values())


def test_unknown_points_do_not_count() -> None:
    view, plugins = annotated(0.3)
    truth = view.batch.truth
    assert truth is not None
    known = truth.known.clone()
    known[0, :20] = False
    part = replace(view, batch=replace(view.batch, truth=replace(truth, known=known)))
    counts = {name: len(errors) for name, errors in true_errors(part, replace(plugins, known=known)).items()}
    assert counts["radius"] == counts["angle5"] == counts["cluster"] == N - 25
    assert counts["dist1"] == 2 * (N - 25)
    assert counts["step"] == N - 26


def test_pairs_without_an_association_are_refused() -> None:
    view, plugins = annotated(0.3, outliers=N)
    with pytest.raises(ValueError, match="expected at least one true association"):
        fit_scales([view], [plugins])


def test_one_association_is_enough_for_finite_scales() -> None:
    view, plugins = annotated(0.3, outliers=N - 1)
    scales = fit_scales([view], [plugins])
    assert all(value.isfinite().all() for value in scales.state_dict().values())
    assert_close(scales.neighbour_weight, Scales().neighbour_weight)
