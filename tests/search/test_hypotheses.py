"""The pool of motions that sets of points may have, however the background lies."""

import numpy as np
import oracles_movers as oracles
import pytest
from hypothesis import assume, given, settings
from support import assert_close, normal
from surveyed import PAIRS, REAL, SCENES, any_scan, grids, oracle_of, survey, thinned
from wall_and_car import on_car, wall_and_car

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.loops.nearest import nearest_within
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.groups import MIN_POINTS
from torchcrf_scan.search.hypotheses import FARTHEST, FASTEST, STARTS, Hypotheses, hypothesise, members_of, residual_units
from torchcrf_scan.search.leftover import TRUNCATION, leftover_of
from torchcrf_scan.search.surface import Surface

STILL = np.zeros(3)


def pool_of(source: ScanGrid, target: ScanGrid, background: Array = STILL, dt: float = 0.2) -> tuple[Hypotheses, Booleans]:
    """The hypotheses, and (H, P) whom each of them moves."""
    pool = hypothesise(leftover_of(source, target, background), dt)
    return pool, members_of(pool, np.arange(len(pool.motions)), len(source.features))


def test_real_pairs_are_among_the_scenes() -> None:
    if not REAL:
        pytest.skip(f"needs the real pairs, which are not part of the repository: nothing in {PAIRS}")
    assert set(SCENES) > {path.name for path in REAL}


@pytest.mark.parametrize("name", SCENES)
def test_the_pool_is_that_of_the_oracle(name: str) -> None:
    at = thinned(survey(name), 500)  # a large scan takes the oracle minutes
    expected = oracles.hypothesise(at.scene, at.pair.dt) if at.pair.fewest_points >= MIN_POINTS else []
    assert at.members == [list(members) for members, _ in expected]
    motions = np.array([motion for _, motion in expected]).reshape(-1, 3)
    assert_close(at.found.motions, motions, tolerance=1e-8)  # six iterations of rounding


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
