"""A scan's background placed on another scan, and the choice of the motion to believe."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms_cast import CORRIDOR, ROOM, scan_at

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.trusted import choose_background
from torchcrf_scan.stream.fusion import fused
from torchcrf_scan.stream.placement import explained_by, grid_at, place

TRUE = np.array([0.08, 0.25, -0.1])


def grid_from(pose: Floats, segments: Floats = ROOM, seed: int = 0, reach: float = 25.0) -> ScanGrid:
    scan = scan_at(pose, segments, seed, reach=reach)
    return grid_at(scan, scan.points)


def test_placed_from_a_guess() -> None:
    placement = place(grid_from(TRUE, seed=1), grid_from(np.zeros(3)), TRUE + np.array([0.02, 0.06, 0.05]))
    turn, shift = se2.distance(placement.motion, TRUE)
    assert turn < 0.002
    assert shift < 0.006
    assert placement.share > 0.9
    assert not placement.is_degenerate
    assert np.linalg.eigvalsh(placement.covariance).min() > 0


def test_a_motion_that_explains_nothing_has_a_large_covariance() -> None:
    placement = place(grid_from(np.zeros(3)), grid_from(np.zeros(3)), np.array([0.0, 300.0, 300.0]))
    assert placement.share == 0
    assert placement.covariance[1, 1] > 1
    assert np.isfinite(placement.motion).all()


def test_corridor_is_degenerate_along_it() -> None:
    true = np.array([0.05, 0.3, 0.1])
    placement = place(grid_from(true, CORRIDOR, 1, 8.0), grid_from(np.zeros(3), CORRIDOR, 0, 8.0), np.array([0.06, 0.0, 0.08]))
    assert placement.is_degenerate
    pose = fused(np.array([0.06, 0.3, 0.08]), placement.motion, placement.covariance, 0.1)
    np.testing.assert_allclose(pose, true, atol=0.03)
    assert placement.covariance[1, 1] > 100 * placement.covariance[2, 2]


@settings(max_examples=10)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_where_all_is_observed_the_prediction_hardly_matters(theta: float, x: float, y: float) -> None:
    placement = place(grid_from(TRUE, seed=1), grid_from(np.zeros(3)), TRUE)
    off = np.array([theta, x, y])
    pose = fused(TRUE + off, placement.motion, placement.covariance, 0.2)
    assert np.abs(pose - placement.motion).max() < 0.005 + 0.05 * np.abs(off).max()


def test_explained_points_are_those_on_surfaces() -> None:
    screen = np.array([[1.0, -1.0, 1.0, 1.0]])
    with_screen, without = grid_from(np.zeros(3), np.concatenate([ROOM, screen])), grid_from(np.zeros(3), seed=1)
    on_screen = np.abs(with_screen.scan.points[:, 0] - 1.0) < 0.05
    explained = explained_by(np.zeros(3), with_screen, without)
    assert explained[on_screen].mean() < 0.1
    assert explained[~on_screen].mean() > 0.9


def test_a_jump_is_not_believed_if_standing_explains_more() -> None:
    grid, reference = grid_from(np.zeros(3), seed=1), grid_from(np.zeros(3))
    backed = choose_background(np.array([1.0, 5.0, 2.0]), np.array([0.0, 0.5, 0.0]), grid, reference)
    assert not backed.is_found
    assert np.abs(backed.motion).max() < 0.01
    assert backed.share > 0.9


def test_a_guess_is_refined_where_the_match_failed() -> None:
    grid, reference = grid_from(TRUE, seed=1), grid_from(np.zeros(3))
    backed = choose_background(np.array([1.0, 5.0, 2.0]), TRUE + 0.05, grid, reference)
    np.testing.assert_allclose(backed.motion, TRUE, atol=0.01)


def test_the_motion_found_is_kept_if_it_explains_the_scan() -> None:
    backed = choose_background(TRUE, np.zeros(3), grid_from(TRUE, seed=1), grid_from(np.zeros(3)))
    assert backed.is_found
    np.testing.assert_array_equal(backed.motion, TRUE)
