"""Formats are recognised by what a file holds."""

import gzip
import pickle
from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan.data.carmen import read_carmen
from torchcrf_scan.data.formats import FORMATS, find_format, read_recording, read_scans
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.scan import Scan, ScanPair

READING = "FLASER 3 1.00 1.10 1.20 0 0 0 0 0 0 {stamp:.2f} robot {stamp:.2f}\n"
CARMEN = "# a log\n" + "".join(READING.format(stamp=k / 10) for k in range(3))


def name_of(path: Path) -> str | None:
    form = find_format(path)
    return None if form is None else form.name


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (CARMEN.encode(), "CARMEN log"),
        (gzip.compress(CARMEN.encode(), mtime=0), "CARMEN log"),
        (b"PARAM a b\r\n\tODOM \xe4 \x93\n", "CARMEN log"),
        (b"stamp,0.0,0.1\n", "CSV of ranges"),
        (gzip.compress(b'\xef\xbb\xbf"stamp",0.0,0.1\n', mtime=0), "CSV of ranges"),
        (b"#ROSBAG V2.0\n\0\0", "ROS 1 bag"),
        (b"\x89MCAP0\r\n\1", "MCAP file"),
        (b"SQLite format 3\0", "ROS 2 database"),
        (b"PK\3\4", "pair file"),
        (b"  \n", None),
        (b"\x93NUMPY\1\0", None),
        (pickle.dumps([1, 2]), None),
        (bytes(1000), None),
    ],
)
@pytest.mark.parametrize("file", ["run.log", "run.npz", "run"])
def test_a_file_is_known_by_its_content(tmp_path: Path, content: bytes, name: str | None, file: str) -> None:
    path = tmp_path / file
    path.write_bytes(content)
    assert name_of(path) == name
    if name is None:
        with pytest.raises(ValueError, match=r": expected one of pair file, ROS 1 bag, .*, got none of these$") as error:
            read_scans(path)
        assert "pickle" not in str(error.value)


def test_another_text_is_told_the_formats(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# Scans\n\nNo scan in here.\n")
    with pytest.raises(ValueError, match=r": expected one of pair file, ROS 1 bag, .*, got another text .*FLASER"):
        list(read_scans(tmp_path / "README.md"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"#ROSBAG V2",
        b"\x89MCAP",
        b"SQLite format",
        b"P",
        b"\x1f\x8b\x07" + bytes(9),
        b"\x1f\x8b\x08\0",
        gzip.compress(CARMEN.encode(), mtime=0)[:15],
    ],
)
def test_a_file_that_ends_before_its_format_is_known(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.bag"
    path.write_bytes(content)
    got = f"a file that is cut after {len(content)} bytes" if content else "an empty file"
    assert find_format(path) is None
    with pytest.raises(ValueError, match=rf"run\.bag: expected one of pair file, .*, got {got}$"):
        read_scans(path)


def test_a_folder_is_known_by_its_metadata(tmp_path: Path) -> None:
    assert find_format(tmp_path) is None
    (tmp_path / "metadata.yaml").write_text("a: b")
    assert name_of(tmp_path) == "folder of ROS 2"


def test_every_format_has_its_name() -> None:
    assert len({form.name for form in FORMATS}) == len(FORMATS)


def test_a_recording_has_the_pairs_of_consecutive_scans(tmp_path: Path) -> None:
    path = tmp_path / "run.txt"
    path.write_text(CARMEN)
    recording = read_recording(path)
    assert len(recording) == 2
    assert recording[1].name == recording.pair_name(1) == "run.txt_00001"
    assert recording[1].dt == pytest.approx(0.1)
    assert [reading.stamp for reading in read_scans(path)] == [reading.stamp for reading in read_carmen(path)]


def test_a_malformed_line_is_left_out_of_the_pairs_on_request(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, told = tmp_path / "run.log", list[ValueError]()
    lines = [READING.format(stamp=k / 10) for k in range(4)]
    path.write_text("".join([*lines[:2], "FLASER 3 1.00 two 1.20\n", *lines[2:]]))
    recording = read_recording(path, ReadOptions(on_bad=told.append))
    assert len(list(recording)) == len(list(recording)) == 3
    assert (len(told), recording.fault, caplog.text) == (1, None, "")
    assert len(ended := read_recording(path)) == 1
    assert str(ended.fault) == str(told[0])


def test_one_scan_makes_no_pair(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text(READING.format(stamp=0.0))
    with pytest.raises(ValueError, match=r"run\.log: expected at least two scans, got one$"):
        read_recording(path)


@pytest.mark.parametrize(
    ("content", "options", "name"),
    [
        ("stamp,0.0,0.1\n0,1,2\n", {"topic": "/scan"}, "topic"),
        ("stamp,0.0,0.1\n0,1,2\n", {"odometry": "/odom"}, "odometry"),
        (CARMEN, {"odometry": "/odom"}, "odometry"),
    ],
)
def test_options_without_meaning_are_refused(tmp_path: Path, content: str, options: dict[str, str], name: str) -> None:
    path = tmp_path / "run"
    path.write_text(content)
    told = rf"run: {name}: expected none, as this is a C[\w ]+, got {options[name]}$"
    with pytest.raises(ValueError, match=told):
        read_scans(path, **options)
    with pytest.raises(ValueError, match=told):
        read_recording(path, ReadOptions(**options))
    assert len(list(read_scans(path, odometry="auto", no_return=50.0)))


def test_a_pair_file_takes_no_options(tmp_path: Path) -> None:
    scan = Scan.from_ranges([1.0, 2.0], [0.2, 0.1])
    write_pair(tmp_path / "pair.npz", ScanPair(scan, scan, 0.25))
    for options in ({"topic": "/scan"}, {"no_return": 8.0}):
        with pytest.raises(ValueError, match=r"pair\.npz: \w+: expected none, as this is a pair file, got"):
            read_scans(tmp_path / "pair.npz", **options)


def test_a_pair_file_is_two_scans(tmp_path: Path) -> None:
    scans = [Scan.from_ranges([1.0, np.nan, 2.0 + k], [0.2, 0.1, 0.0]) for k in range(2)]
    write_pair(tmp_path / "pair.npz", ScanPair(*scans, 0.25))
    first, second = read_scans(tmp_path / "pair.npz")
    assert (first.stamp, second.stamp) == (0.0, 0.25)
    np.testing.assert_array_equal(second.scan.ranges, scans[1].ranges)
    assert read_recording(tmp_path / "pair.npz")[0].dt == 0.25
