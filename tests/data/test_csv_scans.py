"""Scans in rows of a CSV file."""

from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan.data.formats import read_recording, read_scans
from torchcrf_scan.data.options import ReadOptions

HEAD = "stamp,-0.5,0.0,0.5"


def save(folder: Path, *rows: str) -> Path:
    path = folder / "run.csv"
    path.write_bytes("\r\n".join(rows).encode() + b"\n")
    return path


def test_rows_are_scans(tmp_path: Path) -> None:
    first, second = read_scans(save(tmp_path, HEAD, "0.5,1,2.5,3", "", "0.6, , inf,4.5"))
    assert (first.stamp, second.stamp) == (0.5, 0.6)
    assert first.scan.ranges.tolist() == [1, 2.5, 3]
    assert first.scan.bearings.tolist() == [-0.5, 0, 0.5]
    assert second.scan.beam.tolist() == [2]
    assert (first.odometry, first.scan.range_max) == (None, None)
    assert [len(r.scan) for r in read_scans(tmp_path / "run.csv", no_return=2.5)] == [1, 0]


def test_odometry_columns(tmp_path: Path) -> None:
    path = save(tmp_path, "stamp,odom_theta,odom_x,odom_y,1.0,0.5", "0,0,0,0,2,2", "0.1,0.1,0.2,0,2,2")
    assert [reading.odometry.tolist() for reading in read_scans(path)] == [[0, 0, 0], [0.1, 0.2, 0]]
    pair = read_recording(path)[0]
    np.testing.assert_allclose(pair.initial_motion, [-0.1, -0.2 * np.cos(0.1), 0.2 * np.sin(0.1)])
    assert pair.source.beam.tolist() == [1, 0]
    path = save(tmp_path, "stamp,odom_theta,odom_x,odom_y,1.0,0.5", "0,0,nan,0,2,2", "0.1,,,,2,2")
    assert [reading.odometry for reading in read_scans(path)] == [None, None]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([HEAD, "0,1,2,3", "1,1,2"], r"line 3 \(byte 29\): expected 4 fields, got 3"),
        ([HEAD, "0,1,2,3", "1,1,two,3"], "line 3 .*: expected numbers, got"),
        ([HEAD, "0,1,2,3", ",1,2,3"], "line 3 .*: expected a finite stamp, got"),
        (["stamp,a,b", "0,1,2"], "line 1 .*: expected bearings of one turn in radians behind stamp"),
        (["stamp,-90,0,90", "0,1,2,3"], "are these degrees"),
        (["stamp,", "0,1"], "line 1"),
    ],
)
def test_wrong_rows_are_named(tmp_path: Path, rows: list[str], message: str) -> None:
    found = []
    with pytest.raises(ValueError, match=message):
        found.extend(read_scans(save(tmp_path, *rows)))
    assert len(found) == (1 if len(rows) == 3 else 0)


def test_an_option_must_be_possible() -> None:
    with pytest.raises(ValueError, match="no_return: expected metres above 0, got 0"):
        ReadOptions(no_return=0)


def test_malformed_rows_are_left_out_on_request(tmp_path: Path) -> None:
    path, bad = save(tmp_path, HEAD, "0,1,2,3", "1,1,2", "2,1,two,3", ",1,2,3", "4,1,2,3"), list[ValueError]()
    assert [reading.stamp for reading in read_scans(path, on_bad=bad.append)] == [0, 4]
    assert [str(error).split("(")[0] for error in bad] == [f"{path}, line {number} " for number in (3, 4, 5)]


def test_a_cut_row_ends_the_reading(tmp_path: Path) -> None:
    path, found, bad = save(tmp_path, HEAD, "0,1,2,3", "1,1,2"), [], list[ValueError]()
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"line 3 .*: expected 4 fields, got 3"):
        found.extend(read_scans(path, on_bad=bad.append))
    assert (len(found), bad) == (1, [])
