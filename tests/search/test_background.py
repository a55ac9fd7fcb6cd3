"""The background's motion: what it costs, where refinement leads, and which guesses are followed."""

import math

import numpy as np
import oracles_search as oracles
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rooms_seen import STILL, right, see_room, sides
from support import assert_close, normal
from surveyed import NOISE, any_scan, array, grids, oracle_of, seen
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.search import background
from torchcrf_scan.search.background import TRUNCATION, cost_of, follow, polish, refine, unit_length
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.surface import Surface

SEEDS = st.integers(0, 10_000)
MOTION = torch.tensor([0.05, -0.4, 0.1], dtype=torch.float64)


def costs(motions: Tensor, source: ScanGrid, target: ScanGrid, most: int = 0, slack: float = 1.0) -> Tensor:
    """(H,) `background_cost`."""
    return torch.from_numpy(background.background_cost(array(motions), source, target, most, slack))


# The cost.


@given(SEEDS)
@settings(max_examples=3)
def test_the_cost_of_every_motion(seed: int) -> None:
    source, target = see_room(STILL, 41), see_room(MOTION, 37)
    motions = torch.tensor([0.2, 0.7, 0.7], dtype=torch.float64) * normal(3, 3, seed=seed)
    expected = [oracles.background_cost(m, oracle_of(source.scan), oracle_of(target.scan)) for m in motions.tolist()]
    assert_close(costs(motions, source, target), expected, tolerance=1e-6)


@given(any_scan(), any_scan(), st.sampled_from([1.0, 4.0]), SEEDS)
@settings(max_examples=30)
def test_the_cost_of_any_two_scans(source: Surface, target: Surface, slack: float, seed: int) -> None:
    """Far points, of which beams must say something, and near ones; wherever the sensors stand."""
    assume(min(len(source.points), len(target.points)) > 2)  # else a closed scan is no circle to speak of
    assume(all(scan.noise > 0 or scan.spacing.min() > 0 for scan in (source, target)))  # else a residual has no unit
    motions = normal(3, 3, seed=seed) * torch.tensor([2.0, 3.0, 3.0], dtype=torch.float64)
    motions[:, 1:] += torch.from_numpy(target.points[0] - source.points[0])
    expected = [oracles.background_cost(m, oracle_of(source), oracle_of(target), slack) for m in motions.tolist()]
    assert_close(costs(motions, *grids(source, target), 0, slack), expected, tolerance=1e-6)


def test_the_cost_by_some_of_the_points() -> None:
    source, target = see_room(STILL, 41), see_room(MOTION, 37)
    some = [seen(grid.scan.points[::3]) for grid in (source, target)]
    expected = 0.0
    for motion, thin, whole, other in (
        (MOTION.numpy() + 0.02, some[0], source, target),
        (se2.inverse(MOTION.numpy() + 0.02), some[1], target, source),
    ):
        kept = oracles.Surface(**{**vars(oracle_of(thin)), "length": list(whole.scan.length[::3])})
        expected += oracles.one_way_cost(motion, kept, oracle_of(other.scan))
    assert_close(costs(MOTION[None] + 0.02, source, target, 14), [expected], tolerance=1e-6)


def test_the_truth_costs_least() -> None:
    source, target = see_room(STILL), see_room(MOTION)
    errors = torch.tensor([0.1, 0.5, 0.5]) * normal(50, 3)
    motions = torch.cat([MOTION[None], se2.compose(errors, MOTION.expand(50, 3))])
    for most in (0, 40):
        cost = costs(motions, source, target, most)
        assert int(cost.argmin()) == 0
        assert float(cost[0]) < 0.3
        assert (costs(motions, source, target, most, 4.0) <= cost + 1e-9)[cost < TRUNCATION].all()
    assert cost_of(array(MOTION), source, target) == pytest.approx(float(costs(MOTION[None], source, target)))


