"""Bags of ROS 1 and ROS 2 and MCAP files, written by rosbags and read back, whole and cut."""

import sqlite3
import struct
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")

from bags import BEAMS, CLOUD, FORMATS, LASER, ODOMETRY, STORES, TRANSFORMS, cloud, drive, header, laser, made, room, wheels, write

from torchcrf_scan import TorchCRFScanError
from torchcrf_scan.data import bag_records, mcap_bag
from torchcrf_scan.data.formats import read_recording, read_scans
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.reading import Reading

LOGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs"


@pytest.mark.parametrize("form", FORMATS)
def test_scans_come_back_with_the_stamps_of_their_headers(tmp_path: Path, form: str) -> None:
    readings = list(read_scans(write(tmp_path, form, drive(300))))
    np.testing.assert_allclose([reading.stamp for reading in readings], 100 + 0.1 * np.arange(300), atol=1e-6)
    scan = readings[3].scan
    assert (scan.n_beams, scan.beam[0], scan.range_max) == (BEAMS, 1, pytest.approx(30.0))
    np.testing.assert_allclose(scan.ranges, room(0.3)[1:], rtol=1e-6)
    np.testing.assert_allclose(scan.bearings, np.linspace(-np.pi / 2, np.pi / 2, BEAMS)[1:], atol=1e-5)
    np.testing.assert_allclose(scan.times, 1e-4 * np.arange(1, BEAMS), rtol=1e-5)
    assert readings[0].odometry is None


@pytest.mark.parametrize("form", ["ros1", "mcap"])
def test_a_bag_makes_pairs(tmp_path: Path, form: str) -> None:
    log = read_recording(write(tmp_path, form, [*drive(5), *wheels(5)]), ReadOptions(odometry="/odom"))
    assert len(log) == 4
    assert log[1].dt == pytest.approx(0.1)
    np.testing.assert_allclose(log[1].initial_motion, [0, -0.1, 0], atol=1e-9)


def test_mcap_may_hold_messages_of_ros_1(tmp_path: Path) -> None:
    store, told = STORES[1], laser(2.5, room(0.0))
    data = bytes(store.serialize_ros1(made(store, LASER, told), LASER))

    def record(kind: int, content: bytes) -> bytes:
        return bytes([kind]) + struct.pack("<Q", len(content)) + content

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    schema = struct.pack("<H", 1) + text("sensor_msgs/LaserScan") + text("ros1msg") + text("")
    channel = struct.pack("<HH", 7, 1) + text("/scan") + text("ros1") + text("")
    message = struct.pack("<HIQQ", 7, 0, 10**9, 10**9) + data
    parts = [record(1, text("ros1") + text("")), record(3, schema), record(4, channel), record(5, message), record(15, bytes(4))]
    (tmp_path / "run.mcap").write_bytes(mcap_bag.MAGIC + b"".join(parts))
    (reading,) = read_scans(tmp_path / "run.mcap")
    assert reading.stamp == 2.5
    np.testing.assert_allclose(reading.scan.ranges, room(0.0)[1:], rtol=1e-6)


# --- topics -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["ros1", "sqlite", "mcap file"])
def test_topics_are_chosen_or_listed(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, [*drive(2, "/front"), *drive(3, "/rear"), *wheels(1)])
    assert len(list(read_scans(path, "/front"))) == 2
    assert len(list(read_scans(path, "rear"))) == 3
    both = r"/front \(sensor_msgs/LaserScan\), /rear \(sensor_msgs/LaserScan\)"
    with pytest.raises(ValueError, match=rf"topic: expected which of {both}, got none"):
        next(read_scans(path))
    with pytest.raises(ValueError, match=rf"topic: expected one of {both}, got /odom"):
        next(read_scans(path, "/odom"))
    with pytest.raises(ValueError, match=r"odometry: expected one of /odom \(nav_msgs/Odometry\), got /wheels"):
        next(read_scans(path, "/front", odometry="/wheels"))


