import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import assert_close, generator, normal, polar
from torch import Tensor
from torchcrf_scan.inference.registration import nearest_points, register, register_both, surface_residual
from torchcrf_scan.inference.surface import Surface

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference.motion import gauss_newton_step
from torchcrf_scan.search.grid import ROUGHNESS

SEEDS = st.integers(0, 10_000)
STILL = torch.zeros(1, 3, dtype=torch.float64)
NOISE = torch.tensor(0.01, dtype=torch.float64)
GATES, ALONG = [0.6, 0.6, 0.4, 0.3, 0.2, 0.2, 0.2, 0.2], [1.0, 1.0, 0.5, 0.5, 0.1, 0.1, 0.1, 0.1]


def see_corner(motion: Tensor, beams: int = 181) -> Tensor:
    """What a sensor sees of an L of two walls, x = 4 and y = 3, after the scene has moved by `motion` in its frame."""
    bearings = torch.linspace(-0.6, 1.9, beams, dtype=torch.float64)
    direction = torch.stack([bearings.cos(), bearings.sin()], -1)
    back = se2.inverse(motion)
    origin, ray = back[1:], se2.rotate(back[0], direction)  # in the frame of the walls
    reach = torch.where(ray > 1e-9, (torch.tensor([4.0, 3.0]).double() - origin) / ray, torch.inf)
    return polar(reach.amin(-1), bearings)


def corner(motion: Tensor) -> Surface:
    return Surface.of(see_corner(motion), torch.tensor(0.01, dtype=torch.float64), False)


