"""The search for the background's motion: its stages, and that it is found beside trucks, from afar and whatever the guess."""

import math
from dataclasses import replace

import numpy as np
import oracles_search as oracles
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from rooms_seen import STILL, right, see_room, sides
from support import assert_close, generator, normal, polar
from surveyed import any_scan, array, grids, oracle_of, seen
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import MODEL_CARS, NAMED_WORLDS, SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.loops.threads import in_parts
from torchcrf_scan.search.background import (
    POLISH_ALONG,
    POLISH_GATES,
    REFINE_ALONG,
    REFINE_GATES,
    background_cost,
    polish,
    refine,
    unit_length,
)
from torchcrf_scan.search.grid import LENGTH_SHARE, ScanGrid, grid_of
from torchcrf_scan.search.pool import (
    COARSE_ALONG,
    COARSE_GATES,
    GRID_REACH,
    GRID_SHIFTS,
    GRID_TURNS,
    SEARCHED,
    SEGMENT_ALONG,
    SEGMENT_GATES,
    SLIDE_STEP,
    SLIDES,
    background_pool,
    distinct,
    find_background,
    large_segments,
    search_coarsely,
    segment_hypotheses,
    segment_points,
    shifted_from,
    slide,
    start_grid,
    thinned,
)
from torchcrf_scan.search.surface import Surface
from torchcrf_scan.search.survey import grids_of

SEEDS = st.integers(0, 10_000)
NONE = np.zeros((0, 3))  # no more starts than the search has by itself


def backgrounds(batch: ScanPairBatch) -> Tensor:
    """(B, 3) what is found in every pair."""
    found = [find_background(*sides(batch, b), array(guess)) for b, guess in enumerate(batch.initial_motion)]
    return torch.from_numpy(np.stack(found)).to(batch.source)


# The steps of the search.


def test_starts_lie_on_a_grid_about_every_guess() -> None:
    source, target = see_room(STILL), see_room(torch.tensor([0.05, -0.4, 0.1]).double())
    grid = start_grid(source.scan, target.scan)
    reach = np.sort(np.concatenate([source.scan.ranges, target.scan.ranges]))[120] * GRID_REACH  # the lower median of 242
    expected = [(turn, reach * x, reach * y) for turn in GRID_TURNS for x, y in GRID_SHIFTS]
    np.testing.assert_allclose(grid, expected, rtol=1e-6, atol=1e-6)
    guesses = normal(2, 3).numpy()
    starts = shifted_from(grid, guesses).reshape(2, len(grid), 3)
    for guess, found in zip(guesses, starts, strict=True):
        assert_close(found, se2.compose(grid, np.tile(guess, (len(grid), 1))))


def test_the_coarse_search_comes_near() -> None:
    motion = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)
    source, target = see_room(STILL), see_room(motion)
    found = search_coarsely(array(STILL[None]), source, target, unit_length(source.scan, target.scan))
    turn, shift = se2.distance(found[0], motion.numpy())
    assert float(turn) < 0.01
    assert float(shift) < 0.05


@given(st.integers(1, 30), st.integers(1, 6), SEEDS)
def test_distinct_motions(count: int, most: int, seed: int) -> None:
    motions = torch.tensor([0.02, 1.0, 1.0]) * normal(count, 3, seed=seed)
    cost = torch.rand(count, generator=generator(seed))
    kept: list[int] = []
    for k in cost.argsort().tolist():
        pairs = ((motions[k], motions[other]) for other in kept)
        if not any(math.dist(a[1:].tolist(), b[1:].tolist()) < 0.7 and abs(a[0] - b[0]) < 0.02 for a, b in pairs):
            kept.append(k)
    assert distinct(array(motions), array(cost), 0.7, most).tolist() == kept[:most]