def test_a_bag_without_scans_tells_what_it_has(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", wheels(1))
    expected = r"sensor_msgs/LaserScan or sensor_msgs/PointCloud2, got /odom \(nav_msgs/Odometry\)"
    with pytest.raises(ValueError, match=rf"run\.bag: topic: expected a topic of type {expected}"):
        next(read_scans(path))


@pytest.mark.parametrize("name", ["/odom", "auto"])
def test_odometry_that_is_not_there_is_told(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, "ros1", drive(2))
    expected = r"expected a topic of type nav_msgs/Odometry, got /scan \(sensor_msgs/LaserScan\)$"
    with pytest.raises(ValueError, match=rf"run\.bag: odometry: {expected}"):
        next(read_scans(path, odometry=name))


# --- messages -----------------------------------------------------------------------------------------------------------------


def read_one(folder: Path, kind: str, fields: dict[str, Any], **options: Any) -> Reading:
    (reading,) = read_scans(write(folder, "ros1", [("/one", kind, 7.5, fields)]), **options)
    return reading


def test_what_drivers_leave_out_is_unknown(tmp_path: Path) -> None:
    nothing = {"range_min": np.nan, "range_max": 0.0, "angle_increment": 0.0, "time_increment": 0.0, "header": header(0.0)}
    reading = read_one(tmp_path, LASER, laser(1.0, room(0.0), **nothing))
    assert reading.stamp == pytest.approx(7.5)  # that of the recording
    assert (reading.scan.range_max, reading.scan.times) == (None, None)
    np.testing.assert_allclose(reading.scan.bearings, np.linspace(-np.pi / 2, np.pi / 2, BEAMS)[1:], atol=1e-5)


def test_a_clockwise_sensor(tmp_path: Path) -> None:
    step = np.pi / (BEAMS - 1)
    scan = read_one(tmp_path, LASER, laser(1.0, room(0.0)[::-1], angle_min=np.pi / 2, angle_increment=-step)).scan
    assert scan.beam[0] == BEAMS - 2
    np.testing.assert_allclose(scan.ranges, room(0.0)[1:], rtol=1e-6)


def test_readings_that_mean_nothing_are_told_by_an_option(tmp_path: Path) -> None:
    assert read_one(tmp_path, LASER, laser(1.0, room(0.0)), no_return=5.0).scan.ranges.max() < 5.0


@pytest.mark.parametrize("height", [1, 2])
def test_a_planar_cloud_is_a_scan(tmp_path: Path, height: int) -> None:
    points = np.array([[1, 1, 0.3, 0.0], [np.nan, 0, 0.3, 0.01], [-2, 0, 0.31, 0.02], [0, -3, 0.29, 0.03]])
    reading = read_one(tmp_path, CLOUD, cloud(3.0, points, ("x", "y", "z", "time"), height))
    assert (reading.stamp, reading.scan.n_beams) == (3.0, 4)
    assert reading.scan.beam.tolist() == [3, 0, 2]
    np.testing.assert_allclose(reading.scan.points, points[[3, 0, 2], :2], atol=1e-6)
    np.testing.assert_allclose(reading.scan.times, [0.03, 0.0, 0.02], atol=1e-6)


def test_a_cloud_that_is_not_planar_is_refused(tmp_path: Path) -> None:
    points = np.array([[1, 1, 0], [1, 0, 1], [0, 1, 2.0]])
    with pytest.raises(ValueError, match=r"/one: expected a planar cloud, got heights from 0\.00 to 2\.00 m"):
        read_one(tmp_path, CLOUD, cloud(3.0, points))
    with pytest.raises(ValueError, match=r"/one: expected a cloud with x and y, got a, b"):
        read_one(tmp_path / "other", CLOUD, cloud(3.0, points[:, :2], ("a", "b")))


# --- odometry -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["ros1", "sqlite"])
def test_odometry_is_that_of_the_sensor_at_the_time_of_the_scan(tmp_path: Path, form: str) -> None:
    mount = {"translation": {"x": 0.5, "y": 0.2}, "rotation": {"z": np.sin(0.1), "w": np.cos(0.1)}}
    middle = {"translation": {"x": 1.0}, "rotation": {"w": 1.0}}
    chain = [{"header": header(0, "mast"), "child_frame_id": "laser", "transform": mount},
             {"header": header(0, "base"), "child_frame_id": "mast", "transform": middle}]  # fmt: skip
    messages = [("/tf_static", TRANSFORMS, 99.0, {"transforms": chain}), *drive(4, begin=100.02), *wheels(5)]
    readings = list(read_scans(write(tmp_path, form, messages), odometry="auto"))
    for k, reading in enumerate(readings):
        np.testing.assert_allclose(reading.odometry, [0.2, 1.5 + 0.02 + 0.1 * k, 0.2], atol=1e-6)


def test_scans_far_from_odometry_have_none(tmp_path: Path) -> None:
    readings = list(read_scans(write(tmp_path, "ros1", [*drive(60), *wheels(2, begin=101.0)]), odometry="/odom"))
    known = [reading.odometry is not None for reading in readings]
    assert len(readings) == 60
    assert [k for k, is_known in enumerate(known) if is_known] == list(range(8, 14))


def test_odometry_that_never_changes_says_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", [*drive(5), *wheels(5, speed=0.0)])
    assert all(pair.initial_motion is None for pair in read_recording(path, ReadOptions(odometry="auto")))


def test_two_topics_of_odometry_are_listed(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", [*drive(2), *wheels(2), *(("/other", *rest) for _, *rest in wheels(2))])
    with pytest.raises(ValueError, match=r"odometry: expected which of /odom .*, /other \(nav_msgs/Odometry\), got none"):
        next(read_scans(path, odometry="auto"))
    assert ODOMETRY == "nav_msgs/msg/Odometry"


# --- faults -------------------------------------------------------------------------------------------------------------------


def read_until_fault(path: Path) -> tuple[list[Reading], str]:
    found: list[Reading] = []
    with pytest.raises(ValueError, match=r".") as fault:
        found.extend(read_scans(path))
    return found, str(fault.value)


@pytest.mark.parametrize("form", ["ros1", "ros1 bz2", "mcap file"])
def test_a_cut_bag_gives_every_whole_chunk(tmp_path: Path, form: str) -> None:
    """A chunk of rosbags holds a megabyte, about 1000 of these scans."""
    path = write(tmp_path, form, drive(4000))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 6 // 10])
    found, fault = read_until_fault(path)
    assert 1000 < len(found) < 3000
    np.testing.assert_allclose(np.diff([reading.stamp for reading in found]), 0.1, atol=1e-5)
    assert f"{path}, byte " in fault


@pytest.mark.parametrize("form", ["ros1 lz4", "mcap file"])
def test_a_damaged_bag_gives_every_scan_before_the_fault(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, drive(4000))
    data = bytearray(path.read_bytes())
    middle = len(data) * 6 // 10
    data[middle : middle + 4000] = bytes([255]) * 4000
    path.write_bytes(data)
    found, fault = read_until_fault(path)
    assert len(found) > 500
    assert f"{path}, " in fault


def test_a_damaged_database_gives_every_scan_before_the_fault(tmp_path: Path) -> None:
    path = write(tmp_path, "sqlite file", drive(2000))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    path.write_bytes(data)
    found, fault = read_until_fault(path)
    assert 500 < len(found) < 1900
    assert "row" in fault
    path.write_bytes(bytes(data[:2000]))
    assert "expected a database with topics" in read_until_fault(path)[1]


def test_a_message_that_is_cut_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, "sqlite file", drive(5))
    with sqlite3.connect(path) as base:
        base.execute("UPDATE messages SET data = substr(data, 1, 40) WHERE id = 4")
    base.close()
    found, fault = read_until_fault(path)
    assert len(found) == 3
    assert f"{path}, row 4: expected a {LASER}, got" in fault


@pytest.mark.parametrize("form", ["packed messages", "packed messages mcap"])
@pytest.mark.parametrize("odometry", [None, "auto"])
def test_a_damaged_packed_message_is_one_bad_scan(tmp_path: Path, form: str, odometry: str | None) -> None:
    path, told = write(tmp_path, form, [*drive(9), *(wheels(9) if odometry else [])]), list[ValueError]()
    (part,) = (file for file in path.iterdir() if file.suffix != ".yaml")
    data, start = part.read_bytes(), b"\x28\xb5\x2f\xfd"
    assert data.count(start) >= 9
    at = [k for k in range(len(data)) if data.startswith(start, k)]
    large = [k for k, after in zip(at, [*at[1:], len(data)], strict=True) if after - k > 500]
    part.write_bytes(data[: large[4]] + bytes(16) + data[large[4] + 16 :])
    readings = list(read_scans(path, odometry=odometry, on_bad=told.append))
    assert len(readings) == 8
    (error,) = told
    assert f"{part}, r" in str(error)
    assert "expected data that can be unpacked" in str(error)
    with pytest.raises(ValueError, match="expected data that can be unpacked"):
        list(read_scans(path, odometry=odometry))


def test_folders_with_wrong_metadata(tmp_path: Path) -> None:
    path = write(tmp_path, "sqlite", drive(2))
    next(file for file in path.iterdir() if file.suffix == ".db3").rename(path / "other.db3")
    with pytest.raises(ValueError, match=r"expected the file that metadata\.yaml lists"):
        next(read_scans(path))
    (path / "metadata.yaml").unlink()
    assert len(list(read_scans(path))) == 2  # a recorder that was killed leaves none
    laughs = ["a0: &a0 [1, 1, 1, 1]", *(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}, *a{k - 1}]" for k in range(1, 20))]
    for text in ("[", "a: b", "", "\0", "\n".join(laughs)):
        (path / "metadata.yaml").write_text(text)
        with pytest.raises(ValueError, match=r"metadata\.yaml: expected a list of files, got"):
            next(read_scans(path))


def test_a_database_that_computes_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "sqlite file", drive(2))
    with closing(sqlite3.connect(path)) as base:
        base.execute("ALTER TABLE messages RENAME TO other")
        endless = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT k AS id, 1 AS topic_id FROM n"
        base.execute(f"CREATE VIEW messages AS {endless}")
    with pytest.raises(ValueError, match=r"expected a database with topics, got the view or trigger 'messages'"):
        list(read_scans(path))


