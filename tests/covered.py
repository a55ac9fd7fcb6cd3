"""A reader fed with bytes that reach new lines of it (atheris): finite numbers or a `TorchCRFScanError`, and nothing else.

python tests/covered.py KIND FOLDER [options of libFuzzer]      KIND: a name of `READERS`; FOLDER: new, for files
"""

import contextlib
import logging
import resource
import sys
from collections.abc import Callable
from pathlib import Path

import atheris
import numpy as np

LOOKED_AT = ["torchcrf_scan.data", "torchcrf_scan.checks", "torchcrf_scan.scan", "torchcrf_scan.beams", "rosbags"]

with atheris.instrument_imports(include=LOOKED_AT):
    import rosbags.rosbag1
    import rosbags.rosbag2  # noqa: F401  imported when bags are read, and instrumented only here
    from mutants import assert_finite, model
    from small_files import PAIR, POSES, TRACKS, bags, carmen, csv, pair_bytes, prediction_bytes

    from torchcrf_scan import Scan, ScanPair, TorchCRFScanError
    from torchcrf_scan.data.formats import read_recording, read_scans
    from torchcrf_scan.data.pair_file import read_pair, read_prediction
    from torchcrf_scan.data.track_file import read_tracks
    from torchcrf_scan.data.trajectory_file import read_trajectory
    from torchcrf_scan.pretrained import CONFIG, find_weights, read_config

MEMORY = 4 << 30  # bytes of data of the process, of which torch has most
SECONDS = 20  # of one file
SETTINGS = find_weights("encoder") / CONFIG


def use_pair(pair: ScanPair) -> None:
    assert np.isfinite(pair.source.points).all()
    assert np.isfinite(pair.target.points).all()
    assert 0 < pair.dt < np.inf


def use_log(path: Path) -> None:
    for reading in read_scans(path):
        assert np.isfinite(reading.scan.points).all()
        assert np.isfinite(reading.stamp)
        assert reading.odometry is None or np.isfinite(reading.odometry).all()
    for pair in read_recording(path):
        use_pair(pair)


def use_trajectory(path: Path) -> None:
    assert np.isfinite(read_trajectory(path).poses).all()


def use_config(path: Path) -> None:
    read_config(path.parent, {}, {})


def use_numbers(path: Path) -> None:
    """The numbers of two scans and of how they are taken, matched."""
    values = np.fromfile(path)
    (dt, angle_min, angle_increment, range_max, range_noise), ranges = np.append(values[:5], np.zeros(5))[:5].tolist(), values[5:]
    geometry = {"angle_min": angle_min, "angle_increment": angle_increment, "range_max": range_max, "range_noise": range_noise}
    scans = [Scan.from_ranges(part, **geometry) for part in np.array_split(ranges, 2)]
    assert_finite(model().match(*scans, dt))


def numbers() -> bytes:
    scans = [scan.to_beams(scan.ranges, np.nan) for scan in (PAIR.source, PAIR.target)]
    return np.concatenate([[PAIR.dt, -1.5, 0.05, 80.0, 0.01], *scans]).tobytes()


READERS: dict[str, tuple[str, Callable[[Path], list[bytes]], Callable[[Path], object]]] = {  # file, what it begins with, its use
    "pair": ("pair.npz", lambda folder: [pair_bytes(folder)], lambda path: use_pair(read_pair(path))),
    "prediction": ("pair.npz", lambda folder: [prediction_bytes()], read_prediction),
    "carmen": ("a.log", lambda folder: [carmen()], use_log),
    "csv": ("a.csv", lambda folder: [csv()], use_log),
    "ros1": ("a.bag", lambda folder: bags_of(folder, ".bag"), use_log),
    "ros2": ("a.db3", lambda folder: bags_of(folder, ".db3"), use_log),
    "mcap": ("a.mcap", lambda folder: bags_of(folder, ".mcap"), use_log),
    "poses": ("poses.tum", lambda folder: [POSES], use_trajectory),
    "tracks": ("tracks.csv", lambda folder: [TRACKS], read_tracks),
    "numbers": ("scans.bin", lambda folder: [numbers()], use_numbers),
    "config": (CONFIG, lambda folder: [SETTINGS.read_bytes()], use_config),
}


def bags_of(folder: Path, suffix: str) -> list[bytes]:
    return [data for name, data in bags(folder) if name.endswith(suffix)]


def main(kind: str, folder: Path, options: list[str]) -> None:
    logging.disable()
    name, begin, use = READERS[kind]
    corpus, made, files = (folder / part for part in ("corpus", "made", "files"))
    for part in (corpus, made, files):
        part.mkdir(parents=True)
    for k, data in enumerate(begin(made)):
        (corpus / str(k)).write_bytes(data)
    path = files / name

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        with contextlib.suppress(TorchCRFScanError):
            use(path)
        assert [*files.iterdir()] == [path], "a file elsewhere"

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    atheris.Setup([sys.argv[0], f"-artifact_prefix={folder}/", f"-timeout={SECONDS}", *options, str(corpus)], attempt)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
