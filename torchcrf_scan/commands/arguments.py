"""Handling of arguments common to several commands: files, batches, folders, the model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchcrf_scan.commands.failures import attempt
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.formats import PAIR, find_format, read_recording
from torchcrf_scan.data.options import AS_RECORDED, ReadOptions
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.recording import Recording
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.scan import ScanPair

BATCH = 16  # pairs matched at once


def load_model(
    name: str,
    candidates: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
    outlier_distance: float | None = None,
) -> JointScanCRF:
    """A saved model on a device; raises TorchCRFScanError for a damaged one, a missing device or an invalid number of threads.

    candidates, outlier_distance: of `InferenceConfig`; None: as saved.
    """
    if threads is not None:
        if threads < 1:
            raise TorchCRFScanError(f"--threads: expected at least 1, got {threads}")
        torch.set_num_threads(threads)
    changes: dict[str, Any] = {} if candidates is None else {"candidates": candidates}
    try:
        model = JointScanCRF.from_pretrained(name, **changes)
    except ValueError as error:
        raise TorchCRFScanError(f"--model {name}: {error}") from error
    try:
        model.config = model.config.with_limit(outlier_distance)
    except ValueError as error:
        raise TorchCRFScanError(f"--{error}") from error
    try:
        return model.to(device)
    except (RuntimeError, AssertionError) as error:
        raise TorchCRFScanError(f"--device: expected one that torch can use here, got {device} ({error})") from error


@dataclass(frozen=True, slots=True)
class PairPlace:
    """Location of a pair: a file of its own, or a number in a log."""

    path: Path
    log: Recording | None = None
    number: int = 0

    @property
    def name(self) -> str:
        """The name of the pair, and of its prediction file."""
        return self.path.stem if self.log is None else self.log.pair_name(self.number)

    def __str__(self) -> str:
        return str(self.path) if self.log is None else f"{self.path}, pair {self.number}"

    def read(self) -> ScanPair:
        """Reads the pair."""
        return read_pair(self.path) if self.log is None else self.log[self.number]


def find_files(patterns: Sequence[str]) -> list[Path]:
    """The matching files, each once; raises TorchCRFScanError for two of one name, as predictions are named like their pairs."""
    return [place.path for place in _each_once(PairPlace(path) for path in PairFiles(*patterns).paths)]


def annotated_pairs(patterns: Sequence[str]) -> dict[Path, ScanPair]:
    """The pairs of the matching pair files; raises TorchCRFScanError for a log, or a pair without annotation."""
    files = find_files(patterns)
    for path in files:
        form = find_format(path)
        if form is not None and form is not PAIR:
            raise TorchCRFScanError(f"{path}: expected an annotated pair file (.npz), got a {form.name}, which has no annotation")
    pairs = {path: read_pair(path) for path in files}
    for path, pair in pairs.items():
        if pair.annotation is None:
            raise TorchCRFScanError(f"{path}: expected an annotated pair (keys association and cluster), got one without")
    return pairs


def find_pairs(patterns: Sequence[str], every: int, failures: list[str], options: ReadOptions = AS_RECORDED) -> list[PairPlace]:
    """The pairs of the matching files, each once, of logs every N-th; raises TorchCRFScanError for two of the same name.

    A log that cannot be read contributes none, one that is damaged those before the fault; the reason is added to `failures`.
    """
    paths = PairFiles(*patterns).paths
    if every < 1:
        raise TorchCRFScanError(f"--every: expected at least 1, got {every}")
    pair_files = {path for path in paths if attempt([], find_format, path) is PAIR}
    if len(pair_files) == len(paths) and (every > 1 or replace(options, on_bad=None) != AS_RECORDED):
        every_nth = f"--every: expected a log to take every {every}-th pair of"
        told = every_nth if every > 1 else "--topic, --odometry, --no_return: expected a log to read with them"
        raise TorchCRFScanError(f"{told}, got pair files alone")
    found = []
    for path in paths:
        if path in pair_files:
            found.append(PairPlace(path))
        elif (log := attempt(failures, read_recording, path, options)) is not None:
            found += [PairPlace(path, log, number) for number in range(0, len(log), every)]
            failures += [] if log.fault is None else [one_line(log.fault)]
    return _each_once(found)


def read_one(file: str, number: int | None, options: ReadOptions = AS_RECORDED) -> ScanPair:
    """The pair of a pair file (number None), or one of the pairs of a log."""
    if find_format(file) is PAIR:
        if number is not None:
            raise TorchCRFScanError(f"--number: expected none but with a log, got {number} with {file}")
        PAIR.check(file, options)
        return read_pair(file)
    log = read_recording(file, options)
    if number is None or not 0 <= number < len(log):
        raise TorchCRFScanError(f"--number: expected which pair of {file}, 0 to {len(log) - 1}, got {number}")
    return log[number]


def _each_once(places: Iterable[PairPlace]) -> list[PairPlace]:
    found: dict[str, PairPlace] = {}
    for place in places:
        first = found.setdefault(place.name, place)
        if first is not place and not first.path.samefile(place.path):
            raise TorchCRFScanError(f"{place}: expected pair names that differ, got the name of {first} again")
    return list(found.values())


def listed(values: tuple[str, ...] | str) -> tuple[str, ...]:
    """The values of an option that takes a list, or one value without brackets."""
    return (values,) if isinstance(values, str) else values


def check_output(output: str, log: str) -> None:
    """Raises TorchCRFScanError for an output that is a folder, or would replace the log that it is made of."""
    path = Path(output)
    if path.exists() and not path.is_file():
        raise TorchCRFScanError(
            f"--output: expected a file to write, got {output!r}, {'a folder' if path.is_dir() else 'a device or pipe'}"
        )
    check_other("--output", output, log)


def check_other(option: str, output: str | Path, log: str | Path) -> None:
    """Raises TorchCRFScanError for an output, as an option tells it, that would replace the log that it is made of."""
    path = Path(output)
    if path.exists() and Path(log).exists() and path.samefile(log):
        raise TorchCRFScanError(f"{option}: expected another file than the log, got {output}")
