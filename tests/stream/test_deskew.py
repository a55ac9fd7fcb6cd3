"""Correction for the motion during a sweep."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rooms_cast import BEAMS, ROOM, ranges_at
from support import assert_close

from torchcrf_scan import JointScanCRF, Scan, ScanStream, StreamConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats
from torchcrf_scan.stream import twist
from torchcrf_scan.stream.deskew import Deskewing, deskewed, doubt

PERIOD, SWEEP = 0.1, 0.075  # seconds; 270 degrees of a turn
TIMES = np.linspace(0, SWEEP, len(BEAMS))
VELOCITY = np.array([1.5, 1.0, 0.2])


def swept(pose: Floats, velocity: Floats = VELOCITY, sweep: float = SWEEP, told: float | None = None) -> Scan:
    """A scan of the room whose beams are cast one after the other while the sensor moves. told: seconds that the scan states."""
    times = np.linspace(0, sweep, len(BEAMS))
    poses = se2.compose(np.tile(pose, (len(BEAMS), 1)), twist.exp(times[:, None] * velocity))
    ranges = [ranges_at(at, ROOM, BEAMS[k : k + 1])[0] for k, at in enumerate(poses)]
    return Scan.from_ranges(ranges, BEAMS, times=np.linspace(0, sweep if told is None else told, len(BEAMS)), range_max=30.0)


def test_corrected_scan_lies_on_the_walls() -> None:
    """The walls' normals are the axes: a return lies on one if a coordinate is the wall's."""
    scan = swept(np.zeros(3))
    walls = np.array([[0, -4.0], [0, 6.0], [1, -3.0], [1, 4.0]])

    def off(points: Floats) -> float:
        away = [np.abs(points[:, int(axis)] - place) for axis, place in walls]
        return float(np.sort(np.min(away, axis=0))[: int(0.85 * len(points))].max())  # without the slanted screen in the room

    assert off(scan.points) > 0.05
    assert off(deskewed(scan, VELOCITY).points) < 1e-9


def test_nothing_changes_for_a_sensor_that_stands() -> None:
    scan = swept(np.zeros(3), np.zeros(3))
    assert_close(deskewed(scan, np.zeros(3)).points, scan.points)


@given(st.tuples(*[st.floats(-5, 5)] * 3), st.integers(0, 40))
def test_any_motion_leaves_beams_and_times_together(velocity: tuple[float, float, float], count: int) -> None:
    rng = np.random.default_rng(count)
    bearings = rng.uniform(-np.pi, np.pi, count)
    scan = Scan.from_ranges(rng.uniform(0.3, 9, count), bearings, times=np.sort(rng.uniform(0, 0.1, count)))
    corrected = deskewed(scan, np.array(velocity))
    assert (np.diff(corrected.bearings) >= 0).all()
    assert sorted(corrected.beam) == sorted(scan.beam)
    by_beam = se2.apply(twist.exp(scan.times[:, None] * np.array(velocity)), scan.points[:, None])[:, 0]
    assert_close(corrected.to_beams(corrected.points, 0.0), scan.to_beams(by_beam, 0.0), tolerance=1e-9)


@pytest.mark.parametrize(
    ("sweep", "period", "word"),
    [(SWEEP, 0.1, ""), (SWEEP, 0.05, "longer"), (SWEEP / 20, 0.1, "20 times less"), (0.0, 0.1, "no times")],
)
def test_doubt(sweep: float, period: float, word: str) -> None:
    scan = Scan.from_ranges(np.full(len(BEAMS), 2.0), BEAMS, times=np.linspace(0, sweep, len(BEAMS)))
    assert word in doubt(scan, period)
    assert bool(word) == bool(doubt(scan, period))


def test_wrong_times_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    deskewing, scan = Deskewing(True), swept(np.zeros(3), told=SWEEP / 20)
    with caplog.at_level(logging.WARNING):
        assert not any(deskewing.suits(scan, PERIOD) for _ in range(3))
    assert len(caplog.records) == 1
    assert "20 times less" in caplog.text
    assert not Deskewing(False).suits(swept(np.zeros(3)), PERIOD)


def test_stream_of_swept_scans() -> None:
    """Poses are those at the first beam; speeding up makes uncorrected scans disagree."""
    model = JointScanCRF.from_pretrained()
    poses, scans, pose = [], [], np.zeros(3)
    for k in range(14):
        velocity = VELOCITY * np.array([np.sin(0.5 * k) / 2, min(k, 8) / 8, 1.0])
        poses.append(pose)
        scans.append(swept(pose, velocity))
        pose = se2.compose(pose, twist.exp(PERIOD * velocity))

    def errors(is_on: bool) -> Floats:
        stream = ScanStream(model, StreamConfig(deskew=is_on))
        results = [stream.feed(scan, PERIOD * k) for k, scan in enumerate(scans)]
        return np.hypot(*se2.distance(np.stack([result.pose for result in results]), np.stack(poses)))[3:]

    with_times, without = errors(True), errors(False)
    assert with_times.max() < 0.03
    assert with_times.mean() < without.mean() / 2
