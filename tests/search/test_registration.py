import math

import numpy as np
import oracles_search as oracles
import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from support import assert_close, generator, make_points, normal, polar
from surveyed import any_scan, array, grids, oracle_of, seen
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.search.grid import ROUGHNESS, ScanGrid, grid_of
from torchcrf_scan.search.registration import gauss_newton_step, register, register_both, surface_residual
from torchcrf_scan.search.surface import Surface

SEEDS = st.integers(0, 10_000)
STILL = torch.zeros(1, 3, dtype=torch.float64)
GATES, ALONG = [0.6, 0.6, 0.4, 0.3, 0.2, 0.2, 0.2, 0.2], [1.0, 1.0, 0.5, 0.5, 0.1, 0.1, 0.1, 0.1]
SPOT = torch.tensor([[2.0, 1.0]], dtype=torch.float64)
WALL = torch.stack([torch.linspace(1.0, 4.0, 31, dtype=torch.float64), torch.full((31,), 2.0, dtype=torch.float64)], dim=1).flip(0)
POSITIONS = ["any", "unweighted", "spot", "line"]
POOR = {
    "one point": (SPOT, SPOT + 0.1),
    "two points": (WALL[:2], WALL[5:7]),
    "three points": (WALL[:3], make_points(3, 1)),
    "one spot": (SPOT.expand(9, 2), SPOT.expand(7, 2)),
    "duplicates": (WALL.repeat_interleave(3, 0), WALL[::2].repeat_interleave(2, 0)),
    "collinear": (WALL, WALL + torch.tensor([0.05, 0.0])),
}


def see_corner(motion: Tensor, beams: int = 181) -> Tensor:
    """What a sensor sees of an L of two walls, x = 4 and y = 3, after the scene has moved by `motion` in its frame."""
    bearings = torch.linspace(-0.6, 1.9, beams, dtype=torch.float64)
    direction = torch.stack([bearings.cos(), bearings.sin()], -1)
    back = se2.inverse(motion)
    origin, ray = back[1:], se2.rotate(back[0], direction)  # in the frame of the walls
    reach = torch.where(ray > 1e-9, (torch.tensor([4.0, 3.0]).double() - origin) / ray, torch.inf)
    return polar(reach.amin(-1), bearings)


def corner(motion: Tensor) -> ScanGrid:
    return grid_of(seen(see_corner(motion)))


DAMPING = 1e-6


def residuals(places: Tensor, scan: Surface) -> tuple[Array, Array]:
    """(P,) `surface_residual` and nearest point of places (P, 2)."""
    squared, index = np.empty(len(places)), np.empty(len(places), np.int64)
    surface_residual(array(places.T), grid_of(scan), squared, index)
    return np.sqrt(squared), index


def step_of(moved: Tensor, partner: Tensor, tangent: Tensor, weights: Tensor, along: float) -> Tensor:
    """(3,) one step. moved, partner, tangent: (P, 2); weights: (P,)."""
    pairs = torch.cat([moved.T, partner.T, tangent.T, weights[None]])
    return torch.from_numpy(gauss_newton_step(array(pairs), along, DAMPING))


def registered(source: Tensor, weights: Tensor, target: ScanGrid, starts: Tensor, gates: list[float], along: list[float]) -> Tensor:
    """(H, 3) `register` from starts (H, 3)."""
    return torch.from_numpy(register(array(source), array(weights), target, array(starts), np.array(gates), np.array(along)))


def registered_both(source: ScanGrid, target: ScanGrid, starts: Tensor, gates: list[float], along: list[float]) -> Tensor:
    return torch.from_numpy(register_both(source, target, array(starts), np.array(gates), np.array(along)))