@given(st.floats(0.05, 20.0), st.floats(-3.0, 3.0), SEEDS)
@settings(max_examples=10)
def test_neither_the_unit_of_length_nor_the_target_frame_matters(scale: float, theta: float, seed: int) -> None:
    source, target = see_room(STILL), see_room(MOTION)
    motions = torch.tensor([0.1, 0.3, 0.3]) * normal(4, 3, seed=seed)
    cost = costs(motions, source, target)
    small_source, small_target = grids(*(seen(grid.scan.points * scale, NOISE * scale) for grid in (source, target)))
    in_scale = motions * torch.tensor([1.0, scale, scale])
    assert_close(costs(in_scale, small_source, small_target), cost, tolerance=1e-6)
    offset = torch.cat([torch.tensor([theta]).double(), normal(2, seed=seed)])
    (elsewhere,) = grids(seen(se2.apply(offset.numpy(), target.scan.points), origin=offset[1:]))
    found = costs(se2.compose(offset.expand(4, 3), motions), source, elsewhere)
    assert_close(found, cost, tolerance=1e-2)  # a residual may lie on the edge of what a beam sees


def test_the_unit_is_an_ordinary_registration_error() -> None:
    coarse = seen(torch.tensor([[4.0, -0.4], [4.0, 0.0], [4.0, 0.4]]), 0.02)
    fine = seen(torch.tensor([[4.0, y] for y in (-0.2, -0.1, 0.0, 0.1)]), 0.01)
    assert unit_length(coarse, fine) == pytest.approx(0.1 / 2 + 2 * 0.02)  # four spacings of seven are 0.1 m


# The steps at its end.


@given(st.floats(-0.02, 0.02), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
@settings(max_examples=10)
def test_refinement_ends_at_the_truth(theta: float, x: float, y: float) -> None:
    source, target = see_room(STILL), see_room(MOTION)
    error = torch.tensor([[theta, x, y]], dtype=torch.float64)
    turn, shift = se2.distance(refine(array(se2.compose(error, MOTION[None])), source, target)[0], MOTION.numpy())
    assert float(turn) < 2e-3
    assert float(shift) < 5e-3


def test_polish_takes_over_from_farther_away() -> None:
    source, target = see_room(STILL), see_room(MOTION)
    away = se2.compose(torch.tensor([[0.05, 0.2, -0.2]]).double(), MOTION[None])
    polished = polish(array(away), source, target, unit_length(source.scan, target.scan))
    turn, shift = se2.distance(refine(polished, source, target)[0], MOTION.numpy())
    assert float(turn) < 2e-3
    assert float(shift) < 5e-3


@pytest.fixture(scope="module")
def street() -> ScanPairBatch:
    return ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=181), 6, 6, 40))


def test_a_right_guess_is_followed_and_no_guess_leads_astray(street: ScanPairBatch) -> None:
    assert street.truth is not None
    truth = street.truth.motions[:, 0]
    nearly = se2.compose(torch.tensor([0.03, 0.1, -0.1]).expand(6, 3), truth)
    wrong = se2.compose(torch.tensor([0.3, 3.0, -1.0]).expand(6, 3), truth)
    for guesses, least, most in ((nearly, 5, 6), (wrong, 0, 2)):
        followed = {b: follow(array(guess), *sides(street, b)) for b, guess in enumerate(guesses)}
        led = {b: torch.from_numpy(motion) for b, (is_led, motion) in followed.items() if is_led}
        assert least <= len(led) <= most
        assert not led or right(torch.stack([*led.values()]), truth[[*led]]) == len(led)


def test_a_guess_that_leads_far_away_is_not_followed() -> None:
    """It ends at the truth, but explains too little where it began."""
    source, target = see_room(STILL), see_room(MOTION)
    is_led, _ = follow(array(MOTION) + 0.01, source, target)
    assert is_led
    is_led, _ = follow(array(MOTION) + np.array([0.0, 30.0, 0.0]), source, target)
    assert not is_led
    assert math.isfinite(cost_of(np.array([0.0, 50.0, -50.0]), source, target))
