"""Recordings are written again without what moves, and everything else in them stays."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from results import FakeStream, carmen_log

from torchcrf_scan.data.clean_carmen import writing_clean_carmen
from torchcrf_scan.data.clean_log import clean_name, writing_clean
from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.spatial_covariance import LEAST, MOST, spatial_covariance
from torchcrf_scan.result import ScanResult


def results_of(log: Path, count: int | None = None) -> list[ScanResult]:
    stream = FakeStream()
    return [stream.feed(reading.scan, reading.stamp) for reading in list(read_scans(log))[:count]]


def clean(log: Path, count: int | None = None) -> Path:
    target = log.parent / "made" / clean_name(log)
    target.parent.mkdir(exist_ok=True)
    with writing_clean(log, target, ReadOptions()) as write:
        for result in results_of(log, count):
            write(result)
    return target


def check_scans(log: Path, target: Path) -> None:
    """Every third beam returns nothing any more, the others what they did."""
    pairs = list(zip(read_scans(log), read_scans(target), strict=True))
    assert len(pairs) > 2
    for before, after in pairs:
        assert after.stamp == pytest.approx(before.stamp)
        keep = before.scan.beam % 3 != 0
        np.testing.assert_array_equal(after.scan.beam, before.scan.beam[keep])
        np.testing.assert_allclose(after.scan.ranges, before.scan.ranges[keep])


def test_a_carmen_log_keeps_everything_but_the_moving_beams(tmp_path: Path) -> None:
    log = carmen_log(tmp_path / "a.log")
    target = clean(log)
    assert target.name == "clean.log"
    check_scans(log, target)
    before, after = (path.read_text().splitlines() for path in (log, target))
    assert [line for line in after if not line.startswith("FLASER")] == [line for line in before if not line.startswith("FLASER")]
    assert [line.split()[62:] for line in after] == [line.split()[62:] for line in before]


def test_a_packed_log_stays_packed(tmp_path: Path) -> None:
    packed = tmp_path / "a.log.gz"
    packed.write_bytes(gzip.compress(carmen_log(tmp_path / "a.log").read_bytes()))
    target = clean(packed)
    assert target.name == "clean.log.gz"
    assert target.read_bytes()[:2] == b"\x1f\x8b"
    check_scans(packed, target)


def test_a_laser_with_its_own_reach_gets_that(tmp_path: Path) -> None:
    lines = []
    for k in range(4):
        ranges = " ".join(f"{value:.2f}" for value in 2.0 + 0.01 * np.arange(31))
        lines.append(f"ROBOTLASER1 0 -1.57 3.14 0.1047 8.0 0.01 0 31 {ranges} 0 0 0 0 0 0 0 0 0 0 0 0 {k}.5 host {k}.5\n")
    (tmp_path / "a.log").write_text("".join(lines))
    target = clean(tmp_path / "a.log")
    assert " 8.00 2.01 2.02 8.00 " in target.read_text().splitlines()[0]
    check_scans(tmp_path / "a.log", target)


def test_scans_without_result_and_what_follows_them_are_left_out(tmp_path: Path) -> None:
    log = carmen_log(tmp_path / "a.log")
    text = clean(log, 10).read_text()
    assert text.count("FLASER") == 10
    assert "TAIL" not in text


def test_a_result_of_another_log_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    log = carmen_log(tmp_path / "a.log")
    result = replace(results_of(log, 1)[0], stamp=7.0)

    def other() -> None:
        with writing_clean_carmen(log, tmp_path / "b.log", ReadOptions()) as write:
            write(result)

    with pytest.raises(ValueError, match=r"a\.log: expected the scan of 7\.000000 s"):
        other()
    assert [path.name for path in tmp_path.iterdir()] == ["a.log"]


def test_what_is_no_log_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("stamp,angle_min,angle_increment\n")
    with pytest.raises(ValueError, match="--clean: expected a CARMEN log or a bag"):
        clean_name(tmp_path / "a.csv")


@pytest.mark.parametrize("form", ["ros1", "sqlite", "mcap", "mcap file"])
def test_a_bag_keeps_its_topics_and_gets_odometry(tmp_path: Path, form: str) -> None:
    pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")
    from bags import drive, wheels, write

    from torchcrf_scan.data.clean_bag import FOUND

    log = write(tmp_path, form, [*drive(5), *wheels(5)])
    target = clean(log)
    assert target.name == ("clean.bag" if form == "ros1" else "clean")
    check_scans(log, target)
    assert len(list(read_scans(target, odometry="/odom"))) == 5
    poses = [reading.odometry for reading in read_scans(target, odometry=FOUND) if reading.odometry is not None]
    np.testing.assert_allclose(np.diff(poses, axis=0), [[0, 0.1, 0]] * (len(poses) - 1), atol=1e-6)
    assert len(poses) >= 4


def test_the_points_of_a_cloud_are_blanked(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")
    from bags import CLOUD, cloud, write

    bearings = np.linspace(-2, 2, 60)
    points = np.stack([3 * np.cos(bearings), 3 * np.sin(bearings), 0 * bearings], axis=1).astype(np.float32)
    messages = [("/cloud", CLOUD, 100.0 + k, cloud(100.0 + k, points, height=2)) for k in range(4)]
    log = write(tmp_path, "ros1", messages)
    check_scans(log, clean(log))


@given(arrays(np.float64, (3, 3), elements=st.floats(-1e12, 1e12)), st.booleans())
def test_covariances_are_what_filters_accept(values: np.ndarray, is_known: bool) -> None:
    told = values @ values.T / max(np.abs(values).max(), 1.0) if is_known else np.full((3, 3), np.nan)
    full = spatial_covariance(told).reshape(6, 6)
    assert np.isfinite(full).all()
    np.testing.assert_array_equal(full, full.T)
    assert np.linalg.eigvalsh(full).min() > 0 or np.linalg.eigvalsh(full).max() > 1e5
    assert (np.diag(full) >= LEAST * 0.9).all()
    assert np.abs(full).max() <= 1.001 * MOST


def test_covariances_keep_their_place() -> None:
    told = np.array([[0.01, 0.001, 0.002], [0.001, 0.2, 0.03], [0.002, 0.03, 0.4]])
    full = spatial_covariance(told).reshape(6, 6)
    np.testing.assert_allclose(full[np.ix_((5, 0, 1), (5, 0, 1))], told)
    assert (full[2, :2] == 0).all()
