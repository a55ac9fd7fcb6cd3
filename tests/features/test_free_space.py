"""What beams say of points: against plain loops, at the ends of a scan and round it, with little in it, and its derivatives."""

import math
from dataclasses import fields

import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import all_real, assert_close, generator, make_points, pad, polar
from torch import Tensor

from torchcrf_scan.features.free_space import FreeSpace, Sweep, look
from torchcrf_scan.geometry import se2
from torchcrf_scan.search.surface import OCCLUDED, SEEN_THROUGH, look_along, surface_of

SEEDS = st.integers(0, 10_000)
ANGLES = st.floats(-math.pi, math.pi)
SCAN = st.tuples(st.integers(1, 6) | st.integers(50, 90), st.booleans(), ANGLES, st.sampled_from([0.0, 0.01, 0.3]), SEEDS)
NOWHERE = torch.zeros(1, 2).double()


def sweep(points: Tensor, *, closed: bool = False, noise: float = 0.01, origin: Tensor = NOWHERE[0], extra: int = 0) -> Sweep:
    """One scan (N, 2), with some padding behind it."""
    padded, mask = pad(points[None], extra)
    return Sweep.of(padded, mask, torch.tensor([closed]), torch.tensor([noise], dtype=torch.float64), origin[None])


def make_scan(n: int, turn: float, seed: int, *, closed: bool = False) -> tuple[Tensor, Tensor]:
    """Points that begin anywhere on the circle, and where the sensor stands: anywhere."""
    placed = torch.cat([torch.tensor([turn]).double(), 3 * torch.rand(2, generator=generator(seed), dtype=torch.float64)])
    return se2.apply(placed, make_points(n, seed, closed=closed)), placed[1:]


def queries(points: Tensor, origin: Tensor, seed: int, count: int = 25) -> Tensor:
    """(P, 2): in front of the points, about where they are, behind them, and anywhere."""
    random = torch.rand(2, len(points), generator=generator(seed + 1), dtype=torch.float64)
    aside = se2.rotate(0.1 * (random[0, :, None] - 0.5), (points - origin)[:, None])[:, 0]
    near = origin + (0.3 + 1.4 * random[1])[:, None] * aside
    return torch.cat([near, origin + 14 * torch.rand(count, 2, generator=generator(seed), dtype=torch.float64) - 7])


def of_oracle(points: Tensor, origin: Tensor, noise: float, asked: Tensor, *, closed: bool) -> list[tuple[float, float]]:
    return [oracles.look((points.tolist(), origin.tolist(), closed, noise), point) for point in asked.tolist()]


@given(SCAN, st.integers(0, 3))
def test_it_equals_the_loops(scan: tuple[int, bool, float, float, int], extra: int) -> None:
    n, closed, turn, noise, seed = scan
    closed = closed and n > 2
    points, origin = make_scan(n, turn, seed, closed=closed)
    asked = queries(points, origin, seed)
    found = look(sweep(points, closed=closed, noise=noise, origin=origin, extra=extra), asked[None])
    expected = of_oracle(points, origin, noise, asked, closed=closed)
    assert_close(found.seen_through[0], [seen for seen, _ in expected])
    assert_close(found.hidden[0], [hidden for _, hidden in expected])


