"""Files with something wrong in them, and what is made of them: an answer of finite numbers, or a `TorchCRFScanError`.

python tests/mutants.py RECORDINGS FOLDER SEED SECONDS      mutates pairs and logs of a folder; prints counts
"""

import contextlib
import faulthandler
import gzip
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import islice
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jsonargparse import ArgumentError
from small_files import POSES, TRACKS, prediction_bytes

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair, ScanStream, TorchCRFScanError
from torchcrf_scan.cli import main
from torchcrf_scan.data.formats import read_recording, read_scans
from torchcrf_scan.data.pair_file import read_pair, read_prediction
from torchcrf_scan.data.track_file import read_tracks
from torchcrf_scan.data.trajectory_file import read_trajectory
from torchcrf_scan.experiment.parser import config_of, settings_parser
from torchcrf_scan.pretrained import CONFIG, WEIGHTS, find_weights

SECONDS, MEMORY = 20, 1 << 30  # of processor time and bytes, limits of one file
READINGS = 4  # of a log that are matched
WORDS = ("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", "99999999999999999999", "", "x", "null", "[]", "3.7", "true")
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")
BYTES = (b"\0", b"\xff", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0" * 8, b"\xff" * 8, b"\n", b" ", b"&a [*a]")

Use = Callable[[Path], None]


def mutated(data: bytes, random: Random) -> bytes:
    """The bytes with one to four things changed."""
    for _ in range(random.choice((1, 1, 2, 4))):
        data = random.choice((_flipped, _written, _cut, _doubled, _ended, _renumbered, _renumbered))(data, random)
    return data


def _flipped(data: bytes, random: Random) -> bytes:
    at = random.randrange(len(data) or 1)
    return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)] if data else []) + data[at + 1 :]


def _written(data: bytes, random: Random) -> bytes:
    at, piece = random.randrange(len(data) + 1), random.choice(BYTES)
    return data[:at] + piece + data[at + random.choice((0, len(piece))) :]


def _cut(data: bytes, random: Random) -> bytes:
    at = random.randrange(len(data) + 1)
    return data[:at] + data[at + random.choice((1, 8, 100, 5000)) :]


def _doubled(data: bytes, random: Random) -> bytes:
    at, length = random.randrange(len(data) + 1), random.choice((1, 8, 100, 5000))
    return data[: at + length] + data[at:]


