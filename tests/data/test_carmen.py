"""CARMEN logs: written to a file and read back, line by line, and the forms that are refused."""

import gzip
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan.data import carmen_survey
from torchcrf_scan.data.carmen import CarmenLog, read_carmen
from torchcrf_scan.data.carmen_line import bearings_of
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.recording import log_name

LOGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs"


def line(ranges: list[float], pose: tuple[float, float, float], stamp: float, kind: str = "FLASER") -> str:
    numbers = " ".join(f"{value:.2f}" for value in ranges)
    x, y, theta = pose
    return f"{kind} {len(ranges)} {numbers} {x} {y} {theta} {x + 1} {y} {theta} {stamp} host {stamp}"


def modern(kind: str, ranges: list[float], stamp: float, poses: str = "", geometry: str = "-1.0 2.0 0.5 8.0") -> str:
    """A line of ROBOTLASER or RAWLASER; geometry: start, field of view, step, greatest range."""
    numbers = " ".join(f"{value:.2f}" for value in ranges)
    return f"{kind} 0 {geometry} 0.01 0 {len(ranges)} {numbers} 2 7 8 {poses}{stamp} host {stamp}"


def save(folder: Path, *lines: str, name: str = "run.log") -> Path:
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


READINGS = [
    ([1.0, 2.0, 81.9, 3.0], (0.0, 0.0, 0.0), 0.5),
    ([1.1, 51.0, 2.5, 0.0], (0.1, 0.2, 0.3), 0.7),
    ([2.0] * 4, (0, 0, 0), 0.9),
]


