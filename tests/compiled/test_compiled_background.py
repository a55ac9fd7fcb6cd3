"""The compiled search for the background against the eager one."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from support import make_points, normal
from torch import Tensor

pytest.importorskip("numba")

from torchcrf_scan.inference.cold import shape_association
from torchcrf_scan.inference.initialise import find_background
from torchcrf_scan.inference.surface import Surface

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference import background as eager
from torchcrf_scan.inference import registration
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.threads import in_parts
from torchcrf_scan.search import background as compiled
from torchcrf_scan.search import pool as search
from torchcrf_scan.search.grid import Field, field_of, locate
from torchcrf_scan.search.registration import gauss_newton_step, register_both
from torchcrf_scan.search.surface import surface_of

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
RECORDED = ("datmo_overtake_red_0030", "datmo_overtakes_0199", "kitti0001_f057_g2", "kitti0001_f078_g3")
ROUNDING = 1e-6  # of residuals: a root of what is left of two nearly equal squares
WORST = 1e-7  # of what is computed from them

SPOT = torch.tensor([[2.0, 1.0]], dtype=torch.float64)
WALL = torch.stack([torch.linspace(1.0, 4.0, 31, dtype=torch.float64), torch.full((31,), 2.0, dtype=torch.float64)], dim=1).flip(0)
POOR = {
    "one point": (SPOT, SPOT + 0.1),
    "two points": (WALL[:2], WALL[5:7]),
    "three points": (WALL[:3], make_points(3, 1)),
    "one spot": (SPOT.expand(9, 2), SPOT.expand(7, 2)),
    "duplicates": (WALL.repeat_interleave(3, 0), WALL[::2].repeat_interleave(2, 0)),
    "collinear": (WALL, WALL + torch.tensor([0.05, 0.0])),
}


def surfaces(source: Tensor, target: Tensor, noise: float = 0.01, is_closed: bool = False) -> tuple[Surface, Surface]:
    level = torch.tensor(noise, dtype=torch.float64)
    return Surface.of(source.contiguous(), level, is_closed), Surface.of(target.contiguous(), level, is_closed)


def fields(*scans: Surface) -> list[Field]:
    return [field_of(surface_of(s.points.numpy(), float(s.noise), s.is_closed, s.origin.numpy())) for s in scans]


@cache
def simulated(world: str) -> ScanPairBatch:
    return ScanPairBatch.collate(simulate_pairs(WORLDS[world], 1, 1, seed=4), torch.float64).without_truth()


def sides(batch: ScanPairBatch) -> tuple[Surface, Surface]:
    closed = bool(batch.source_closed[0]), bool(batch.target_closed[0])
    noise = batch.range_noise[0]
    return Surface.of(batch.source[0], noise, closed[0]), Surface.of(batch.target[0], noise, closed[1], batch.target_origin[0])


def some_motions(count: int = 6, seed: int = 0) -> Tensor:
    return normal(count, 3, seed=seed) * torch.tensor([0.1, 0.4, 0.4], dtype=torch.float64)


def assert_near(actual: Array, expected: Tensor, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(actual, expected.numpy(), rtol=tolerance, atol=tolerance)


# Registration.


@pytest.mark.parametrize("scene", ["street", "model_cars", *POOR])
def test_the_nearest_point_of_any_place(scene: str) -> None:
    _, target = surfaces(*POOR[scene]) if scene in POOR else sides(simulated(scene))
    (field,) = fields(target)
    extent = float(target.points.abs().max()) + 1.0
    moved = torch.cat([extent * normal(500, 2, seed=1), target.points, target.points + 0.02 * normal(len(target), 2, seed=2)])
    squared, index = np.empty(len(moved)), np.empty(len(moved), np.int64)
    locate(np.ascontiguousarray(moved.numpy().T), field, squared, index)
    distance = (moved[:, None] - target.points).square().sum(-1)
    assert_near(squared, distance.amin(1))
    assert_near(distance.numpy()[np.arange(len(moved)), index], distance.amin(1))


def test_a_step_equals_the_eager_one() -> None:
    moved, partner = normal(2, 50, 2, seed=3)
    tangent = torch.nn.functional.normalize(normal(50, 2, seed=4), dim=-1)
    weights = normal(50, seed=5).abs()
    for along in (0.0, 0.3, 1.0):
        for some in (weights, torch.zeros_like(weights)):
            pairs = torch.cat([moved.T, partner.T, tangent.T, some[None]]).numpy()
            assert_near(gauss_newton_step(pairs, along), registration.gauss_newton_step(moved, partner, tangent, some, along))


@pytest.mark.parametrize("scene", POOR)
def test_registering_the_least_of_scans(scene: str) -> None:
    source, target = surfaces(*POOR[scene])
    gates, along = [3.0, 1.5], [0.3, 0.03]
    found = register_both(*fields(source, target), some_motions().numpy(), np.array(gates), np.array(along))
    assert np.isfinite(found).all()
    if scene not in ("one spot", "duplicates"):  # where equals are nearest
        assert_near(found, registration.register_both(source, target, some_motions(), gates, along), WORST)


# The stages.


@pytest.mark.parametrize("scene", ["street", "model_cars", *POOR])
@pytest.mark.parametrize(("most", "slack"), [(0, 1.0), (20, 4.0)])
def test_the_cost_of_motions(scene: str, most: int, slack: float) -> None:
    source, target = surfaces(*POOR[scene]) if scene in POOR else sides(simulated(scene))
    motions = torch.cat([some_motions(), torch.tensor([[3.0, 0.0, 0.0], [0.0, 50.0, -50.0]], dtype=torch.float64)])
    expected = eager.background_cost(motions, source, target, most or None, slack)
    if scene not in ("one spot", "duplicates"):
        assert_near(compiled.background_cost(motions.numpy(), *fields(source, target), most, slack), expected, ROUNDING)
    assert np.isfinite(compiled.cost_of(np.zeros(3), *fields(source, target)))


@pytest.mark.parametrize("is_closed", [False, True])
def test_what_the_beams_say_of_far_points(is_closed: bool) -> None:
    source, target = surfaces(make_points(60, 1, closed=is_closed), make_points(50, 2, closed=is_closed), is_closed=is_closed)
    motions = normal(40, 3, seed=3) * torch.tensor([2.0, 3.0, 3.0], dtype=torch.float64)
    expected = eager.background_cost(motions, source, target)
    assert_near(compiled.background_cost(motions.numpy(), *fields(source, target), 0, 1.0), expected, ROUNDING)


def test_stages_equal_the_eager_ones() -> None:
    source, target = sides(simulated("street"))
    here, there = fields(source, target)
    unit, motions = eager.unit_length(source, target), some_motions(4, seed=1)
    length = float(unit)
    assert compiled.unit_length(here.scan, there.scan) == pytest.approx(length, rel=1e-12)
    grid = eager.start_grid(source, target)
    np.testing.assert_array_equal(search.start_grid(here.scan, there.scan), grid.numpy())
    assert_near(
        search.search_coarsely(motions.numpy(), here, there, length), eager.search_coarsely(motions, source, target, length)
    )
    assert_near(search.slide(motions.numpy(), there.scan, length), eager.slide(motions, target, unit))
    segments = search.segment_points(here.scan, search.large_segments(here.scan))
    assert_near(
        search.segment_hypotheses(segments, there, motions.numpy(), length),
        eager.segment_hypotheses(source, target, motions, length),
    )
    assert_near(compiled.polish(motions.numpy(), here, there, length), eager.polish(motions, source, target, length))
    assert_near(compiled.refine(motions.numpy(), here, there), eager.refine(motions, source, target), WORST)


def test_distinct_motions() -> None:
    motions = torch.cat([some_motions(), some_motions() + 1e-3, torch.tensor([[3.1, 0.0, 0.0], [-3.18, 0.0, 0.0]])])
    cost = normal(len(motions), seed=7)
    for near in (0.0, 0.1, 0.5, 10.0):
        for count in (1, 4, len(motions)):
            expected = eager.distinct(motions, cost, torch.tensor(near), count).tolist()
            assert search.distinct(motions.numpy(), cost.numpy(), near, count).tolist() == expected


# The search.


def assert_same_search(batch: ScanPairBatch, guess: Tensor) -> None:
    source, target = sides(batch)
    extra = some_motions(3, seed=2)
    here, there = fields(source, target)
    pool = search.background_pool(here, there, guess.numpy(), extra.numpy(), in_parts)
    assert_near(pool, eager.background_pool(source, target, guess, extra), WORST)
    match = shape_association(PairView.of(batch, length_unit="spacing"))[0]
    assert_near(search.find_background(here, there, guess.numpy()), find_background(source, target, guess, match), WORST)


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_the_search_of_simulated_pairs(world: str) -> None:
    assert_same_search(simulated(world), torch.zeros(3, dtype=torch.float64))
    assert_same_search(simulated(world), some_motions(1, seed=3)[0])


@pytest.mark.parametrize("name", RECORDED)
def test_the_search_of_recorded_pairs(name: str) -> None:
    path = PAIRS / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"needs the real pairs, which are not part of the repository: no {path}")
    batch = ScanPairBatch.collate([read_pair(path)], torch.float64).without_truth()
    assert_same_search(batch, batch.initial_motion[0])


@pytest.mark.parametrize("scene", POOR)
def test_the_search_of_the_least_of_scans(scene: str) -> None:
    here, there = fields(*surfaces(*POOR[scene]))
    assert np.isfinite(search.find_background(here, there, np.zeros(3))).all()