def _ended(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _renumbered(data: bytes, random: Random) -> bytes:
    """Another word in the place of a number, near a random place."""
    found = NUMBER.search(data, random.randrange(len(data) + 1))
    return data if found is None else data[: found.start()] + random.choice(WORDS).encode() + data[found.end() :]


def mutated_archive(data: bytes, random: Random) -> bytes:
    """An archive with one member changed, its checksums right: what gets past the checks of the format."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = random.choice(sorted(members))
    kind = random.randrange(4)
    if kind == 0:
        members[name] = mutated(members[name], random)
    elif kind == 1:
        del members[name]
    else:
        members[name] = _other_array(np.load(io.BytesIO(members[name])), random)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def _other_array(array: np.ndarray, random: Random) -> bytes:
    """The array with an entry, its type or its shape changed, as a file."""
    array = np.array(array)
    kind = random.randrange(4)
    if kind < 2 and array.size and array.dtype.kind in "fiu":
        with np.errstate(all="ignore"), contextlib.suppress(OverflowError, ValueError):
            array.flat[random.randrange(array.size)] = random.choice(
                (np.nan, np.inf, -1, 0, 1e308, 1e7, -1e-320, 2**31, array.size)
            )
    elif kind == 2:
        with np.errstate(all="ignore"), contextlib.suppress(ValueError):
            array = array.astype(random.choice(("f2", "f4", ">f8", "i1", "u8", "c16", "U3", "S4", "b1", "M8[s]")))
    else:
        array = random.choice((array[None], array[:0] if array.ndim else array, array.repeat(3) if array.ndim else array[None]))
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def unpacked_first(mutate: Callable[[bytes, Random], bytes]) -> Callable[[bytes, Random], bytes]:
    """The mutation of what a gzipped file holds, also a cut one, packed again."""
    return lambda data, random: gzip.compress(mutate(zlib.decompressobj(31).decompress(data), random), 1)


# --- uses: each raises TorchCRFScanError for a file that it refuses, and nothing else ------------------------------------------


@cache
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


def assert_finite(answer: PairPrediction) -> None:
    for name in ("motions", "covariances", "association_confidence", "cluster_confidence", "unobserved_shift"):
        assert np.isfinite(getattr(answer, name)).all(), name


def use_pair(path: Path) -> None:
    pair = read_pair(path)
    (answer,) = model().match_pairs([pair])
    assert_finite(answer)


def use_log(path: Path) -> None:
    stream = ScanStream(model())
    for reading in islice(read_scans(path, odometry=None), READINGS):
        result = stream.feed(reading.scan, reading.stamp, reading.odometry)
        assert np.isfinite(result.pose).all()
        assert np.isfinite(result.covariance).all()
    pairs: list[ScanPair] = list(islice(iter(read_recording(path)), READINGS))
    for answer in model().match_pairs(pairs):
        assert_finite(answer)


def use_model(path: Path, name: str, pair: ScanPair) -> None:
    """A saved model of which one file is changed."""
    with TemporaryDirectory(dir=path.parent) as folder:
        for part in (CONFIG, WEIGHTS):
            shutil.copy(find_weights("encoder") / part, folder)
        shutil.copy(path, Path(folder) / name)
        assert_finite(JointScanCRF.from_pretrained(folder).match(pair.source, pair.target))


def use_settings(path: Path) -> None:
    parser = settings_parser(exit_on_error=False)
    try:
        config_of(parser.instantiate(parser.parse_args([f"--config={path}"])))
    except ArgumentError as error:
        raise TorchCRFScanError(str(error)) from error


def use_command(path: Path, *command: str) -> None:
    """A command, which writes within its own folder alone and ends with 0 or 1."""
    folder = path.parent
    before, out = {*folder.iterdir()}, folder / "out"
    out.mkdir(exist_ok=True)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as told:
        code = main([command[0], str(path), *(part.format(out=out) for part in command[1:])])
    assert {*folder.iterdir()} == before | {out}, "a file elsewhere"
    shutil.rmtree(out)
    assert "Traceback" not in told.getvalue()
    if code != 0:
        raise TorchCRFScanError(told.getvalue())


class Target:
    """A kind of file: the name it is given, what it is made of, how it is changed, and what is done with it."""

    def __init__(self, name: str, data: bytes, use: Use, mutate: Callable[[bytes, Random], bytes] = mutated) -> None:
        self.name, self.data, self.use, self.mutate = name, data, use, mutate

    def attempt(self, folder: Path, random: Random) -> str:
        """`answered` or `refused`; the file stays where anything else comes of it."""
        path = folder / self.name
        path.write_bytes(self.mutate(self.data, random))
        outcome = "answered"
        try:
            self.use(path)
        except TorchCRFScanError:
            outcome = "refused"
        path.unlink()
        return outcome


def pair_targets(name: str, data: bytes) -> Iterator[Target]:
    to_pair = ("match", "--output", "{out}", "--threads", "1")
    for how in (mutated_archive, mutated):
        yield Target(name, data, use_pair, how)
        yield Target(name, data, lambda path: use_command(path, *to_pair), how)


def log_targets(name: str, data: bytes) -> Iterator[Target]:
    yield Target(name, data, use_log)
    yield Target(name, data, lambda path: use_command(path, "odometry", "--output", "{out}/poses.tum", "--end", "1"))
    if data.startswith(b"\x1f\x8b"):
        yield Target(name, data, use_log, unpacked_first(mutated))


def other_targets(pair: ScanPair, configs: Path) -> Iterator[Target]:
    for name in (CONFIG, WEIGHTS):
        yield Target(name, (find_weights("encoder") / name).read_bytes(), partial(use_model, name=name, pair=pair))
    for file in sorted(configs.glob("*.yaml")):
        yield Target(file.name, file.read_bytes(), use_settings)
    yield Target("poses.tum", POSES, lambda path: assert_all(read_trajectory(path).poses))
    yield Target("tracks.csv", TRACKS, lambda path: assert_all(read_tracks(path).position))
    yield Target("prediction.npz", prediction_bytes(), lambda path: assert_all(read_prediction(path).cluster), mutated_archive)


def assert_all(values: np.ndarray) -> None:
    assert np.isfinite(values).all()


# --- for a long time, in a process of its own ----------------------------------------------------------------------------------


def recorded_targets(recordings: Path, configs: Path) -> list[Target]:
    """Of the pairs and logs of a folder; of long logs the beginning, a chunk or two of a bag."""
    pairs = sorted((recordings / "pairs").glob("*.npz"))[::10]
    found = [target for path in pairs for target in pair_targets(path.name, path.read_bytes())]
    for path in sorted((recordings / "logs").iterdir()):
        with path.open("rb") as file:
            found += log_targets(path.name, file.read(2_000_000 if path.suffix == ".bag" else 200_000))
    return [*found, *other_targets(read_pair(pairs[0]), configs)]


def limit_memory() -> None:
    """To `MEMORY` beyond what the process has."""
    status = Path("/proc/self/status").read_text()
    has = int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmData"))) << 10
    resource.setrlimit(resource.RLIMIT_DATA, (has + MEMORY, has + MEMORY))


def run(recordings: Path, folder: Path, seed: int, seconds: float) -> Counter[str]:
    """Counts by kind of file and outcome; an outcome that is neither ends the process, and leaves the file."""
    torch.set_num_threads(1)
    targets, random, counts = recorded_targets(recordings, Path(__file__).parents[1] / "configs"), Random(seed), Counter[str]()
    limit_memory()
    faulthandler.register(signal.SIGPROF, chain=True)  # of what takes too long: where it is, and the end
    end = time.process_time() + seconds
    while time.process_time() < end:
        target = random.choice(targets)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        counts[f"{Path(target.name).suffix} {target.attempt(folder, random)}"] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
    return counts


if __name__ == "__main__":
    os.environ["TORCHCRF_SCAN_PREPARE"] = "0"
    print(json.dumps(run(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))))