@pytest.fixture(params=["log", "log.gz", "txt", "gz.txt"])
def path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Gzipped or not; the name does not matter."""
    text = "# comment\nPARAM a b\nODOM 0 0 0 0 0 0 0 host 0\n" + "\n".join(line(*reading) for reading in READINGS) + "\n"
    file = tmp_path / f"run.{request.param}"
    file.write_bytes(gzip.compress(text.encode()) if "gz" in request.param else text.encode())
    return file


def test_pairs_of_consecutive_readings(path: Path) -> None:
    log = CarmenLog(path)
    name = log_name(path)
    assert len(log) == 2
    first, second = log
    assert first.target.ranges.tolist() == second.source.ranges.tolist() == [1.1, 2.5]
    assert first.source.beam.tolist() == [0, 1, 3]
    assert first.source.n_beams == 4
    assert first.dt == pytest.approx(0.2)
    assert (first.name, first.sequence) == (f"{name}_00000", name)
    assert [pair.name for pair in log[-1:]] == [f"{name}_00001"]
    assert log[0].source.ranges.tolist() == [1.0, 2.0, 3.0]  # back to the beginning
    with pytest.raises(IndexError):
        log[2]


def test_readings_have_poses_in_the_order_of_motions(path: Path) -> None:
    readings = list(read_carmen(path))
    assert [reading.stamp for reading in readings] == [0.5, 0.7, 0.9]
    assert readings[1].pose.tolist() == [0.3, 0.1, 0.2]
    assert readings[1].odometry.tolist() == pytest.approx([0.3, 1.1, 0.2])


@pytest.mark.parametrize(
    ("file", "name"),
    [("run.log", "run"), ("run.log.gz", "run"), ("2003.10.12.log", "2003.10.12"), ("run.bag", "run"), ("run_0.mcap", "run_0")],
)
def test_a_log_is_named_like_its_file(file: str, name: str) -> None:
    assert log_name(Path("folder.log") / file) == name


# --- geometry -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "last"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0), (1, -90.0)])
def test_bearings(count: int, last: float) -> None:
    bearings = np.degrees(bearings_of(count))
    assert len(bearings) == count
    assert bearings[0] == pytest.approx(-90)
    assert bearings[-1] == pytest.approx(last)


@pytest.mark.parametrize(
    ("params", "first", "step"),
    [
        (["laser_front_laser_fov 240"], -120, 60),
        (["laser_frontlaser_resolution 30"], -60, 30),
        (["laser_front_laser_resolution 1"], -90, 45),  # 4 degrees in all: the line is another laser's
        (["laser_rear_laser_fov 240"], -90, 45),
        (["laser_front_laser_fov none"], -90, 45),
        (["simulator_front_laser_count_fov 10"], -90, 45),
    ],
)
def test_params_tell_the_field_of_view(tmp_path: Path, params: list[str], first: float, step: float) -> None:
    file = save(tmp_path, *(f"PARAM {text} 0.1 host 0.1" for text in params), line([1.0] * 5, (0, 0, 0), 0.0))
    bearings = np.degrees(next(read_carmen(file)).scan.bearings)
    assert bearings[0] == pytest.approx(first)
    np.testing.assert_allclose(np.diff(bearings), step)


@pytest.mark.parametrize(("kind", "poses"), [("RAWLASER1", ""), ("ROBOTLASER1", "1 2 0.5 0.9 2 0.5 0 0 0 0 0 ")])
def test_newer_lines_have_a_geometry_of_their_own(tmp_path: Path, kind: str, poses: str) -> None:
    lines = [modern(kind, [1.0, 8.0, 3.0, 7.99, 5.0], 0.1 * k, poses, f"-{1 + k} 2.0 0.5 {8 - 2 * k}") for k in range(2)]
    first, second = read_carmen(save(tmp_path, "ODOM 3 4 0.25 0 0 0 0 host 0", *lines))
    np.testing.assert_allclose(first.scan.bearings, [-1, 0, 0.5, 1.0])
    np.testing.assert_allclose(second.scan.bearings, [-2, -1, 0])
    assert first.scan.ranges.tolist() == [1.0, 3.0, 7.99, 5.0]
    assert second.scan.ranges.tolist() == [1.0, 3.0, 5.0]
    if poses:
        assert first.pose.tolist() == [0.5, 1, 2]
        np.testing.assert_allclose(first.odometry, [0.5, 1, 2])  # that of the sensor
    else:
        assert first.pose is None
        assert first.odometry.tolist() == [0.25, 3, 4]


def test_a_param_tells_where_the_laser_sits(tmp_path: Path) -> None:
    params = ["robot_frontlaser_angular_offset 1", "robot_frontlaser_offset 0.25", "robot_rearlaser_offset 9"]
    file = save(tmp_path, *(f"PARAM {text} 0 host 0" for text in params), line([1.0], (0, 0, math.pi / 2), 0))
    np.testing.assert_allclose(next(read_carmen(file)).odometry, [math.pi / 2, 1, 0.25])


def test_a_step_of_few_digits_is_made_exact_by_the_view(tmp_path: Path) -> None:
    step = math.radians(0.5)
    text = modern("RAWLASER1", [1.0] * 460, 0.0, "", f"-2.0 {459 * step:.6f} {step:.6f} 8.0")
    np.testing.assert_allclose(next(read_carmen(save(tmp_path, text))).scan.bearings, -2 + step * np.arange(460), atol=1e-6)
    text = modern("RAWLASER1", [1.0] * 4, 0.0, "", "-1.0 2.0 0.5 8.0")  # the view counts the step behind the last beam
    np.testing.assert_allclose(np.diff(next(read_carmen(save(tmp_path, text))).scan.bearings), 0.5)


def test_one_laser_of_several_is_read(tmp_path: Path) -> None:
    texts = [text for k in range(3) for text in (line([1.0 + k], (0, 0, 0), k), line([5.0], (0, 0, 0), k, "RLASER"))]
    file = save(tmp_path, *texts, modern("RAWLASER1", [9.0], 4, "", "0 0 0 20"))
    assert [reading.scan.ranges.tolist() for reading in read_carmen(file)] == [[1.0], [2.0], [3.0]]
    assert [reading.scan.ranges.tolist() for reading in read_carmen(file, ReadOptions("RLASER"))] == [[5.0]] * 3
    with pytest.raises(ValueError, match=r"run\.log: topic: expected one of FLASER, RAWLASER1, RLASER, got /scan"):
        next(read_carmen(file, ReadOptions("/scan")))


def test_the_clock_that_goes_is_read(tmp_path: Path) -> None:
    lines = [f"FLASER 1 1.0 0 0 0 0 0 0 {100 + k} host 1.07e9" for k in range(4)]
    assert [reading.stamp for reading in read_carmen(save(tmp_path, *lines))] == [100, 101, 102, 103]


# --- no return ----------------------------------------------------------------------------------------------------------------


def test_a_param_tells_the_reach(tmp_path: Path) -> None:
    lines = [line([1.0, 7.5, 8.19, 60.0], (0, 0, 0), k) for k in range(2)]
    file = save(tmp_path, "PARAM robot_front_laser_max 8.19 0 host 0", *lines)
    assert next(read_carmen(file)).scan.ranges.tolist() == [1.0, 7.5]
    assert next(read_carmen(save(tmp_path, *lines))).scan.ranges.tolist() == [1.0, 7.5, 8.19]  # too few to tell
    assert next(read_carmen(file, ReadOptions(no_return=5.0))).scan.ranges.tolist() == [1.0]


@pytest.mark.parametrize("nothing", [8.19, 29.99, 32.767])
def test_the_log_shows_what_means_nothing(tmp_path: Path, nothing: float) -> None:
    rng = np.random.default_rng(0)
    lines = []
    for k in range(5):
        ranges = np.where(rng.random(60) < 0.3, nothing, rng.uniform(1, 7, 60))
        lines.append(f"FLASER 60 {' '.join(f'{r:.3f}' for r in ranges)} 0 0 0 0 0 0 {k} host {k}")
    readings = list(read_carmen(save(tmp_path, *lines)))
    assert all(5 < len(reading.scan) < 60 for reading in readings)
    assert max(reading.scan.ranges.max() for reading in readings) < 7


# --- faults -------------------------------------------------------------------------------------------------------------------

BROKEN = ["FLASER three 1 2 3", "FLASER 3 1 2", "FLASER 2 1.0 x 0 0 0 0 0 0 0 h 0", "FLASER ", "FLASER 2 1.0 2.0 0 0 0",
          "FLASER -1 0 0 0 0 0 0 0 h 0", "FLASER 1 1,5 0 0 0 0 0 0 0 h 0", "FLASER 1 1 0 0 0 0 0 0 nan h 0",
          f"FLASER {10**6} 1 0 0 0 0 0 0 0 h 0"]  # fmt: skip


@pytest.mark.parametrize("text", BROKEN)
def test_a_broken_line_is_named_after_the_scans_before_it(tmp_path: Path, text: str) -> None:
    file = save(tmp_path, *(line(*reading) for reading in READINGS), text, line(*READINGS[0]), name="broken.log")
    found, offset = [], sum(len(line(*reading)) + 1 for reading in READINGS)
    with pytest.raises(ValueError, match=rf"broken\.log, line 4 \(byte {offset}\): expected"):
        found.extend(read_carmen(file))
    assert [reading.stamp for reading in found] == [0.5, 0.7, 0.9]


def test_a_damaged_log_keeps_its_whole_pairs(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = save(tmp_path, *(line(*reading) for reading in READINGS), line(*READINGS[0])[:30])
    log = CarmenLog(file)
    assert [pair.dt for pair in log] == pytest.approx([0.2, 0.2])
    assert "line 4" in str(log.fault)
    assert "line 4" in caplog.text
    assert CarmenLog(save(tmp_path, *(line(*reading) for reading in READINGS))).fault is None
    with pytest.raises(ValueError, match=r"line 1 \(byte 0\)"):
        CarmenLog(save(tmp_path, "FLASER 3 1"))


def test_a_cut_gzip_gives_what_is_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    text = "\n".join(line(list(rng.uniform(1, 9, 180)), (0, 0, 0), k) for k in range(200))
    whole = gzip.compress(text.encode())
    (tmp_path / "cut.log.gz").write_bytes(whole[: len(whole) // 2])
    found = []
    with pytest.raises(ValueError, match=r"cut\.log\.gz, line \d+ \(byte \d+\): expected a whole file, got"):
        found.extend(read_carmen(tmp_path / "cut.log.gz"))
    assert 50 < len(found) < 150
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    (tmp_path / "damaged.log.gz").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"damaged\.log\.gz, line \d+"):
        list(read_carmen(tmp_path / "damaged.log.gz"))


def test_files_that_are_no_logs(tmp_path: Path) -> None:
    (tmp_path / "empty.log").write_text("ODOM\n")
    (tmp_path / "cut.log.gz").write_bytes(gzip.compress(b"FLASER 1 1 0 0 0 0 0 0 0 h 0\n" * 99)[:20])
    (tmp_path / "binary.log").write_bytes(b"FLASER 1 1\0 0 0 0 0 0 0 0 h 0\n")
    for name in ("empty.log", "cut.log.gz", "binary.log"):
        with pytest.raises(ValueError, match=f"{name}.*: expected"):
            CarmenLog(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        CarmenLog(tmp_path / "none.log")


def test_text_without_end_is_refused_before_it_fills_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.log.gz").write_bytes(gzip.compress(bytes(1 << 26)))
    with pytest.raises(ValueError, match=r"a\.log\.gz, line 1 \(byte 0\): expected lines of at most"):
        CarmenLog(tmp_path / "a.log.gz")
    monkeypatch.setattr(carmen_survey, "MOST_SILENCE", 10_000)
    (tmp_path / "b.log").write_text("nothing to see\n" * 1000)
    with pytest.raises(ValueError, match=r"b\.log: expected a scan within the first 10000 bytes, got none"):
        CarmenLog(tmp_path / "b.log")


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lines = [line(list(rng.uniform(1, 9, 180)), (0, 0, 0), k) for k in range(400)]
    peaks = []
    for times in (1, 4):
        (tmp_path / "run.log.gz").write_bytes(gzip.compress("\n".join(lines * times).encode(), 1))
        tracemalloc.start()
        assert sum(len(reading.scan) for reading in read_carmen(tmp_path / "run.log.gz")) == 400 * 180 * times
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


@pytest.mark.skipif(not LOGS.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize(("name", "pairs", "beams"), [("freiburg-079-corrected", 4790, 360), ("fhw-corrected", 487, 180)])
def test_real_logs(name: str, pairs: int, beams: int) -> None:
    log = CarmenLog(LOGS / f"{name}.log.gz")
    assert len(log) == pairs
    assert log[0].source.n_beams == beams
    assert all(len(reading.scan) > 10 for reading in read_carmen(LOGS / f"{name}.log.gz"))


@pytest.mark.parametrize("bad", ["FLASER 4 1 2 three 4 0 0 0 0 0 0 0.6 host 0.6", "FLASER 9 1 2", "FLASER"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_malformed_lines_are_left_out_on_request(tmp_path: Path, bad: str, place: int) -> None:
    lines, told = [line(*reading) for reading in READINGS], list[ValueError]()
    lines.insert(place, f"{bad} ")
    path = save(tmp_path, *lines)
    assert len(list(read_carmen(path, ReadOptions(on_bad=told.append)))) == 3
    assert [str(error).startswith(f"{path}, line {place + 1} ") for error in told] == [True]
    with pytest.raises(ValueError, match=f"line {place + 1} "):
        list(read_carmen(path))


def test_absurd_bearings_are_left_out_on_request(tmp_path: Path) -> None:
    steps = ("-1.0 2.0 0.5 8.0", "nan 2.0 0.5 8.0", "-1.0 2000 500 8.0", "-1.0 2.0 0.5 8.0")
    lines = [modern("RAWLASER1", [1.0] * 5, 0.1 * k, geometry=step) for k, step in enumerate(steps)]
    told = list[ValueError]()
    assert len(list(read_carmen(save(tmp_path, *lines), ReadOptions(on_bad=told.append)))) == 2
    assert ["line 2" in str(told[0]), "line 3" in str(told[1])] == [True, True]


def test_a_cut_line_or_file_ends_the_reading(tmp_path: Path) -> None:
    text = "\n".join(line(*reading) for reading in READINGS)
    told = list[ValueError]()
    for name, data in (("cut.log", text[:-40].encode()), ("cut.gz", gzip.compress(text.encode())[:-9])):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=r"line \d \(byte"):
            list(read_carmen(tmp_path / name, ReadOptions(on_bad=told.append)))
    assert told == []


def test_a_pose_that_is_not_finite_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text(
        "FLASER 1 2.0 1 2 nan nan nan nan 0.1 h 0.1\nFLASER 1 2.0 nan 2 0 1 inf 0 0.2 h 0.2\nFLASER 1 2 1 2 3 1 2 3 0.3 h 0.3\n"
    )
    first, second, third = read_carmen(path)
    assert (first.pose, first.odometry, second.pose, second.odometry) == (None, None, None, None)
    assert (third.pose.tolist(), third.odometry.tolist()) == ([3, 1, 2], [3, 1, 2])
