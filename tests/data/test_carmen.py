"""CARMEN logs: written to a file and read back, and the forms that are refused."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan.data.carmen import CarmenLog, bearings_of, log_name

LOGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs"


def line(ranges: list[float], pose: tuple[float, float, float], stamp: float) -> str:
    numbers = " ".join(f"{value:.2f}" for value in ranges)
    x, y, theta = pose
    return f"FLASER {len(ranges)} {numbers} {x} {y} {theta} {x + 1} {y} {theta} {stamp} host {stamp}"


READINGS = [
    ([1.0, 2.0, 81.9, 3.0], (0.0, 0.0, 0.0), 0.5),
    ([1.1, 51.0, 2.5, 0.0], (0.1, 0.2, 0.3), 0.7),
    ([2.0] * 4, (0, 0, 0), 0.9),
]


@pytest.fixture(params=["log", "log.gz"])
def path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    text = "# comment\nPARAM a b\nODOM 0 0 0 0 0 0 0 host 0\n" + "\n".join(line(*reading) for reading in READINGS) + "\n"
    file = tmp_path / f"run.{request.param}"
    file.write_bytes(gzip.compress(text.encode()) if file.suffix == ".gz" else text.encode())
    return file


def test_pairs_of_consecutive_readings(path: Path) -> None:
    log = CarmenLog(path)
    assert len(log) == 2
    first, second = log
    assert first.target.ranges.tolist() == second.source.ranges.tolist() == [1.1, 2.5]
    assert first.source.beam.tolist() == [0, 1, 3]
    assert first.source.n_beams == 4
    assert first.dt == pytest.approx(0.2)
    assert (first.name, first.sequence) == ("run_00000", "run")
    assert [pair.name for pair in log[-1:]] == ["run_00001"]
    assert log.scans[1].pose.tolist() == [0.1, 0.2, 0.3]
    assert log.scans[1].odometry.tolist() == pytest.approx([1.1, 0.2, 0.3])
    with pytest.raises(IndexError):
        log[2]


@pytest.mark.parametrize(
    ("file", "name"),
    [("run.log", "run"), ("run.log.gz", "run"), ("2003.10.12.log", "2003.10.12")],
)
def test_a_log_is_named_like_its_file(file: str, name: str) -> None:
    assert log_name(Path("folder.log") / file) == name


@pytest.mark.parametrize(("count", "last"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0), (1, -90.0)])
def test_bearings(count: int, last: float) -> None:
    bearings = np.degrees(bearings_of(count))
    assert len(bearings) == count
    assert bearings[0] == pytest.approx(-90)
    assert bearings[-1] == pytest.approx(last)


@pytest.mark.parametrize(
    "text", ["FLASER three 1 2 3", "FLASER 3 1 2", "FLASER 2 1.0 x 0 0 0 0 0 0 0 h 0", "FLASER", "FLASER 2 1.0 2.0 0 0 0"]
)
def test_a_broken_line_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "broken.log"
    file.write_text(f"{line(*READINGS[0])}\n{text} \n")
    with pytest.raises(ValueError, match=r"broken\.log, line 2: expected"):
        CarmenLog(file)


def test_files_that_are_no_logs(tmp_path: Path) -> None:
    (tmp_path / "empty.log").write_text("ODOM\n")
    (tmp_path / "cut.log.gz").write_bytes(gzip.compress(b"FLASER 1 1 0 0 0 0 0 0 0 h 0\n" * 99)[:40])
    (tmp_path / "plain.log.gz").write_text("FLASER")
    for name in ("empty.log", "cut.log.gz", "plain.log.gz", "none.log"):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            CarmenLog(tmp_path / name)


@pytest.mark.skipif(not LOGS.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize(("name", "pairs", "beams"), [("freiburg-079-corrected", 4790, 360), ("fhw-corrected", 487, 180)])
def test_real_logs(name: str, pairs: int, beams: int) -> None:
    log = CarmenLog(LOGS / f"{name}.log.gz")
    assert len(log) == pairs
    assert log[0].source.n_beams == beams
    assert all(len(reading.scan) > 10 for reading in log.scans[::100])
