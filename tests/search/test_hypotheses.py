"""What the background leaves, what may be one object, and the pool of motions that such an object may have."""

import math

import numpy as np
import oracles_search as oracles
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support import assert_close, normal
from surveyed import PAIRS, REAL, SCENES, any_scan, grids, oracle_of, seen, survey

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.loops.nearest import nearest_within
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.groups import Groups, ends, groups_of
from torchcrf_scan.search.hypotheses import FARTHEST, FASTEST, STARTS, Hypotheses, hypothesise, members_of, residual_units
from torchcrf_scan.search.leftover import TRUNCATION, Unexplained, leftover_of, pieces
from torchcrf_scan.search.surface import AGREES, OCCLUDED, SEEN_THROUGH, UNMEASURED, Surface

STEP = math.radians(0.5)
FAR = 30.0
STILL = np.zeros(3)
SIGHTS = {"agrees": AGREES, "seen through": SEEN_THROUGH, "occluded": OCCLUDED, "unmeasured": UNMEASURED}


def wall_and_car(shift: float) -> ScanGrid:
    """A wall across the view, 30 m ahead, and a car's rear 0.8 m before it, `shift` metres to the left."""
    bearing = np.arange(-60, 61) * STEP
    is_car = np.abs(FAR * np.tan(bearing) - shift) < 0.9
    return grid_of(seen(polar((FAR - 0.8 * is_car) / np.cos(bearing), bearing)))


def polar(ranges: Array, bearing: Array) -> Array:
    return np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing)], axis=-1)


def on_car(scan: Surface) -> Booleans:
    return scan.points[:, 0] < FAR - 0.4


def pool_of(source: ScanGrid, target: ScanGrid, background: Array = STILL, dt: float = 0.2) -> tuple[Hypotheses, Booleans]:
    """The hypotheses, and (H, P) whom each of them moves."""
    pool = hypothesise(leftover_of(source, target, background), dt)
    return pool, members_of(pool, np.arange(len(pool.motions)), len(source.features))


def sets_of(groups: Groups) -> list[tuple[int, ...]]:
    return [tuple(groups.members[a:b].tolist()) for a, b in zip(groups.start, groups.start[1:], strict=False)]


# --- what the background leaves -----------------------------------------------------------------------------------------------


def test_a_car_that_shares_its_segment_with_the_wall_is_a_piece() -> None:
    surface = wall_and_car(0.0).scan
    assert np.unique(surface.segment).tolist() == [0]
    numbers = pieces(surface)
    assert np.unique(numbers[on_car(surface)]).tolist() == [1]
    assert np.unique(numbers[~on_car(surface)]).tolist() == [0, 2]


def test_a_piece_leads_round_the_seam_of_a_closed_scan() -> None:
    bearing = np.arange(720) * STEP
    ranges = np.where((bearing > 3) & (bearing < 3.2), 3.0, 5.0)
    numbers = pieces(seen(polar(ranges, bearing), closed=True))
    assert numbers[0] == numbers[-1]
    assert len(np.unique(numbers)) == 2


@given(any_scan())
def test_pieces_equal_the_oracle(scan: Surface) -> None:
    assert pieces(scan).tolist() == oracles.pieces(oracle_of(scan))


@pytest.mark.parametrize("name", SCENES)
def test_what_is_left_equals_the_oracle(name: str) -> None:
    found = survey(name)
    source, sight, target, back = found.scene.left()
    for side, residual, sights in ((found.leftover.source, source, sight), (found.leftover.target, target, back)):
        assert_close(side.residual, residual)
        if "closed" not in name or len(side.residual) > 3:
            assert side.sight.tolist() == [SIGHTS[verdict] for verdict in sights]
        assert_close(side.units, oracle_of(side.grid.scan).units)
        assert side.piece.tolist() == oracles.pieces(oracle_of(side.grid.scan))
    assert_close(found.leftover.carried, se2.apply(found.background, found.pair.source))


def test_real_pairs_are_among_the_scenes() -> None:
    if not REAL:
        pytest.skip(f"needs the real pairs, which are not part of the repository: nothing in {PAIRS}")
    assert set(SCENES) > {path.name for path in REAL}


# --- what may be one object ---------------------------------------------------------------------------------------------------


def assert_same_groups(scan: Surface, residual: Array) -> list[tuple[int, ...]]:
    """Every set once, in the order of the sets' rows of flags."""
    some = np.zeros(len(residual), np.int64)
    found = sets_of(groups_of(Unexplained(grid_of(scan), some.astype(float), residual, some, pieces(scan))))
    assert set(found) == oracles.groups(oracle_of(scan), residual.tolist())
    flags = [[i in s for i in range(len(residual))] for s in found]
    assert flags == sorted(flags)
    assert len(found) == len(set(found))
    return found