def test_a_database_of_other_types_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "sqlite file", drive(2))
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE messages SET timestamp = 'text', data = 'text'")
        base.commit()
    with pytest.raises(ValueError, match=f"row 1: expected a {LASER}, got"):
        list(read_scans(path))


@pytest.mark.parametrize("form", ["ros1 bz2", "mcap file"])
def test_chunks_beyond_the_limit_are_not_read(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, form, drive(50))
    monkeypatch.setattr(bag_records, "MOST_CHUNK", 1000)
    assert "expected at most 1000 bytes" in read_until_fault(path)[1]


@pytest.mark.parametrize("length", [100, 1 << 40, (1 << 64) - 1])
def test_a_chunk_that_promises_more_than_there_is_of_mcap(tmp_path: Path, length: int) -> None:
    chunk = bytes(28) + struct.pack("<IQ", 0, length) + bytes(50)
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap_bag.MAGIC + struct.pack("<BQ", mcap_bag.CHUNK, len(chunk)) + chunk)
    with pytest.raises(TorchCRFScanError, match=r"run\.mcap, byte \d+: expected a whole record of MCAP, got "):
        list(read_scans(path))


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_chunk_that_is_larger_than_it_says_is_refused(compression: str) -> None:
    pack = {"bz2": __import__("bz2").compress, "lz4": __import__("lz4.frame").frame.compress}
    packed = pack[compression](bytes(1 << 22)) if compression in pack else zstd_of(bytes(1 << 22))
    assert bag_records.unpack(packed, compression, 1 << 22) == bytes(1 << 22)
    with pytest.raises(ValueError, match="expected a chunk of 1000 bytes, got more"):
        bag_records.unpack(packed, compression, 1000)
    with pytest.raises(ValueError, match="expected chunks of at most 268435456 bytes, got one of 268435457"):
        bag_records.unpack(packed, compression, (1 << 28) + 1)
    with pytest.raises(ValueError, match="expected a chunk of 5000000 bytes, got 4194304"):
        bag_records.unpack(packed, compression, 5_000_000)
    with pytest.raises(ValueError, match="expected data that can be unpacked"):
        bag_records.unpack(b"nothing of the kind", compression, 1000)
    with pytest.raises(ValueError, match="expected compression by bz2, lz4, zstd or none, got 'zip'"):
        bag_records.unpack(packed, "zip", 1000)


