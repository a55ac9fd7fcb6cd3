import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import all_real, assert_close, make_points, normal, pad, polar
from torch import Tensor

from torchcrf_scan.features.shape import ORDERS, ShapeDescriptors, describe, gather_points, local_spacing, neighbour_index
from torchcrf_scan.geometry import se2

SEEDS = st.integers(0, 10_000)


def describe_one(points: Tensor, closed: bool = False) -> ShapeDescriptors:
    return describe(points[None], all_real(points)[None], torch.tensor([closed]))


def stacked(shape: ShapeDescriptors) -> Tensor:
    """(B, N, 16) of all descriptors."""
    return torch.cat([shape.distance.flatten(2), shape.geodesic.flatten(2), shape.angle, shape.radius[..., None]], dim=-1)


@given(st.integers(1, 9), st.booleans(), SEEDS)
@settings(max_examples=25)
def test_descriptors_equal_the_loops(n: int, closed: bool, seed: int) -> None:
    points = make_points(n, seed, closed=closed)
    shape, loop = describe_one(points, closed), points.numpy()
    for i, c in np.ndindex(n, len(ORDERS)):
        k = ORDERS[c]
        for s, sign in enumerate((1, -1)):
            assert_close(shape.distance[0, i, c, s], oracles.distance_to(loop, i, sign * k, closed))
            assert_close(shape.geodesic[0, i, c, s], oracles.geodesic_to(loop, i, sign * k, closed))
        turn = float(shape.angle[0, i, c]) - oracles.angle_between(loop, i, k, closed)
        assert oracles.wrap(turn) == pytest.approx(0, abs=1e-9)
    assert_close(shape.radius[0], np.hypot(*loop.T))
    assert (shape.angle >= 0).all()
    assert (shape.angle <= 2 * math.pi).all()


@given(st.integers(1, 8), st.booleans(), st.floats(-3, 3), SEEDS)
def test_a_rigid_motion_changes_the_radius_alone(n: int, closed: bool, theta: float, seed: int) -> None:
    points = make_points(n, seed, closed=closed)
    moved = se2.apply(torch.tensor([theta, 3.0, -2.0], dtype=torch.float64), points)
    before, after = describe_one(points, closed), describe_one(moved, closed)
    assert_close(after.distance, before.distance)
    assert_close(after.geodesic, before.geodesic)
    assert_close(se2.wrap(after.angle - before.angle), torch.zeros(1, n, 3))
    assert (after.radius - before.radius).abs().max() > 1e-3


def test_the_neighbour_of_order_1_is_as_far_along_the_scan() -> None:
    shape = describe_one(make_points(12))
    assert torch.equal(shape.distance[:, :, 0], shape.geodesic[:, :, 0])


def test_ends_are_clamped() -> None:
    points = make_points(4)
    shape = describe_one(points)
    assert not shape.distance[0, 0, :, 1].any()  # nothing before the first point
    assert not shape.geodesic[0, -1, :, 0].any()
    assert_close(shape.distance[0, 0, 2, 0], shape.distance[0, 0, 1, 0])  # the fifth neighbour is the third: the last point
    assert_close(shape.geodesic[0, 0, 2, 0], shape.geodesic[0, 0, 1, 0])
    assert_close(shape.angle[0, [0, -1]], torch.full((2, 3), math.pi, dtype=torch.float64))


def test_a_closed_scan_has_no_ends() -> None:
    points = make_points(15, closed=True)
    turned = describe_one(points.roll(4, 0), closed=True)
    assert_close(stacked(turned), stacked(describe_one(points, closed=True)).roll(4, 1))