@pytest.mark.parametrize("heading", [0.0, 0.8, 2.0])
def test_motions_slide_along_the_walls(heading: float) -> None:
    turn = torch.tensor([heading, 0.0, 0.0], dtype=torch.float64)
    bearings = torch.linspace(-1.2, 1.2, 61, dtype=torch.float64)
    wall = seen(se2.apply(turn, polar(3 / bearings.cos(), bearings)))
    motions = normal(2, 3)
    slid = torch.from_numpy(slide(array(motions), wall, 0.1)).view(2, 2 * SLIDES, 3)
    moved = slid - motions[:, None]
    steps = SLIDE_STEP * 0.1 * torch.tensor([k for k in range(-SLIDES, SLIDES + 1) if k], dtype=torch.float64)
    assert_close(moved[..., 0], torch.zeros(2, 2 * SLIDES))
    along = se2.rotate(-turn[0], moved[..., 1:])
    assert_close(along[..., 0], torch.zeros(2, 2 * SLIDES))
    assert_close(along[0, :, 1].sort().values, steps)


def test_every_segment_is_registered_alone() -> None:
    pieces = torch.tensor([-0.7, 0.0, 0.7], dtype=torch.float64)[:, None] + torch.linspace(-0.1, 0.1, 21, dtype=torch.float64)

    def wall(middle: float) -> ScanGrid:
        ranges = torch.tensor([4.0, middle, 4.0], dtype=torch.float64)[:, None].expand_as(pieces)
        return grid_of(seen(polar(ranges, pieces).flatten(0, 1)))

    source, target = wall(5.0), wall(5.12)
    assert np.unique(source.scan.segment).tolist() == [0, 1, 2]
    segments = segment_points(source.scan, large_segments(source.scan))
    found = torch.from_numpy(segment_hypotheses(segments, target, array(STILL[None]), unit_length(source.scan, target.scan)))
    moved = se2.apply(found, torch.tensor([[5.0, 0.0]], dtype=torch.float64))[:, 0, 0] - 5.0
    assert sorted(round(float(step), 1) for step in moved) == [0.0, 0.0, 0.1]  # two that stood still, one that went away


def test_the_pool_is_sorted_and_holds_the_truth_first() -> None:
    motion = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)
    source, target = see_room(STILL), see_room(motion)
    pool = torch.from_numpy(background_pool(source, target, array(STILL), NONE))
    assert pool.shape[1] == 3
    assert (np.diff(background_cost(array(pool), source, target, 0, 1.0)) >= 0).all()
    assert right(pool[:1], motion[None], 0.01, 0.005) == 1


@pytest.mark.parametrize("stage", ["coarse", "segments", "polish", "refine"])
def test_stages_are_registrations_with_gates_of_their_own(stage: str) -> None:
    source, target = see_room(STILL, 41), see_room(torch.tensor([0.05, -0.4, 0.1]).double(), 37)
    unit = unit_length(source.scan, target.scan)
    here, there = oracle_of(source.scan), oracle_of(target.scan)
    pull = np.clip(np.array(here.length) / oracles.lower_median(here.length), *LENGTH_SHARE)
    starts = np.array([0.05, -0.4, 0.1]) + 0.05 * normal(2, 3).numpy()
    segments = segment_points(source.scan, large_segments(source.scan))
    found, expected = {
        "coarse": lambda: (
            search_coarsely(starts, source, target, unit),
            [oracles.register(here.points, pull, there, m, unit * COARSE_GATES, COARSE_ALONG) for m in starts],
        ),
        "segments": lambda: (
            segment_hypotheses(segments, target, starts, unit),
            [oracles.register(s, np.ones(24), there, m, unit * SEGMENT_GATES, SEGMENT_ALONG) for s in segments for m in starts],
        ),
        "polish": lambda: (
            polish(starts, source, target, unit),
            [oracles.register(here.points, pull, there, m, unit * POLISH_GATES, POLISH_ALONG) for m in starts],
        ),
        "refine": lambda: (
            refine(starts, source, target),
            [oracles.register_both(here, there, m, REFINE_GATES, REFINE_ALONG) for m in starts],
        ),
    }[stage]()
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


