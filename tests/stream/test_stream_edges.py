"""Whatever comes in, a stream answers: finite poses, covariances that a filter accepts, and no memory that grows."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms_cast import BEAMS, ROOM, box, ranges_at, scan_at

from torchcrf_scan import JointScanCRF, Scan, ScanResult, ScanStream

FEW = BEAMS[::6]
model = JointScanCRF.from_pretrained()


def check(result: ScanResult, scan: Scan) -> None:
    assert np.isfinite(result.pose).all()
    assert np.isfinite(result.twist).all()
    for covariance in (result.covariance, result.twist_covariance):
        assert np.isfinite(covariance).all()
        assert np.linalg.eigvalsh(covariance).min() > 0
    assert result.moving.shape == result.track.shape == (scan.n_beams,)
    without_return = np.setdiff1d(np.arange(scan.n_beams), scan.beam)
    assert not result.moving[without_return].any()
    assert (result.track[without_return] == -1).all()
    numbers = {of.number for of in result.objects}
    assert set(result.track[result.moving]) <= numbers
    assert (result.track[~result.moving] <= 0).all()
    assert bool(result.reason) == (result.status != "ok")


KINDS = ("room", "person", "noise", "empty", "one", "two", "near", "same")


def scan_of(kind: str, k: int) -> Scan:
    """A scan of few beams; some with times."""
    rng = np.random.default_rng(k)
    room = ranges_at(np.array([0.0, 0.03 * k, 0.0]), np.concatenate([ROOM, box(1.5, -1 + 0.1 * k)]), FEW)
    some = np.full(len(FEW), np.nan)
    some[: {"one": 1, "two": 2}.get(kind, 0)] = 1.0
    ranges = {
        "room": ranges_at(np.array([0.0, 0.03 * k, 0.0]), ROOM, FEW),
        "person": room,
        "noise": rng.uniform(0.1, 9, len(FEW)),
        "near": rng.uniform(0.1, 0.2, len(FEW)),
        "same": np.full(len(FEW), 2.0),
    }.get(kind, some)
    times = np.linspace(0, 0.07, len(FEW)) if k % 2 else None
    return Scan.from_ranges(ranges, FEW, range_max=30.0, times=times)


@settings(max_examples=15)
@given(st.lists(st.tuples(st.sampled_from(KINDS), st.floats(-1, 3)), min_size=2, max_size=8))
def test_any_scans_at_any_times(sequence: list[tuple[str, float]]) -> None:
    stream, stamp = ScanStream(model), 0.0
    for k, (kind, step) in enumerate(sequence):
        stamp += 0.1 if step < 1 else step - 1  # mostly regular, some stand still, some gaps
        scan = scan_of(kind, k)
        check(stream.feed(scan, stamp), scan)


@pytest.mark.parametrize("stamp", [np.nan, np.inf, -1e300, 1e300])
def test_senseless_stamps_and_odometry(stamp: float) -> None:
    stream = ScanStream(model)
    for k in range(4):
        scan = scan_of("room", k)
        check(stream.feed(scan, stamp if k == 2 else 0.1 * k, np.full(3, stamp) if k % 2 else None), scan)


def test_memory_is_flat() -> None:
    """After as many scans as are remembered, nothing that a stream holds grows any more, however small."""
    stream, sizes = ScanStream(model), []
    held = [name for name in vars(stream) if name not in ("model", "config")]
    for k in range(300):
        x = 0.5 * np.sin(0.05 * k)
        segments = np.concatenate([ROOM, box(1.8, -2 + 0.1 * (k % 40))])
        ranges = ranges_at(np.array([0.0, x, 0.0]), segments, FEW) + np.random.default_rng(k).normal(0, 0.004, len(FEW))
        result = stream.feed(Scan.from_ranges(ranges, FEW, range_max=30.0), 0.1 * k)
        sizes.append([len(pickle.dumps(getattr(stream, name))) for name in held])
    assert result.status == "ok"
    before, after = np.max(sizes[60:180], axis=0), np.max(sizes[180:], axis=0)
    assert not [name for name, grows in zip(held, after > 1.02 * before + 8, strict=True) if grows]


def test_a_stream_without_movers_has_no_objects() -> None:
    stream = ScanStream(model)
    results = [stream.feed(scan_at(np.array([0.0, 0.05 * k, 0.0]), seed=k), 0.1 * k) for k in range(12)]
    assert not any(result.objects or result.moving.any() for result in results)


def test_an_object_keeps_its_number_and_velocity() -> None:
    """A box passes at 1 m/s while the sensor drives by."""
    stream, results = ScanStream(model), []
    for k in range(20):
        segments = np.concatenate([ROOM, box(2.0, -2.0 + 0.1 * k)])
        results.append(stream.feed(scan_at(np.array([0.0, 0.03 * k, 0.0]), segments, k), 0.1 * k))
    seen = [result.objects for result in results[6:]]
    assert all(len(objects) == 1 for objects in seen)
    assert len({objects[0].number for objects in seen}) == 1
    last = seen[-1][0]
    np.testing.assert_allclose(last.velocity, [0.0, 1.0], atol=0.15)
    np.testing.assert_allclose(last.position, [2.0, -0.1], atol=0.2)
    assert (results[-1].track == last.number).sum() == last.points > 5


@pytest.mark.parametrize("step", [0.1, 0.125])
def test_a_stream_that_starts_anew_answers_like_a_new_one(step: float) -> None:
    """Of what it has seen before a gap and another place nothing is left but the pose and the numbers of objects."""
    poses = [np.array([0.05, 0.03, 0.0]) * min(k, 10) for k in range(24)]  # it turns, drives and stands
    scans = [scan_at(pose, np.concatenate([ROOM, box(2.0, -2.0 + 0.1 * k)]), k) for k, pose in enumerate(poses)]
    elsewhere = Scan.from_ranges(0.3 + 0.01 * np.sin(np.arange(len(BEAMS))), BEAMS)
    stream = ScanStream(model)

    def play(stream: ScanStream, since: float) -> list[ScanResult]:
        return [stream.feed(scan, since + step * k) for k, scan in enumerate(scans)]

    play(stream, 0.0)
    stream.feed(elsewhere, 100.0)
    again, new = play(stream, 200.0), play(ScanStream(model), 0.0)
    assert any(result.objects for result in new)
    for a, b in zip(again[1:], new[1:], strict=True):
        assert (a.moving == b.moving).all()
        assert (a.status, len(a.objects)) == (b.status, len(b.objects))
        np.testing.assert_allclose(a.twist, b.twist, atol=1e-9)