def test_a_corner_is_signed() -> None:
    room = torch.tensor([[2.0, -1.0], [2.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
    pillar = torch.tensor([[3.0, -1.0], [2.0, 0.0], [3.0, 1.0]], dtype=torch.float64)
    assert_close(describe_one(room).angle[0, 1, 0], 3 * math.pi / 2)
    assert_close(describe_one(pillar).angle[0, 1, 0], math.pi / 2)


@pytest.mark.parametrize("closed", [False, True])
def test_identical_points_are_straight_and_have_finite_gradients(closed: bool) -> None:
    points = torch.tensor([[1.0, 2.0]] * 3 + [[2.0, 2.0]], dtype=torch.float64, requires_grad=True)
    shape = describe_one(points, closed)
    assert_close(shape.angle[0, 1, 0].detach(), math.pi)
    (gradient,) = torch.autograd.grad(stacked(shape).sum(), points)
    assert gradient.isfinite().all()


@given(st.lists(st.integers(1, 8), min_size=1, max_size=4), st.booleans(), st.integers(0, 3), SEEDS)
@settings(max_examples=25)
def test_padding_and_other_scans_are_invisible(lengths: list[int], closed: bool, extra: int, seed: int) -> None:
    scans = [make_points(n, seed + b, closed=closed) for b, n in enumerate(lengths)]
    padded = [pad(points[None], max(lengths) + extra - len(points)) for points in scans]
    is_closed = torch.tensor([closed if b % 2 == 0 else not closed for b in range(len(scans))])
    together = stacked(describe(torch.cat([p for p, _ in padded]), torch.cat([m for _, m in padded]), is_closed))
    assert together.isfinite().all()
    for b, points in enumerate(scans):
        assert_close(together[b, : len(points)], stacked(describe_one(points, bool(is_closed[b])))[0])


def test_an_empty_scan_is_finite() -> None:
    assert stacked(describe(torch.zeros(1, 1, 2), torch.zeros(1, 1, dtype=torch.bool), torch.tensor([False]))).isfinite().all()


@pytest.mark.parametrize("closed", [False, True])
def test_gradient(closed: bool) -> None:
    points = make_points(8, closed=closed)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda p: stacked(describe(p, all_real(p), torch.tensor([closed]))), points)


def test_neighbour_index() -> None:
    mask = torch.tensor([[True] * 3 + [False], [True] * 4])
    closed = torch.tensor([False, True])
    assert neighbour_index(mask, closed, [2])[0, 0, :3].tolist() == [2, 2, 2]
    assert neighbour_index(mask, closed, [-2])[0, 0, :3].tolist() == [0, 0, 0]
    assert neighbour_index(mask, closed, [2])[1, 0].tolist() == [2, 3, 0, 1]
    assert neighbour_index(mask, closed, [-5])[1, 0].tolist() == [3, 0, 1, 2]
    assert neighbour_index(mask, ~closed, [1])[0, 0, :3].tolist() == [1, 2, 0]  # wraps at the last real point


@given(st.integers(1, 3), st.integers(1, 5), st.integers(0, 4), st.integers(1, 3))
def test_gather_points(B: int, M: int, N: int, K: int) -> None:
    points = normal(B, M, 2)
    index = torch.randint(M, (B, N, K), generator=torch.Generator().manual_seed(0))
    gathered = gather_points(points, index)
    assert gathered.shape == (B, N, K, 2)
    for b, i, k in np.ndindex(B, N, K):
        assert torch.equal(gathered[b, i, k], points[b, index[b, i, k]])


def test_local_spacing_does_not_cross_a_jump() -> None:
    bearings = torch.tensor([-0.2, -0.1, 0.0, 0.1, 0.2], dtype=torch.float64)
    points = polar(torch.tensor([2.0, 2.0, 2.0, 8.0, 8.0], dtype=torch.float64), bearings)
    near, far = 4 * math.sin(0.05), 16 * math.sin(0.05)  # chords
    assert_close(local_spacing(describe_one(points), all_real(points)[None])[0], [near, near, near, far, far])


def test_local_spacing_of_a_point_met_twice() -> None:
    points = torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.5]], dtype=torch.float64)
    assert_close(local_spacing(describe_one(points), all_real(points)[None])[0], [0.5, 0.5, 0.5])


def test_local_spacing_goes_to_the_next_distinct_point() -> None:
    once = make_points(9, 4)
    spacing = local_spacing(describe_one(once), all_real(once)[None])[0]
    for times in (2, 3, 4):
        points = once.repeat_interleave(times, 0)
        assert_close(local_spacing(describe_one(points), all_real(points)[None])[0], spacing.repeat_interleave(times))
