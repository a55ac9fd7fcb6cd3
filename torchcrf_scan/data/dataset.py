"""Pair files as a sequence of pairs, and their split into training and test by recording."""

from __future__ import annotations

import glob
import math
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import overload

import numpy as np

from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.ros2_bag import is_folder_bag
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import ScanPair


class PairFiles(Sequence[ScanPair]):
    """The pair files that match any of the patterns, sorted by path, each read on first access and then cached.

    Args:
        patterns: files, folders (all their `*.npz`) or glob patterns (`**` for any depth); a file found twice counts once.

    Attributes:
        paths: the files.

    Raises:
        TorchCRFScanError: no pattern, or one without matches; indexing also raises the errors of `read_pair`.
    """

    def __init__(self, *patterns: str | Path) -> None:
        if not patterns:
            raise TorchCRFScanError("patterns: expected at least one file, folder or glob pattern, got none")
        self.paths: list[Path] = sorted({path for pattern in patterns for path in _matches(pattern)})
        self._read: dict[int, ScanPair] = {}

    def __len__(self) -> int:
        return len(self.paths)

    @overload
    def __getitem__(self, index: int) -> ScanPair: ...
    @overload
    def __getitem__(self, index: slice) -> list[ScanPair]: ...
    def __getitem__(self, index: int | slice) -> ScanPair | list[ScanPair]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        position = range(len(self))[index]
        if position not in self._read:
            self._read[position] = read_pair(self.paths[position])
        return self._read[position]

    def __repr__(self) -> str:
        return f"PairFiles({len(self)} files, {self.paths[0]} to {self.paths[-1]})"


def _matches(pattern: str | Path) -> list[Path]:
    path = Path(os.path.expanduser(pattern))
    if path.is_file() or is_folder_bag(path):
        return [path]
    found = list(path.glob("*.npz")) if path.is_dir() else [Path(name) for name in glob.glob(str(path), recursive=True)]
    files = [file for file in found if file.is_file()]
    if not files:
        raise TorchCRFScanError(_missing(pattern, path))
    return files


def _missing(pattern: str | Path, path: Path) -> str:
    """Why a pattern has no files."""
    if path.is_dir():
        return f"{pattern}: expected pair files (.npz) in this folder, got none"
    is_glob = glob.has_magic(str(pattern))
    return f"{pattern}: expected a pattern that matches files, got none" if is_glob else f"{pattern}: no such file or folder"


def split_by_sequence(pairs: Sequence[ScanPair], held_out: int | float, seed: int = 0) -> tuple[list[ScanPair], list[ScanPair]]:
    """Splits pairs into training and test so that no recording is in both (its pairs overlap in time).

    Args:
        pairs: pairs; those without a `sequence` count as one recording.
        held_out: number of recordings to test on (int), or minimum share of the pairs in (0, 1) in the randomly drawn test
            recordings (float), as long as one recording is left to train on.
        seed: of the draw of recordings.

    Returns:
        (train, test), each in the order of `pairs`, neither empty.

    Raises:
        TorchCRFScanError: fewer than two recordings, or a number or share that leaves one side empty.
    """
    sizes = Counter(pair.sequence for pair in pairs)
    if len(sizes) < 2:
        raise TorchCRFScanError(f"pairs: expected at least 2 sequences to split, got {len(sizes)}: {sorted(sizes)}")
    names = sorted(sizes)
    order = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    test_names = set(order[: _held_out_count([sizes[name] for name in order], held_out)])
    train = [pair for pair in pairs if pair.sequence not in test_names]
    test = [pair for pair in pairs if pair.sequence in test_names]
    return train, test


def _held_out_count(sizes: list[int], held_out: int | float) -> int:
    """Number of recordings, in this order, that are held out; always between 1 and all but one."""
    if isinstance(held_out, int | np.integer) and not isinstance(held_out, bool):
        if not 1 <= held_out < len(sizes):
            raise TorchCRFScanError(f"held_out: expected a number of sequences in [1, {len(sizes) - 1}], got {held_out}")
        return int(held_out)
    if isinstance(held_out, bool) or not 0 < held_out < 1:
        raise TorchCRFScanError(f"held_out: expected a number of sequences or a share in (0, 1), got {held_out}")
    wanted = math.ceil(held_out * sum(sizes) - 1e-9)
    return min(int(np.searchsorted(np.cumsum(sizes), wanted)) + 1, len(sizes) - 1)
