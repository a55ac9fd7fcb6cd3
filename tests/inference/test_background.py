"""The background's motion: what it costs, and that it is found beside trucks, along cars, from afar and whatever the guess."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import assert_close, generator, normal, polar
from torch import Tensor
from torchcrf_scan.inference.background import (
    background_cost,
    background_pool,
    distinct,
    follow,
    refine,
    segment_hypotheses,
    slide,
    unit_length,
)
from torchcrf_scan.inference.cold import shape_association
from torchcrf_scan.inference.initialise import find_background
from torchcrf_scan.inference.surface import Surface, look_along

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import MODEL_CARS, SimulatorConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.search.background import CONTRADICTION, TRUNCATION, UNSEEN
from torchcrf_scan.search.grid import COST_SHARE, ROUGHNESS
from torchcrf_scan.search.pool import SLIDE_STEP, SLIDES

NOISE = torch.tensor(0.01, dtype=torch.float64)
STILL = torch.zeros(3, dtype=torch.float64)
SEEDS = st.integers(0, 10_000)


def see_room(motion: Tensor, beams: int = 121) -> Surface:
    """Walls at x = 4, y = 3 and y = -5 after the scene has moved by `motion` in the sensor's frame."""
    bearings = torch.linspace(-1.9, 1.9, beams, dtype=torch.float64)
    direction = torch.stack([bearings.cos(), bearings.sin()], -1)
    back = se2.inverse(motion)
    ray = se2.rotate(back[0], direction)
    reach = [(wall - back[1 + axis]) / ray[:, axis] for axis, wall in ((0, 4.0), (1, 3.0), (1, -5.0))]
    ranges = torch.stack([torch.where(r > 0, r, torch.inf) for r in reach]).amin(0)
    return Surface.of(polar(ranges, bearings), NOISE, False)


def sides(batch: ScanPairBatch, b: int) -> tuple[Surface, Surface]:
    n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
    source = Surface.of(batch.source[b, :n], batch.range_noise[b], bool(batch.source_closed[b]))
    return source, Surface.of(batch.target[b, :m], batch.range_noise[b], bool(batch.target_closed[b]), batch.target_origin[b])


def backgrounds(batch: ScanPairBatch) -> Tensor:
    matches = shape_association(PairView.of(batch, length_unit="spacing"))
    found = []
    for b, guess in enumerate(batch.initial_motion):
        source, target = sides(batch, b)
        found.append(find_background(source, target, guess, matches[b, : len(source)]))
    return torch.stack(found)


def right(found: Tensor, truth: Tensor, translation: float = 0.05, rotation: float = math.radians(1.0)) -> int:
    turn, shift = se2.distance(found, truth)
    return int(((turn < rotation) & (shift < translation)).sum())


# The cost.


def cost_naive(motion: Tensor, source: Surface, target: Surface) -> float:
    return sum(one_way_naive(m, a, b) for m, a, b in ((motion, source, target), (se2.inverse(motion), target, source)))


def one_way_naive(motion: Tensor, surface: Surface, other: Surface) -> float:
    turn, *shift = motion.tolist()
    points, tangents = other.points.numpy(), other.tangent.numpy()
    usual, total, weight = float(surface.length.median()), 0.0, 0.0
    for (x, y), length in zip(surface.points.tolist(), surface.length.tolist(), strict=True):
        p = np.array([math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y]) + shift
        j = int(np.hypot(*(points - p).T).argmin())
        gap, spacing = p - points[j], float(other.spacing[j])
        along = abs(gap @ tangents[j])
        beyond, across = max(along - spacing / 2, 0.0), math.sqrt(max(gap @ gap - along**2, 0.0))
        roughness = ROUGHNESS if tangents[j].any() else 0.5
        residual = min(math.hypot(beyond, across) / (roughness * spacing + 2 * float(other.noise)), TRUNCATION)
        sight = look_along(torch.from_numpy(p[None]), other)
        if residual == TRUNCATION and bool(sight.occluded | sight.unmeasured):
            residual = UNSEEN
        elif residual == TRUNCATION and bool(sight.seen_through):
            residual = TRUNCATION + CONTRADICTION
        share = min(max(length / usual, COST_SHARE[0]), COST_SHARE[1])
        total, weight = total + share * residual, weight + share
    return total / weight


@given(SEEDS)
@settings(max_examples=3)
def test_the_cost_of_every_motion(seed: int) -> None:
    source, target = see_room(STILL, 41), see_room(torch.tensor([0.05, -0.4, 0.1]).double(), 37)
    motions = torch.tensor([0.2, 0.7, 0.7], dtype=torch.float64) * normal(3, 3, seed=seed)
    assert_close(background_cost(motions, source, target), [cost_naive(m, source, target) for m in motions], tolerance=1e-6)