def test_segments_are_drawn_evenly_the_largest_first() -> None:
    ranges = torch.tensor([4.0] * 30 + [2.0] * 7 + [6.0] * 5 + [3.0] * 50, dtype=torch.float64)
    scan = seen(polar(ranges, torch.linspace(-0.6, 0.6, 92, dtype=torch.float64)))
    members = [np.flatnonzero(scan.segment == number) for number in (3, 0, 1)]  # five points are too few
    assert large_segments(scan).tolist() == [3, 0, 1]
    drawn = [[of[k * len(of) // 24] for k in range(24)] for of in members]
    np.testing.assert_array_equal(segment_points(scan, large_segments(scan)), scan.points[np.array(drawn)])


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


def test_a_right_guess_rescues_what_the_search_cannot_find(street: ScanPairBatch) -> None:
    far = street.displaced(torch.tensor([[2.4, 14.0, -9.0]]).expand(6, 3))
    assert far.truth is not None
    truth = far.truth.motions[:, 0]
    nearly = se2.compose(torch.tensor([0.03, 0.2, -0.2]).expand(6, 3), truth)

    def search(guesses: Tensor) -> Tensor:
        """Without what shapes speak for."""
        pools = [background_pool(*sides(far, b), array(guess), NONE) for b, guess in enumerate(guesses)]
        return torch.from_numpy(np.stack([pool[0] for pool in pools])).float()

    assert right(search(torch.zeros(6, 3)), truth, 0.2, 0.02) == 0
    assert right(search(nearly), truth, 0.05) == 6


def test_what_is_found_does_not_depend_on_the_unit_of_length(street: ScanPairBatch) -> None:
    small = street.scaled(torch.full((6,), 0.1))
    assert small.truth is not None
    assert right(backgrounds(small), small.truth.motions[:, 0], 0.005) == 6


@pytest.mark.parametrize("points", [3, 4, 7])
def test_few_points_break_nothing(points: int) -> None:
    source = seen(polar(torch.full((points,), 4.0), torch.linspace(-0.1, 0.1, points)))
    for target in (source, seen(source.points[:3])):
        pool = background_pool(*grids(source, target), np.zeros(3), NONE)
        assert np.isfinite(pool).all()
        assert len(pool) > 0


def test_one_place_seen_many_times_breaks_nothing() -> None:
    (heap,) = grids(seen(torch.ones(5, 2)))
    assert np.isfinite(background_pool(heap, heap, np.zeros(3), NONE)).all()


@given(any_scan(), any_scan())
@settings(max_examples=15)
def test_the_search_of_any_two_scans_is_finite(source: Surface, target: Surface) -> None:
    assume(min(source.noise, target.noise) > 0 and min(len(source.points), len(target.points)) > 2)
    assert np.isfinite(find_background(*grids(source, target), np.zeros(3))).all()


def test_threads_share_a_search_without_a_trace(street: ScanPairBatch) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        shared = find_background(*sides(street, 0), np.zeros(3), in_parts)
    finally:
        torch.set_num_threads(before)
    assert shared.tolist() == find_background(*sides(street, 0), np.zeros(3)).tolist()


@pytest.mark.parametrize("beams", [2881, 3001, 7001])
def test_a_dense_scan_is_searched_by_some_of_its_points(beams: int) -> None:
    """The search costs N^2, so the number of its points is bounded; they are spread evenly, and a usual scan is searched whole."""
    pair = simulate_pairs(replace(NAMED_WORLDS["street"], beams=beams), 1, 1, 3)[0]
    whole, _ = grids_of(pair_of(ScanPairBatch.collate([pair], torch.float64), 0))
    some = thinned(whole)
    assert len(some.features) <= SEARCHED
    if len(whole.features) <= SEARCHED:
        assert some is whole
    else:
        stride = round(len(whole.features) / len(some.features))
        assert_array_equal(some.scan.points, whole.scan.points[::stride])


def test_the_motion_of_a_dense_scan_is_found() -> None:
    pair = simulate_pairs(replace(NAMED_WORLDS["street"], beams=7001), 1, 1, 3)[0]
    assert pair.annotation is not None
    source, target = grids_of(pair_of(ScanPairBatch.collate([pair], torch.float64), 0))
    assert_allclose(find_background(source, target, np.zeros(3)), pair.annotation.motions[0], atol=0.02)