@given(any_scan(), st.integers(1, 9), st.integers(0, 10_000))
@settings(max_examples=100)
def test_groups_of_any_scan_equal_the_oracle(scan: Surface, run: int, seed: int) -> None:
    """Residuals come in runs of some points that are about as large."""
    random = np.random.default_rng(seed)
    level = np.repeat(random.choice([0.2, 1.0, 2.0], len(scan.points) // run + 1), run)[: len(scan.points)]
    assert_same_groups(scan, level + random.uniform(-0.1, 0.1, len(level)))


@pytest.mark.parametrize("name", SCENES)
def test_groups_of_scenes_equal_the_oracle(name: str) -> None:
    found = survey(name)
    sets = assert_same_groups(found.source, found.leftover.source.residual)
    assert_same_groups(found.target, found.leftover.target.residual)
    if len(found.found.motions):
        assert sets_of(found.found.groups) == sets


def test_ends_of_a_set_that_leads_round_the_seam() -> None:
    sets = [[2, 3, 4], [0, 1, 8, 9], [9], [*range(10)], [0, 9]]
    assert [ends(np.array(points), 10) for points in sets] == [(2, 4), (8, 1), (9, 9), (5, 4), (9, 0)]
    assert [ends(np.array(points), 10) for points in sets] == [oracles.ends(points, 10) for points in sets]


# --- the pool -----------------------------------------------------------------------------------------------------------------


def test_the_pool_moves_that_car_alone() -> None:
    source, target = wall_and_car(-1.0), wall_and_car(1.0)
    pool, members = pool_of(source, target)
    is_alone = (members == on_car(source.scan)).all(-1)
    assert is_alone.any()
    assert np.linalg.norm(pool.motions[is_alone] - [0.0, 0.0, 2.0], axis=-1).min() < 0.3


def test_no_hypothesis_twice_the_same_members() -> None:
    pool, members = pool_of(wall_and_car(-1.0), wall_and_car(1.0))
    rows = np.concatenate([members, pool.motions], axis=-1)
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_scenes_hold_hypotheses() -> None:
    assert min(len(survey(name).found.motions) for name in ("street", "room", "closed")) > 20


@pytest.mark.parametrize("name", SCENES)
def test_every_set_has_a_few_motions_one_after_the_other(name: str) -> None:
    found = survey(name).found
    assert (np.diff(found.group) >= 0).all()
    assert np.isfinite(found.motions).all()
    if len(found.group):
        counts = np.bincount(found.group, minlength=len(found.groups.start) - 1)
        assert 1 <= counts.min() <= counts.max() <= STARTS


@pytest.mark.parametrize("dt", [0.01, 0.2, 10.0])
def test_nobody_moves_faster_or_farther_than_possible(dt: float) -> None:
    """But for what registration adds, a few units; the start may always stay."""
    source, target = wall_and_car(-5.0), wall_and_car(5.0)
    pool, members = pool_of(source, target, dt=dt)
    leftover = leftover_of(source, target, STILL)
    slack = 12 * leftover.unit
    for motion, which in zip(pool.motions, members, strict=True):
        centre = source.scan.points[which].mean(0)
        gone = np.linalg.norm(se2.apply(motion, centre[None])[0] - centre)
        assert gone <= min(FASTEST * dt, FARTHEST * np.linalg.norm(centre)) + slack
    farthest = max(np.linalg.norm(pool.motions[:, 1:], axis=1))
    assert (farthest > 8) == (dt > 0.1)


def test_nothing_within_reach() -> None:
    target = survey("street").leftover.target
    boxes = target.grid.scan.boxes
    x, y = boxes.points[5]
    assert nearest_within(boxes, x, y, -1, 1e-6) == (0.0, 5)
    assert nearest_within(boxes, x + 1000, y, 5, 1.0) == (1.0, -1)
    assert residual_units(boxes, target.units, TRUNCATION * target.units.max(), x + 1000, y, 3) == (TRUNCATION, -1)


def test_residuals_in_units_equal_the_oracle() -> None:
    found = survey("street")
    target, scan = found.leftover.target, oracle_of(found.target)
    for x, y in (5 * normal(50, 2)).tolist():
        residual, _ = residual_units(target.grid.scan.boxes, target.units, TRUNCATION * target.units.max(), x, y, -1)
        assert_close(residual, oracles.point_residual(scan, (x, y))[0])


@given(any_scan(), any_scan())
@settings(max_examples=25)
def test_the_pool_of_any_scans_is_finite(source: Surface, target: Surface) -> None:
    assume(min(source.noise, target.noise) > 0)
    pool, members = pool_of(*grids(source, target))
    assert np.isfinite(pool.motions).all()
    assert (members.sum(-1) >= 3).all()