def wall(n: int = 9, reach: float = 4.0) -> Tensor:
    """An arc of returns at one range, ahead and to both sides, one degree apart."""
    return polar(torch.full((n,), reach).double(), torch.deg2rad(torch.arange(n).double() - n // 2))


@pytest.mark.parametrize(
    ("ranges", "bearing", "seen", "hidden"),
    [
        (1.0, 0.3, 1, 0),  # the beams went on past it
        (4.0, 0.3, 0, 0),  # they end there
        (8.0, 0.3, 0, 1),  # they end before it
        (1.0, 4.4, 1, 0),  # half a step beyond the last beam still counts as seen,
        (1.0, 4.6, 0, 1),  # more is where the sensor does not look
        (8.0, -4.6, 0, 1),
        (1.0, 180.0, 0, 1),
    ],
)
@pytest.mark.parametrize("turned", [0.0, 90.0, 179.0, 181.0, 184.2])
def test_points_before_on_and_behind_an_arc(ranges: float, bearing: float, seen: int, hidden: int, turned: float) -> None:
    about = torch.deg2rad(torch.tensor([turned, 0.0, 0.0]).double())
    point = polar(torch.tensor([ranges]).double(), torch.deg2rad(torch.tensor([bearing]).double()))
    found = look(sweep(se2.apply(about, wall())), se2.apply(about, point)[None])
    assert (found.seen_through.item(), found.hidden.item()) == (seen, hidden)


def test_nothing_is_known_in_a_gap() -> None:
    points = wall(15)[[0, 1, 2, 3, 4, 10, 11, 12, 13, 14]]
    for ranges in (1.0, 8.0):
        found = look(sweep(points), torch.tensor([[[ranges, 0.0]]]).double())
        assert (found.seen_through.item(), found.hidden.item()) == (0, 0)


def test_at_an_edge_between_two_surfaces_either_may_be_there() -> None:
    points = torch.cat([wall()[:4], 2 * wall()[4:]])
    found = look(sweep(points), polar(torch.tensor([2.0, 6.0, 12.0]).double(), torch.deg2rad(torch.tensor([-0.5]).double()))[None])
    assert found.seen_through[0].tolist() == [1, 0, 0]
    assert found.hidden[0].tolist() == [0, 0, 1]


def test_a_closed_scan_has_no_end() -> None:
    ring = polar(torch.full((72,), 4.0).double(), torch.deg2rad(5 * torch.arange(72).double() - 177))
    behind = torch.tensor([[[-2.0, -0.01], [-2.0, 0.01], [-20.0, 0.0]]]).double()
    found = look(sweep(ring, closed=True), behind)
    assert found.seen_through[0].tolist() == [1, 1, 0]
    assert found.hidden[0].tolist() == [0, 0, 1]


@given(st.lists(st.sampled_from([0, 1, 2, 6, 50, 60]), min_size=1, max_size=4), SEEDS)
def test_a_batch_is_its_scans_and_padding_is_invisible(lengths: list[int], seed: int) -> None:
    B, N = len(lengths), max(1, *lengths) + 1
    points, origins = (torch.stack(of) for of in zip(*(make_scan(N, b, seed + b) for b in range(B)), strict=True))
    mask = torch.arange(N) < torch.tensor(lengths)[:, None]
    asked = 14 * torch.rand(B, 5, 2, 2, generator=generator(seed), dtype=torch.float64) - 7
    rest = torch.zeros(B, dtype=torch.bool), torch.full((B,), 0.01, dtype=torch.float64), origins
    together = look(Sweep.of(points, mask, *rest), asked)
    other = look(Sweep.of(torch.where(mask[..., None], points, 77.0), mask, *rest), asked)
    for b, n in enumerate(lengths):
        expected = of_oracle(points[b, :n], origins[b], 0.01, asked[b].flatten(0, 1), closed=False)
        assert_close(together.seen_through[b].flatten(), [seen for seen, _ in expected])
        assert_close(together.hidden[b].flatten(), [hidden for _, hidden in expected])
    for f in fields(FreeSpace):
        assert torch.equal(getattr(other, f.name), getattr(together, f.name))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("real", [0, 1, 2])
def test_scans_with_little_in_them_are_finite(real: int, padding: int, dtype: torch.dtype) -> None:
    points, mask = pad(make_points(max(real, 1), 3)[None].to(dtype), padding)
    mask = mask & (torch.arange(mask.shape[1]) < real)
    scan = Sweep.of(points, mask, torch.tensor([False]), torch.zeros(1, dtype=dtype), NOWHERE.to(dtype))
    asked = torch.cat([points[:, :1], points[:, :1] / 2, points[:, :1] * 2, -points[:, :1], NOWHERE[None].to(dtype)], 1)
    asked.requires_grad_()
    found = look(scan, asked)
    for value in (found.seen_through, found.hidden):
        assert value.dtype == dtype
        assert ((value >= 0) & (value <= 1)).all()
    if real == 0:
        assert not found.seen_through.any()
        assert not found.hidden.any()
    if real == 1:
        assert found.seen_through[0, :4].tolist() == [0, 1, 0, 0]
        assert found.hidden[0, :4].tolist() == [0, 0, 1, 1]
    (found.seen_through.sum() + found.hidden.sum()).backward()
    assert asked.grad is not None
    assert asked.grad.isfinite().all()


def test_points_on_one_spot_are_finite() -> None:
    spot = wall()[:1].expand(5, 2)
    found = look(sweep(spot, noise=0.0), torch.cat([spot[:1], spot[:1] / 2])[None])
    assert found.seen_through.isfinite().all()
    assert found.hidden.isfinite().all()


def test_the_gradient_equals_differences_away_from_kinks() -> None:
    points, origin = make_scan(40, 2.0, 5)
    scan, asked = sweep(points, noise=0.1, origin=origin), queries(points, origin, 6)
    found = look(scan, asked[None])
    on_slope = ((found.seen_through > 0.01) & (found.seen_through < 0.99))[0] | ((found.hidden > 0.01) & (found.hidden < 0.99))[0]
    assert int(on_slope.sum()) > 5
    inputs = asked[on_slope][None].clone().requires_grad_()

    def answers(asked: Tensor) -> tuple[Tensor, Tensor]:
        found = look(scan, asked)
        return found.seen_through, found.hidden

    assert torch.autograd.gradcheck(answers, inputs)
    (slope,) = torch.autograd.grad(sum(answer.sum() for answer in answers(inputs)), inputs)
    assert (slope.abs().sum(-1) > 0).all()


@given(SCAN)
def test_it_says_yes_where_the_flags_of_the_start_do(scan: tuple[int, bool, float, float, int]) -> None:
    n, closed, turn, noise, seed = scan
    closed = closed and n > 2
    points, origin = make_scan(n, turn, seed, closed=closed)
    asked = queries(points, origin, seed)
    found = look(sweep(points, closed=closed, noise=noise, origin=origin), asked[None])
    surface = surface_of(points.contiguous().numpy(), noise, closed, origin.numpy())
    flags = [look_along(surface, x, y) for x, y in asked.tolist()]
    assert (found.seen_through[0] > 0).tolist() == [flag == SEEN_THROUGH for flag in flags]
    assert (found.hidden[0] > 0).tolist() == [flag == OCCLUDED for flag in flags]


@given(ANGLES, SEEDS)
def test_a_rigid_motion_of_scan_sensor_and_points_changes_nothing(turn: float, seed: int) -> None:
    points, origin = make_scan(60, 0.5, seed)
    asked = queries(points, origin, seed)
    motion = torch.tensor([turn, 5.0, -3.0]).double()
    one = look(sweep(points, origin=origin), asked[None])
    moved, there = se2.apply(motion, asked), se2.apply(motion, origin[None])[0]
    other = look(sweep(se2.apply(motion, points), origin=there), moved[None])
    assert_close(other.seen_through, one.seen_through, tolerance=1e-6)
    assert_close(other.hidden, one.hidden, tolerance=1e-6)


def test_the_sweep_of_a_scan() -> None:
    found = sweep(
        se2.apply(torch.tensor([math.pi, 1.0, 2.0], dtype=torch.float64), wall()), origin=torch.tensor([1.0, 2.0]).double(), extra=2
    )
    assert found.count.tolist() == [9]
    assert_close(found.ranges[0, :9], torch.full((9,), 4.0).double())
    assert_close(found.bearings[0, :9], math.pi + torch.deg2rad(torch.arange(9).double() - 4))
    assert found.bearings[0, 9:].tolist() == [math.inf, math.inf]
    assert_close(found.step, torch.deg2rad(torch.ones(1).double()))
    assert all_real(found.ranges[..., None]).all()