@pytest.mark.parametrize(("form", "library"), [("ros1 lz4", "lz4"), ("packed messages", "backports"), ("mcap", "rosbags")])
def test_a_library_that_is_missing_is_named(tmp_path: Path, form: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, form, drive(2))
    for name in [name for name in sys.modules if name.split(".")[0] in (library, "compression")]:
        monkeypatch.delitem(sys.modules, name)
    for name in (library, "compression"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=rf"expected the library {library}.* \(extra `ros`\), got"):
        list(read_scans(path))


def zstd_of(data: bytes) -> bytes:
    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    return zstd.compress(data)


def test_a_bag_without_index_is_read_by_its_records(tmp_path: Path) -> None:
    """What a recorder that was killed leaves: index_pos is 0."""
    path = write(tmp_path, "ros1", drive(3))
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = struct.pack("<Q", 0)
    path.write_bytes(data)
    assert len(list(read_scans(path))) == 3


@pytest.mark.skipif(not LOGS.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize(
    ("name", "scans", "beams"), [("datmo_overtakes", 339, 360), ("hbrs_people_1", 400, 768), ("leg_tracker_stationary", 1265, 512)]
)
def test_real_bags(name: str, scans: int, beams: int) -> None:
    readings = list(read_scans(LOGS / f"{name}.bag"))
    assert (len(readings), readings[0].scan.n_beams) == (scans, beams)
    assert all(reading.scan.times is not None for reading in readings)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("odometry", [None, "auto"])
def test_malformed_messages_are_left_out_on_request(tmp_path: Path, form: str, odometry: str | None) -> None:
    malformed = (
        {"angle_increment": np.nan},
        {"angle_increment": 0.0, "angle_max": -np.pi / 2},
        {"angle_increment": 1.0},
        {"angle_min": 1e9},
    )
    bad = [("/scan", LASER, 100.21 + 0.01 * k, laser(100.21, room(0.2), **fields)) for k, fields in enumerate(malformed)]
    path, told = write(tmp_path, form, [*drive(5), *bad, *wheels(5)]), list[ValueError]()
    readings = list(read_scans(path, odometry=odometry, on_bad=told.append))
    np.testing.assert_allclose([reading.stamp for reading in readings], 100 + 0.1 * np.arange(5))
    assert len(told) == len(malformed)
    assert all("/scan: " in str(error) and str(error).startswith(str(path)) for error in told)
    with pytest.raises(ValueError, match="/scan: "):
        list(read_scans(path, odometry=odometry))


def test_a_cut_bag_ends_the_reading_though_bad_messages_do_not(tmp_path: Path) -> None:
    path, told = write(tmp_path, "ros1", drive(300)), list[ValueError]()
    path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(ValueError, match="byte"):
        list(read_scans(path, on_bad=told.append))
    assert told == []