def test_the_truth_costs_least() -> None:
    motion = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)
    source, target = see_room(STILL), see_room(motion)
    errors = torch.tensor([0.1, 0.5, 0.5]) * normal(50, 3)
    motions = torch.cat([motion[None], se2.compose(errors, motion.expand(50, 3))])
    for most in (None, 40):
        cost = background_cost(motions, source, target, most)
        assert int(cost.argmin()) == 0
        assert float(cost[0]) < 0.3
        assert (background_cost(motions, source, target, most, slack=4.0) <= cost + 1e-9)[cost < TRUNCATION].all()


@given(st.floats(0.05, 20.0), st.floats(-3.0, 3.0), SEEDS)
@settings(max_examples=10)
def test_neither_the_unit_of_length_nor_the_target_frame_matters(scale: float, theta: float, seed: int) -> None:
    source, target = see_room(STILL), see_room(torch.tensor([0.05, -0.4, 0.1]).double())
    motions = torch.tensor([0.1, 0.3, 0.3]) * normal(4, 3, seed=seed)
    cost = background_cost(motions, source, target)
    small_source, small_target = (Surface.of(scan.points * scale, NOISE * scale, False) for scan in (source, target))
    in_scale = motions * torch.tensor([1.0, scale, scale])
    assert_close(background_cost(in_scale, small_source, small_target), cost, tolerance=1e-6)
    offset = torch.cat([torch.tensor([theta]).double(), normal(2, seed=seed)])
    elsewhere = Surface.of(se2.apply(offset, target.points), NOISE, False, offset[1:])
    found = background_cost(se2.compose(offset.expand(4, 3), motions), source, elsewhere)
    assert_close(found, cost, tolerance=1e-2)  # a residual may lie on the edge of what a beam sees


# The steps of the search.


@given(st.integers(1, 30), st.integers(1, 6), SEEDS)
def test_distinct_motions(count: int, most: int, seed: int) -> None:
    motions = torch.tensor([0.02, 1.0, 1.0]) * normal(count, 3, seed=seed)
    cost = torch.rand(count, generator=generator(seed))
    kept: list[int] = []
    for k in cost.argsort().tolist():
        pairs = ((motions[k], motions[other]) for other in kept)
        if not any(math.dist(a[1:].tolist(), b[1:].tolist()) < 0.7 and abs(a[0] - b[0]) < 0.02 for a, b in pairs):
            kept.append(k)
    assert distinct(motions, cost, torch.tensor(0.7), most).tolist() == kept[:most]


@pytest.mark.parametrize("heading", [0.0, 0.8, 2.0])
def test_motions_slide_along_the_walls(heading: float) -> None:
    turn = torch.tensor([heading, 0.0, 0.0], dtype=torch.float64)
    bearings = torch.linspace(-1.2, 1.2, 61, dtype=torch.float64)
    wall = Surface.of(se2.apply(turn, polar(3 / bearings.cos(), bearings)), NOISE, False)
    motions, unit = normal(2, 3), torch.tensor(0.1, dtype=torch.float64)
    slid = slide(motions, wall, unit).view(2, 2 * SLIDES, 3)
    moved = slid - motions[:, None]
    steps = SLIDE_STEP * 0.1 * torch.tensor([k for k in range(-SLIDES, SLIDES + 1) if k], dtype=torch.float64)
    assert_close(moved[..., 0], torch.zeros(2, 2 * SLIDES))
    along = se2.rotate(-turn[0], moved[..., 1:])
    assert_close(along[..., 0], torch.zeros(2, 2 * SLIDES))
    assert_close(along[0, :, 1].sort().values, steps)


def test_every_segment_is_registered_alone() -> None:
    pieces = torch.tensor([-0.7, 0.0, 0.7], dtype=torch.float64)[:, None] + torch.linspace(-0.1, 0.1, 21, dtype=torch.float64)

    def seen(middle: float) -> Surface:
        ranges = torch.tensor([4.0, middle, 4.0], dtype=torch.float64)[:, None].expand_as(pieces)
        return Surface.of(polar(ranges, pieces).flatten(0, 1), NOISE, False)

    source, target = seen(5.0), seen(5.12)
    assert source.segment.unique().tolist() == [0, 1, 2]
    found = segment_hypotheses(source, target, STILL[None], float(unit_length(source, target)))
    moved = se2.apply(found, torch.tensor([[5.0, 0.0]], dtype=torch.float64))[:, 0, 0] - 5.0
    assert sorted(round(float(step), 1) for step in moved) == [0.0, 0.0, 0.1]  # two that stood still, one that went away


@given(st.floats(-0.02, 0.02), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
@settings(max_examples=10)
def test_refinement_ends_at_the_truth(theta: float, x: float, y: float) -> None:
    motion = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)
    source, target = see_room(STILL), see_room(motion)
    error = torch.tensor([[theta, x, y]], dtype=torch.float64)
    turn, shift = se2.distance(refine(se2.compose(error, motion[None]), source, target)[0], motion)
    assert float(turn) < 2e-3
    assert float(shift) < 5e-3


def test_the_pool_is_sorted_and_holds_the_truth_first() -> None:
    motion = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)
    source, target = see_room(STILL), see_room(motion)
    pool = background_pool(source, target, STILL)
    assert pool.shape[1] == 3
    assert (background_cost(pool, source, target).diff() >= 0).all()
    assert right(pool[:1], motion[None], 0.01, 0.005) == 1