def random_weights(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


@given(st.integers(1, 6), st.integers(1, 6), SEEDS)
def test_nearest_points(P: int, M: int, seed: int) -> None:
    moved, target = normal(2, P, 2, seed=seed), normal(M, 2, seed=seed + 1)
    surface = Surface.of(target, torch.tensor(0.01, dtype=torch.float64), False)
    distance, index = nearest_points(moved, surface)
    assert distance.shape == index.shape == (2, P)
    for h, i in np.ndindex(2, P):
        apart = [math.dist(moved[h, i].tolist(), q) for q in target.tolist()]
        assert_close(distance[h, i], min(apart))
        assert index[h, i].item() == apart.index(min(apart))


def straight_wall() -> Surface:
    """Returns every 0.2 m from y = -2 to 2."""
    y = torch.linspace(-2.0, 2.0, 21, dtype=torch.float64)
    return Surface.of(torch.stack([torch.full_like(y, 4.0), y], -1), NOISE, False)


@given(st.floats(-1.5, 1.5), st.floats(-0.3, 0.3))
def test_a_surface_goes_on_between_its_returns(along: float, across: float) -> None:
    wall = straight_wall()
    residual, index = surface_residual(torch.tensor([[4.0 + across, along]], dtype=torch.float64), wall)
    assert_close(residual, [abs(across) / (ROUGHNESS * 0.2 + 0.02)], tolerance=1e-6)
    assert abs(float(wall.points[index, 1]) - along) <= 0.1 + 1e-9


def test_a_surface_ends_half_a_spacing_beyond_its_last_return() -> None:
    wall = straight_wall()
    residual, _ = surface_residual(torch.tensor([[4.0, 2.5], [4.3, 2.5]], dtype=torch.float64), wall)
    assert_close(residual, [0.4 / 0.04, 0.5 / 0.04], tolerance=1e-6)


def test_a_lonely_return_has_no_direction() -> None:
    pole = Surface.of(torch.tensor([[4.0, 0.0]]).double(), NOISE, False)
    residual, _ = surface_residual(torch.tensor([[4.0, 0.3], [4.3, 0.0]], dtype=torch.float64), pole)
    assert_close(residual, [0.3 / (float(pole.spacing) / 2 + 0.02)] * 2)


# One step.


@given(st.floats(0, 1), SEEDS)
def test_a_step_solves_the_linear_least_squares(along: float, seed: int) -> None:
    moved, partner, weights = normal(1, 8, 2, seed=seed), normal(1, 8, 2, seed=seed), 0.2 + random_weights(1, 8, seed=seed)
    partner = partner + 0.05 * normal(1, 8, 2, seed=seed + 1)
    facing = 7 * random_weights(1, 8, seed=seed + 2)
    tangent = torch.stack([facing.cos(), facing.sin()], -1)
    centre = (weights[0, :, None] * moved[0]).sum(0) / weights.sum()
    rows, right = [], []
    for p, q, t, w in zip(moved[0].numpy(), partner[0].numpy(), tangent[0].numpy(), weights[0].tolist(), strict=True):
        lever = p - centre.numpy()
        jacobian = np.array([[-lever[1], 1, 0], [lever[0], 0, 1]])  # of the moved point with respect to (theta, x, y)
        for axis, share in ((np.array([-t[1], t[0]]), 1.0), (t, along)):
            rows.append(math.sqrt(w * share) * axis @ jacobian)
            right.append(math.sqrt(w * share) * axis @ (q - p))
    theta, dx, dy = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    step = gauss_newton_step(moved, partner, tangent, weights, along)
    assert step.shape == (1, 3)
    shift = se2.apply(step[0], centre[None])[0] - centre
    assert_close(torch.stack([step[0, 0], *shift]), [theta, dx, dy], tolerance=2e-3)  # the step is slightly damped


def test_a_step_point_to_point_is_nearly_the_closed_form() -> None:
    source, weights = normal(1, 20, 2), 0.1 + random_weights(1, 20, seed=1)
    motion = torch.tensor([0.02, 0.03, -0.04], dtype=torch.float64)
    partner = se2.apply(motion, source) + 0.01 * normal(1, 20, 2, seed=2)
    step = gauss_newton_step(source, partner, torch.zeros(1, 20, 2).double(), weights, 1.0)
    assert_close(step, kabsch(source, partner, weights), tolerance=1e-3)


def test_point_to_line_does_not_care_for_sliding() -> None:
    wall = torch.stack([torch.full((11,), 4.0), torch.linspace(-1, 1, 11)], -1).double()[None]
    tangent = torch.tensor([0.0, 1.0], dtype=torch.float64).expand(1, 11, 2)
    slid = wall + torch.tensor([0.1, 0.5])
    weights = torch.ones(1, 11, dtype=torch.float64)
    assert_close(gauss_newton_step(wall, slid, tangent, weights, 0.0), [[0.0, 0.1, 0.0]], tolerance=1e-3)
    assert_close(gauss_newton_step(wall, slid, tangent, weights, 1.0), [[0.0, 0.1, 0.5]], tolerance=1e-3)


@pytest.mark.parametrize(("points", "weight"), [(1, 1.0), (5, 0.0), (2, 1.0)])
def test_a_step_from_too_little_is_finite(points: int, weight: float) -> None:
    moved = normal(1, points, 2)
    weights = torch.full((1, points), weight, dtype=torch.float64)
    step = gauss_newton_step(moved, moved + 0.1, torch.zeros_like(moved), weights, 1.0)
    assert step.isfinite().all()
    expected = [[0.0, 0.1 * weight, 0.1 * weight]]
    assert_close(step, expected, tolerance=1e-3)


def test_a_turn_is_limited() -> None:
    points = normal(1, 10, 2)
    step = gauss_newton_step(
        points, se2.rotate(torch.tensor(1.5), points), torch.zeros_like(points), torch.ones(1, 10).double(), 1.0
    )
    assert_close(step[0, 0], 0.5)


# Registration.


@given(st.floats(-0.06, 0.06), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15))
@settings(max_examples=20)
def test_it_recovers_a_small_motion(theta: float, tx: float, ty: float) -> None:
    motion = torch.tensor([theta, tx, ty], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    found = register(source, torch.ones(len(source)).double(), target, STILL, GATES * 2, ALONG[:4] * 2 + [0.0] * 8)
    rotation, translation = se2.distance(found[0], motion)
    assert float(rotation) < 2e-3
    assert float(translation) < 5e-3


def test_identical_scans_stay() -> None:
    target = corner(torch.zeros(3).double())
    found = register(target.points, torch.ones(len(target)).double(), target, STILL, GATES, ALONG)
    assert_close(found, STILL, tolerance=1e-12)


def test_points_far_from_everything_have_little_say() -> None:
    motion = torch.tensor([0.02, 0.1, -0.05], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    dirty = torch.cat([source, 0.3 * normal(20, 2)])  # 3 m before the walls
    found = register(dirty, torch.ones(len(dirty)).double(), target, STILL, GATES, ALONG)
    assert float(se2.distance(found[0], motion)[1]) < 0.02


def test_hypotheses_do_not_know_of_each_other() -> None:
    motion = torch.tensor([0.02, 0.1, -0.05], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    starts, weights = 0.05 * normal(4, 3), random_weights(4, len(source), seed=0)
    together = register(source, weights, target, starts, GATES, ALONG)
    shared = register(source, weights[0], target, starts, GATES, ALONG)
    for h in range(4):
        assert_close(together[h], register(source, weights[h : h + 1], target, starts[h : h + 1], GATES, ALONG)[0])
        assert_close(shared[h], register(source, weights[0], target, starts[h : h + 1], GATES, ALONG)[0])


def test_no_weight_and_no_iteration_keep_the_start() -> None:
    source, starts = see_corner(torch.zeros(3).double()), 0.1 * normal(2, 3)
    target = corner(torch.zeros(3).double())
    assert_close(register(source, torch.zeros(len(source)).double(), target, starts, GATES, ALONG), starts)
    assert torch.equal(register(source, torch.ones(len(source)).double(), target, starts, [], []), starts)


def test_gates_and_slacks_come_in_pairs() -> None:
    source, target = see_corner(torch.zeros(3).double()), corner(torch.zeros(3).double())
    with pytest.raises(ValueError, match="zip"):
        register(source, torch.ones(len(source)).double(), target, STILL, [0.1], [])


@given(st.floats(-0.03, 0.03), st.floats(-0.08, 0.08), st.floats(-0.08, 0.08))
@settings(max_examples=20)
def test_both_scans_on_each_other(theta: float, tx: float, ty: float) -> None:
    motion = torch.tensor([theta, tx, ty], dtype=torch.float64)
    source, target = corner(torch.zeros(3).double()), corner(motion)
    gates, along = [5.0, 4.0, 3.0, 2.0, 2.0, 2.0, 2.0, 2.0], [0.5, 0.3, 0.1, 0.1, 0.03, 0.03, 0.03, 0.03]
    there = register_both(source, target, STILL, gates, along)
    rotation, translation = se2.distance(there[0], motion)
    assert float(rotation) < 2e-3
    assert float(translation) < 5e-3
    back = register_both(target, source, STILL, gates, along)
    assert_close(se2.inverse(back), there, tolerance=5e-3)  # neither scan is the first one
