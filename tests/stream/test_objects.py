"""Moving clusters, checked by memory and completed by what was expected."""

import numpy as np
from rooms_cast import box, scan_at

from torchcrf_scan import PairPrediction
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Ints
from torchcrf_scan.stream.memory import Votes
from torchcrf_scan.stream.objects import (
    Clusters,
    clusters_over_ground,
    turns_over_ground,
    with_expected,
    with_segments_filled,
    with_standing_removed,
)
from torchcrf_scan.stream.tracks import TrackPrediction
from torchcrf_scan.stream.view import View


def votes(through: list[int], standing: list[int]) -> Votes:
    return Votes(np.array(through), np.array(standing))


def clusters(*label: int) -> Clusters:
    K = max(*label, 0)
    return Clusters(np.array(label), np.ones((K, 2)), np.tile(np.eye(2), (K, 1, 1)))


def expectation(points: Floats, shift: tuple[float, float] = (0.0, 0.0), deviation: float = 0.05) -> TrackPrediction:
    covariance = np.diag([deviation**2] * 2 + [1.0, 1.0])
    return TrackPrediction(
        number=3,
        position=points.mean(0) + np.array(shift),
        velocity=np.zeros(2),
        covariance=covariance,
        heading=0.0,
        extent=np.ones(2),
        points=points,
        shift=np.array(shift),
        is_confirmed=True,
    )


def test_velocity_over_ground_of_a_box_seen_from_a_turning_sensor() -> None:
    before, now = np.array([0.3, 1.0, 2.0]), np.array([0.5, 1.2, 2.1])
    start, dt = np.array([4.0, 3.0]), 0.2
    end = start + dt * np.array([1.5, -0.5])
    reference = View.of(scan_at(before, box(*start)), before, 0.0)
    view = View.of(scan_at(now, box(*end), 1), now, dt)
    carry = np.array([0.0, *(start - end)])  # of the box, from now to before, in the world
    motion = se2.compose(se2.inverse(before), se2.compose(carry, now))
    found = PairPrediction(
        association=np.zeros(view.scan.n_beams, np.int64),
        cluster=np.ones(view.scan.n_beams, np.int64),
        motions=np.stack([se2.compose(se2.inverse(before), now), motion]),
        association_confidence=np.ones(view.scan.n_beams),
        cluster_confidence=np.ones(view.scan.n_beams),
        converged=True,
        covariances=np.tile(np.diag([0.0, 1e-4, 4e-4]), (2, 1, 1)),
    )
    seen = clusters_over_ground(view, np.ones(len(view.scan), np.int64), found, reference)
    np.testing.assert_allclose(seen.velocity, [[1.5, -0.5]], atol=1e-9)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(seen.covariance[0], turn @ np.diag([1e-4, 4e-4]) @ turn.T / dt**2, atol=1e-9)


def test_how_fast_a_mover_turns_over_ground() -> None:
    before, now, dt, rate = np.array([0.3, 1.0, 2.0]), np.array([0.5, 1.2, 2.1]), 0.2, 0.7
    reference, view = View.of(scan_at(before, box(4, 3)), before, 0.0), View.of(scan_at(now, box(4, 3), 1), now, dt)
    back = np.array([-rate * dt, 0.3, -0.1])  # of the mover, from now to before, in the world
    found = PairPrediction(
        association=np.zeros(view.scan.n_beams, np.int64),
        cluster=np.ones(view.scan.n_beams, np.int64),
        motions=np.stack([se2.compose(se2.inverse(before), of) for of in (now, se2.compose(back, now))]),
        association_confidence=np.ones(view.scan.n_beams),
        cluster_confidence=np.ones(view.scan.n_beams),
        converged=True,
    )
    np.testing.assert_allclose(turns_over_ground(view, found, reference, 2), [rate, np.nan], atol=1e-9)


def test_a_cluster_that_has_stood_is_background() -> None:
    seen = with_standing_removed(clusters(1, 1, 1, 2, 2, 0, -1), votes([0, 0, 0, 2, 0, 0, 0], [5, 5, 0, 0, 5, 5, 5]))
    np.testing.assert_array_equal(seen.label, [0, 0, 0, 2, 2, 0, -1])


def test_points_that_have_moved_join_their_segment() -> None:
    segment: Ints = np.array([0, 0, 0, 1, 1, 2])
    seen = with_segments_filled(clusters(1, -1, 0, 0, -1, 0), votes([0, 3, 3, 3, 0, 0], [0, 0, 0, 0, 0, 6]), segment)
    np.testing.assert_array_equal(seen.label, [1, 1, 1, 0, -1, 0])


def test_an_expected_object_is_held() -> None:
    points = np.array([[1.0, 0.0], [1.05, 0.0], [1.1, 0.0], [5.0, 0.0], [1.05, 0.02]])
    unseen = votes([0, 0, 3, 3, 0], [0, 0, 0, 0, 6])
    seen = with_expected(clusters(-1, -1, 0, -1, -1), unseen, points, [expectation(points[:3] - 0.3, (0.3, 0.3))])
    np.testing.assert_array_equal(seen.label, [1, 1, 1, -1, -1])
    assert np.isnan(seen.velocity).all()
    assert seen.covariance.shape == (1, 2, 2)


def test_an_expected_object_joins_the_cluster_that_was_found_there() -> None:
    points = np.array([[1.0, 0.0], [1.05, 0.0], [1.1, 0.0], [5.0, 0.0]])
    seen = with_expected(clusters(1, -1, -1, 2), votes([0] * 4, [0] * 4), points, [expectation(points[:3])])
    np.testing.assert_array_equal(seen.label, [1, 1, 1, 2])
    np.testing.assert_array_equal(seen.velocity, np.ones((2, 2)))


def test_background_without_evidence_is_not_taken_for_an_expected_object() -> None:
    points = np.array([[1.0, 0.0], [1.05, 0.0]])
    seen = with_expected(clusters(0, 0), votes([0, 0], [0, 0]), points, [expectation(points)])
    np.testing.assert_array_equal(seen.label, [0, 0])


def test_no_expectation_reaches_far() -> None:
    points = np.array([[1.0, 0.0], [1.7, 0.0]])
    seen = with_expected(clusters(-1, -1), votes([3, 3], [0, 0]), points, [expectation(points[:1], deviation=50.0)])
    np.testing.assert_array_equal(seen.label, [-1, -1])  # a single point is no object
