"""A stream of scans: paths with a known truth, and scans that nothing can be learned from."""

import numpy as np
import pytest
from rooms_cast import BEAMS, CORRIDOR, ROOM, box, path_of, scan_at

from torchcrf_scan import JointScanCRF, Scan, ScanResult, ScanStream, StreamConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats

PERIOD = 0.1


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


def run(model: JointScanCRF, scans: list[Scan], config: StreamConfig | None = None, first: float = 0.0) -> list[ScanResult]:
    stream = ScanStream(model, config)
    return [stream.feed(scan, first + PERIOD * k) for k, scan in enumerate(scans)]


def errors(results: list[ScanResult], path: Floats) -> tuple[float, float]:
    """Largest error of the poses, radians and metres."""
    poses = np.stack([result.pose for result in results])
    turn, shift = se2.distance(poses, path)
    return float(turn.max()), float(shift.max())


def test_path_through_a_room(model: JointScanCRF) -> None:
    path = path_of(25)
    results = run(model, [scan_at(pose, seed=k) for k, pose in enumerate(path)])
    turn, shift = errors(results, path)
    assert turn < 0.005
    assert shift < 0.015
    assert [result.status for result in results] == ["ok"] * len(path)
    np.testing.assert_allclose(results[-1].twist, np.array([0.3, 0.4, 0.0]), atol=0.1)


def test_standing_sensor_stands(model: JointScanCRF) -> None:
    """Though somebody passes half a metre away and hides up to half of the room."""
    scans = [scan_at(np.zeros(3), np.concatenate([ROOM, box(0.6, -1.0 + 0.1 * k)]), seed=k) for k in range(20)]
    results = run(model, scans)
    turn, shift = errors(results, np.zeros((20, 3)))
    assert turn < 0.004
    assert shift < 0.01
    assert sum(result.moving.sum() for result in results[3:]) > 300


def test_covariances_are_those_a_filter_accepts(model: JointScanCRF) -> None:
    results = run(model, [scan_at(pose, seed=k) for k, pose in enumerate(path_of(4))])
    for result in results:
        for covariance in (result.covariance, result.twist_covariance):
            assert np.linalg.eigvalsh(covariance).min() > 0
            np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)


def test_corridor_follows_the_prediction_along_it(model: JointScanCRF) -> None:
    path = path_of(8, (0.0, 0.1, 0.0))
    stream = ScanStream(model)
    results = [stream.feed(scan_at(pose, CORRIDOR, k, reach=8.0), PERIOD * k, odometry=pose) for k, pose in enumerate(path)]
    assert {result.status for result in results[1:]} == {"degenerate"}
    assert "shift" in results[-1].reason
    assert abs(results[-1].pose[1] - path[-1, 1]) < 0.03
    assert results[-1].covariance[1, 1] > 1
    assert results[-1].covariance[2, 2] < 1e-3


@pytest.mark.parametrize("returns", [0, 1, 2])
def test_too_few_returns_are_predicted(model: JointScanCRF, returns: int) -> None:
    path = path_of(7)
    scans = [scan_at(pose, seed=k) for k, pose in enumerate(path)]
    ranges = np.full(len(BEAMS), np.nan)
    ranges[:returns] = 2.0
    scans[4] = Scan.from_ranges(ranges, BEAMS)
    results = run(model, scans)
    assert [result.status for result in results] == ["ok"] * 4 + ["lost"] + ["ok"] * 2
    assert f"{returns} returns" in results[4].reason
    assert results[4].covariance[1, 1] > 1
    assert results[4].track.max() == -1
    turn, shift = errors(results, path)
    assert turn < 0.02
    assert shift < 0.03


def test_first_scans_without_returns(model: JointScanCRF) -> None:
    empty = Scan.from_ranges(np.full(len(BEAMS), np.inf), BEAMS)
    results = run(model, [empty, empty, scan_at(np.zeros(3)), scan_at(np.zeros(3), seed=1)])
    assert [result.status for result in results] == ["lost", "lost", "ok", "ok"]
    np.testing.assert_allclose(results[-1].pose, 0.0, atol=0.01)


def test_blocked_sensor_is_lost_and_found_again(model: JointScanCRF) -> None:
    path = path_of(12, (0.0, 0.02, 0.0))
    scans = [scan_at(pose, seed=k) for k, pose in enumerate(path)]
    blocked = np.random.default_rng(3).uniform(0.1, 0.3, len(BEAMS))
    scans[6:8] = [Scan.from_ranges(blocked, BEAMS)] * 2
    results = run(model, scans)
    assert [result.status for result in results[6:8]] == ["lost"] * 2
    assert "explained" in results[6].reason
    assert results[-1].status == "ok"
    assert errors(results[-1:], path[-1:])[1] < 0.02


def test_stream_starts_anew_after_a_gap(model: JointScanCRF) -> None:
    elsewhere = np.concatenate([ROOM * 3 + 11, box(2.0, 1.0)])
    stream = ScanStream(model, StreamConfig(gap=1.0))
    for k in range(3):
        before = stream.feed(scan_at(np.zeros(3), seed=k), PERIOD * k)
    lost = stream.feed(scan_at(np.zeros(3), elsewhere, reach=60.0), 5.0)
    assert lost.status == "lost"
    assert "anew" in lost.reason
    after = stream.feed(scan_at(np.zeros(3), elsewhere, 1, reach=60.0), 5.1)
    assert after.status == "ok"
    np.testing.assert_allclose(after.pose, before.pose, atol=0.02)


@pytest.mark.parametrize("stamps", [[0.0, 0.1, 0.1, 0.1, 0.1], [5.0, 5.1, 5.2, 1.0, 1.1], [0.0, np.nan, np.inf, -np.inf, 0.4]])
def test_any_stamps_are_answered(model: JointScanCRF, stamps: list[float]) -> None:
    path = path_of(5)
    stream = ScanStream(model)
    results = [stream.feed(scan_at(pose, seed=k), stamp) for k, (pose, stamp) in enumerate(zip(path, stamps, strict=True))]
    turn, shift = errors(results, path)
    assert turn < 0.005
    assert shift < 0.015
    np.testing.assert_allclose(results[-1].twist, [0.3, 0.4, 0.0], atol=0.1)


def test_odometry_leads_where_velocity_does_not(model: JointScanCRF) -> None:
    """A jump that constant velocity does not foresee, in the wheels' own frame."""
    path = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.6, 1.4, 0.5], [0.6, 1.5, 0.5]])
    wheels = se2.compose(np.tile([1.0, 20.0, -3.0], (4, 1)), path)
    stream = ScanStream(model)
    results = [
        stream.feed(scan_at(pose, seed=k), PERIOD * k, wheel) for k, (pose, wheel) in enumerate(zip(path, wheels, strict=True))
    ]
    assert errors(results, path)[1] < 0.02


def test_odometry_that_is_not_finite_is_left_out(model: JointScanCRF) -> None:
    stream = ScanStream(model)
    wheels = [np.zeros(3), np.full(3, np.nan), np.zeros(3)]
    results = [stream.feed(scan_at(np.zeros(3), seed=k), PERIOD * k, wheel) for k, wheel in enumerate(wheels)]
    assert errors(results, np.zeros((3, 3)))[1] < 0.01