# Whole scenes.


@pytest.fixture(scope="module")
def street() -> ScanPairBatch:
    return ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=181), 6, 6, 40))


def test_a_displaced_target_displaces_the_motion(street: ScanPairBatch) -> None:
    turn, direction = torch.tensor([0.35, -0.35, 0.35, -0.35, 0.5, -0.5]), torch.arange(6.0)
    offset = torch.cat([turn[:, None], 3.5 * torch.stack([direction.cos(), direction.sin()], -1)], dim=1)
    here, there = backgrounds(street), backgrounds(street.displaced(offset))
    assert street.truth is not None
    assert right(here, street.truth.motions[:, 0]) == 6
    assert right(there, se2.compose(offset, here), 0.02, 0.005) == 6


def test_any_turn_of_a_scan_all_round() -> None:
    batch = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=361, fov=360.0), 4, 4, 41))
    offset = torch.tensor([[3.0, 3.5, 0.0], [-2.0, 0.0, -3.5], [1.2, -3.5, 0.0], [-1.0, 2.5, 2.5]])
    displaced = batch.displaced(offset)
    assert displaced.truth is not None
    assert right(backgrounds(displaced), displaced.truth.motions[:, 0], 0.2, 0.02) >= 3


@pytest.mark.parametrize("special", ["dominant_mover", "aperture"])
@pytest.mark.parametrize("world", [SimulatorConfig(), MODEL_CARS], ids=["street", "cars"])
def test_a_large_mover_does_not_take_the_background_along(world: SimulatorConfig, special: str) -> None:
    batch = ScanPairBatch.collate(simulate_pairs(replace(world, **{special: 1.0}), 4, 4, 42))
    assert batch.truth is not None
    assert right(backgrounds(batch), batch.truth.motions[:, 0]) == 4


def test_a_wrong_guess_spoils_nothing(street: ScanPairBatch) -> None:
    assert street.truth is not None
    truth = street.truth.motions[:, 0]
    wrong = torch.tensor([[0.3, 3.0, -1.0], [0.0, -3.0, 0.0], [-0.4, 0.0, 3.0]]).repeat(2, 1)
    assert right(backgrounds(replace(street, initial_motion=se2.compose(wrong, truth))), truth) == 6


def test_a_right_guess_is_followed_and_no_guess_leads_astray(street: ScanPairBatch) -> None:
    assert street.truth is not None
    truth = street.truth.motions[:, 0]
    nearly = se2.compose(torch.tensor([0.03, 0.1, -0.1]).expand(6, 3), truth)
    wrong = se2.compose(torch.tensor([0.3, 3.0, -1.0]).expand(6, 3), truth)
    for guesses, least, most in ((nearly, 5, 6), (wrong, 0, 2)):
        followed = {b: follow(guess, *sides(street, b)) for b, guess in enumerate(guesses)}
        led = {b: motion for b, motion in followed.items() if motion is not None}
        assert least <= len(led) <= most
        assert not led or right(torch.stack([*led.values()]), truth[[*led]]) == len(led)


def test_a_right_guess_rescues_what_the_search_cannot_find(street: ScanPairBatch) -> None:
    far = street.displaced(torch.tensor([[2.4, 14.0, -9.0]]).expand(6, 3))
    assert far.truth is not None
    truth = far.truth.motions[:, 0]
    nearly = se2.compose(torch.tensor([0.03, 0.2, -0.2]).expand(6, 3), truth)
    no_match = torch.full((181,), -1)

    def search(guesses: Tensor) -> Tensor:
        found = []
        for b, guess in enumerate(guesses):
            source, target = sides(far, b)
            found.append(find_background(source, target, guess, no_match[: len(source)]))
        return torch.stack(found)

    assert right(search(torch.zeros(6, 3)), truth, 0.2, 0.02) == 0
    assert right(search(nearly), truth, 0.05) == 6


def test_what_is_found_does_not_depend_on_the_unit_of_length(street: ScanPairBatch) -> None:
    small = street.scaled(torch.full((6,), 0.1))
    assert small.truth is not None
    assert right(backgrounds(small), small.truth.motions[:, 0], 0.005) == 6


@pytest.mark.parametrize("points", [3, 4, 7])
def test_few_points_break_nothing(points: int) -> None:
    source = Surface.of(polar(torch.full((points,), 4.0), torch.linspace(-0.1, 0.1, points)), torch.tensor(0.01), False)
    for target in (source, Surface.of(source.points[:3], torch.tensor(0.01), False)):
        pool = background_pool(source, target, torch.zeros(3))
        assert pool.isfinite().all()
        assert len(pool) > 0


def test_one_place_seen_many_times_breaks_nothing() -> None:
    heap = Surface.of(torch.ones(5, 2), torch.tensor(0.01), False)
    assert background_pool(heap, heap, torch.zeros(3)).isfinite().all()