def random_weights(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


@given(any_scan(), SEEDS)
def test_residuals_equal_the_oracle(scan: Surface, seed: int) -> None:
    assume(scan.noise > 0 or scan.spacing.min() > 0)  # else a residual has no unit
    places = torch.from_numpy(scan.points)[:1] + normal(20, 2, seed=seed)
    expected = [oracles.surface_residual(oracle_of(scan), place)[0] for place in places.tolist()]
    assert_close(residuals(places, scan)[0], expected, tolerance=1e-6)  # a root of what is left of two nearly equal squares


def straight_wall() -> Surface:
    """Returns every 0.2 m from y = -2 to 2."""
    y = torch.linspace(-2.0, 2.0, 21, dtype=torch.float64)
    return seen(torch.stack([torch.full_like(y, 4.0), y], -1))


@given(st.floats(-1.5, 1.5), st.floats(-0.3, 0.3))
def test_a_surface_goes_on_between_its_returns(along: float, across: float) -> None:
    wall = straight_wall()
    residual, index = residuals(torch.tensor([[4.0 + across, along]], dtype=torch.float64), wall)
    assert_close(residual, [abs(across) / (ROUGHNESS * 0.2 + 0.02)], tolerance=1e-6)
    assert abs(wall.points[index[0], 1] - along) <= 0.1 + 1e-9


def test_a_surface_ends_half_a_spacing_beyond_its_last_return() -> None:
    wall = straight_wall()
    residual, _ = residuals(torch.tensor([[4.0, 2.5], [4.3, 2.5]], dtype=torch.float64), wall)
    assert_close(residual, [0.4 / 0.04, 0.5 / 0.04], tolerance=1e-6)


def test_a_lonely_return_has_no_direction() -> None:
    pole = seen(torch.tensor([[4.0, 0.0]]))
    residual, _ = residuals(torch.tensor([[4.0, 0.3], [4.3, 0.0]], dtype=torch.float64), pole)
    assert_close(residual, [0.3 / (pole.spacing[0] / 2 + 0.02)] * 2)


# One step.


@given(st.floats(0, 1), SEEDS)
def test_a_step_solves_the_linear_least_squares(along: float, seed: int) -> None:
    moved, partner, weights = normal(8, 2, seed=seed), normal(8, 2, seed=seed), 0.2 + random_weights(8, seed=seed)
    partner = partner + 0.05 * normal(8, 2, seed=seed + 1)
    facing = 7 * random_weights(8, seed=seed + 2)
    tangent = torch.stack([facing.cos(), facing.sin()], -1)
    centre = (weights[:, None] * moved).sum(0) / weights.sum()
    rows, right = [], []
    for p, q, t, w in zip(moved.numpy(), partner.numpy(), tangent.numpy(), weights.tolist(), strict=True):
        lever = p - centre.numpy()
        jacobian = np.array([[-lever[1], 1, 0], [lever[0], 0, 1]])  # of the moved point with respect to (theta, x, y)
        for axis, share in ((np.array([-t[1], t[0]]), 1.0), (t, along)):
            rows.append(math.sqrt(w * share) * axis @ jacobian)
            right.append(math.sqrt(w * share) * axis @ (q - p))
    theta, dx, dy = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    step = step_of(moved, partner, tangent, weights, along)
    assert step.shape == (3,)
    shift = se2.apply(step, centre[None])[0] - centre
    assert_close(torch.stack([step[0], *shift]), [theta, dx, dy], tolerance=2e-3)  # the step is slightly damped


def test_a_step_point_to_point_is_nearly_the_closed_form() -> None:
    source, weights = normal(20, 2), 0.1 + random_weights(20, seed=1)
    motion = torch.tensor([0.02, 0.03, -0.04], dtype=torch.float64)
    partner = se2.apply(motion, source) + 0.01 * normal(20, 2, seed=2)
    step = step_of(source, partner, torch.zeros(20, 2).double(), weights, 1.0)
    assert_close(step, kabsch(source, partner, weights), tolerance=1e-3)


def test_point_to_line_does_not_care_for_sliding() -> None:
    wall = torch.stack([torch.full((11,), 4.0), torch.linspace(-1, 1, 11)], -1).double()
    tangent = torch.tensor([0.0, 1.0], dtype=torch.float64).expand(11, 2)
    slid = wall + torch.tensor([0.1, 0.5])
    weights = torch.ones(11, dtype=torch.float64)
    assert_close(step_of(wall, slid, tangent, weights, 0.0), [0.0, 0.1, 0.0], tolerance=1e-3)
    assert_close(step_of(wall, slid, tangent, weights, 1.0), [0.0, 0.1, 0.5], tolerance=1e-3)


@pytest.mark.parametrize(("points", "weight"), [(1, 1.0), (5, 0.0), (2, 1.0)])
def test_a_step_from_too_little_is_finite(points: int, weight: float) -> None:
    moved = normal(points, 2)
    weights = torch.full((points,), weight, dtype=torch.float64)
    step = step_of(moved, moved + 0.1, torch.zeros_like(moved), weights, 1.0)
    assert step.isfinite().all()
    expected = [0.0, 0.1 * weight, 0.1 * weight]
    assert_close(step, expected, tolerance=1e-3)


def test_a_turn_is_limited() -> None:
    points = normal(10, 2)
    turned = se2.rotate(torch.tensor(1.5), points)
    assert_close(step_of(points, turned, torch.zeros_like(points), torch.ones(10).double(), 1.0)[0], 0.5)


@given(
    st.sampled_from([1, 2, 3, 8, 50]),
    st.sampled_from([0.0, 0.03, 0.3, 1.0]),
    st.sampled_from(["any", "none", "spot", "line"]),
    SEEDS,
)
def test_a_step_solves_the_damped_normal_equations(count: int, along: float, kind: str, seed: int) -> None:
    moved, partner, tangent = normal(3, count, 2, seed=seed)
    tangent = torch.nn.functional.normalize(tangent, dim=-1)
    tangent[::4] = 0  # a lonely return has none
    weights = 0.01 + random_weights(count, seed=seed)
    if kind == "unweighted":
        weights = 0 * weights
    if kind == "spot":
        moved = moved[:1].expand(count, 2)
    if kind == "line":
        moved, tangent = moved[:1] + torch.arange(count)[:, None] * tangent[-1:], tangent[-1:].expand(count, 2)
    step = step_of(moved, partner, tangent, weights, along)
    expected = oracles.gauss_newton_step(*(values.numpy() for values in (moved, partner, tangent, weights)), along, DAMPING)
    assert_close(step, expected, tolerance=1e-6 if kind == "spot" else 1e-9)  # damping alone holds the turn about a spot


# Registration.


@given(st.floats(-0.06, 0.06), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15))
@settings(max_examples=20)
def test_it_recovers_a_small_motion(theta: float, tx: float, ty: float) -> None:
    motion = torch.tensor([theta, tx, ty], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    found = registered(source, torch.ones(len(source)).double(), target, STILL, GATES * 2, ALONG[:4] * 2 + [0.0] * 8)
    rotation, translation = se2.distance(found[0], motion)
    assert float(rotation) < 2e-3
    assert float(translation) < 5e-3


def test_identical_scans_stay() -> None:
    target = corner(torch.zeros(3).double())
    found = registered(torch.from_numpy(target.scan.points), torch.ones(len(target.features)).double(), target, STILL, GATES, ALONG)
    assert_close(found, STILL, tolerance=1e-12)


def test_points_far_from_everything_have_little_say() -> None:
    motion = torch.tensor([0.02, 0.1, -0.05], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    dirty = torch.cat([source, 0.3 * normal(20, 2)])  # 3 m before the walls
    found = registered(dirty, torch.ones(len(dirty)).double(), target, STILL, GATES, ALONG)
    assert float(se2.distance(found[0], motion)[1]) < 0.02


def test_hypotheses_do_not_know_of_each_other() -> None:
    motion = torch.tensor([0.02, 0.1, -0.05], dtype=torch.float64)
    source, target = see_corner(torch.zeros(3).double()), corner(motion)
    starts, weights = 0.05 * normal(4, 3), random_weights(len(source), seed=0)
    together = registered(source, weights, target, starts, GATES, ALONG)
    for h in range(4):
        assert_close(together[h], registered(source, weights, target, starts[h : h + 1], GATES, ALONG)[0])


def test_no_weight_and_no_iteration_keep_the_start() -> None:
    source, starts = see_corner(torch.zeros(3).double()), 0.1 * normal(2, 3)
    target = corner(torch.zeros(3).double())
    assert_close(registered(source, torch.zeros(len(source)).double(), target, starts, GATES, ALONG), starts)
    assert torch.equal(registered(source, torch.ones(len(source)).double(), target, starts, [], []), starts)


@pytest.mark.parametrize("scene", POOR)
def test_registering_the_least_of_scans(scene: str) -> None:
    here, there = grids(*(seen(points) for points in POOR[scene]))
    starts = normal(6, 3) * torch.tensor([0.1, 0.4, 0.4], dtype=torch.float64)
    assert registered_both(here, there, starts, [3.0, 1.5], [0.3, 0.03]).isfinite().all()
    assert registered(POOR[scene][0], torch.ones(len(POOR[scene][0])), there, starts, GATES, ALONG).isfinite().all()


@pytest.mark.parametrize("scene", ["one point", "two points", "three points", "collinear", "corner"])  # where no two are nearest
def test_registration_is_steps_of_nearest_points(scene: str) -> None:
    """Every iteration: nearest points, robust weights, one step; `register_both` in both directions at once."""
    scans = [see_corner(0 * STILL[0]), see_corner(torch.tensor([0.02, 0.1, -0.05]).double())] if scene == "corner" else POOR[scene]
    source, target = (oracle_of(seen(points)) for points in scans)
    starts = normal(2, 3) * torch.tensor([0.1, 0.4, 0.4], dtype=torch.float64)
    weights, gates, along = 0.1 + random_weights(len(source), seed=1), [0.6, 0.3], [1.0, 0.1]
    here, there = grids(*(seen(points) for points in scans))
    one_way = registered(scans[0], weights, there, starts, gates, along)
    both = registered_both(here, there, starts, [3.0, 1.5], [0.3, 0.03])
    for h, start in enumerate(starts.numpy()):
        assert_close(one_way[h], oracles.register(source.points, weights.numpy(), target, start, gates, along), tolerance=1e-7)
        assert_close(both[h], oracles.register_both(source, target, start, [3.0, 1.5], [0.3, 0.03]), tolerance=1e-7)


@given(st.floats(-0.03, 0.03), st.floats(-0.08, 0.08), st.floats(-0.08, 0.08))
@example(0.03, 0.08, 0.08)
@example(-0.03, -0.08, 0.08)
@settings(max_examples=6)
def test_both_scans_on_each_other(theta: float, tx: float, ty: float) -> None:
    motion = torch.tensor([theta, tx, ty], dtype=torch.float64)
    source, target = corner(torch.zeros(3).double()), corner(motion)
    gates, along = [5.0, 4.0, 3.0, 2.0, 2.0, 2.0, 2.0, 2.0], [0.5, 0.3, 0.1, 0.1, 0.03, 0.03, 0.03, 0.03]
    there = registered_both(source, target, STILL, gates, along)
    rotation, translation = se2.distance(there[0], motion)
    assert float(rotation) < 2e-3
    assert float(translation) < 5e-3
    back = registered_both(target, source, STILL, gates, along)
    assert_close(se2.inverse(back), there, tolerance=5e-3)  # neither scan is the first one
