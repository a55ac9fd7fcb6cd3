"""What several commands make of their arguments: files, the batches that they are matched in, folders, a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError

from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.model import JointScanCRF

Item = TypeVar("Item")

BATCH = 4  # pairs that are matched at once: more are hardly faster, but the progress bar moves less often


def load_model(name: str, candidates: int | None = None, device: str = "cpu", threads: int | None = None) -> JointScanCRF:
    """A saved model, ready on a device; a damaged one, a device that is not there or no threads raise ValueError."""
    if threads is not None:
        if threads < 1:
            raise ValueError(f"--threads: expected at least 1, got {threads}")
        torch.set_num_threads(threads)
    changes = {} if candidates is None else {"candidates": candidates}
    try:
        model = JointScanCRF.from_pretrained(name, **changes)
    except (ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        raise ValueError(f"--model {name}: {error}") from error
    try:
        return model.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device: expected one that torch can use here, got {device} ({error})") from error


def find_files(patterns: Sequence[str]) -> list[Path]:
    """The files that match, each once; two of the same name raise ValueError: predictions are named like their pairs."""
    found: dict[str, Path] = {}
    for path in PairFiles(*patterns).paths:
        first = found.setdefault(path.stem, path)
        if not first.samefile(path):
            raise ValueError(f"{path}: expected file names that differ, got the name of {first} again")
    return list(found.values())


def make_folder(option: str, folder: str | Path) -> Path:
    """The folder, made if need be; one that cannot be made raises ValueError, which names the option that asked for it."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{option}: expected a folder, got {folder}, where a file is in the way") from error
    return Path(folder)


def batches(items: Sequence[Item]) -> Iterator[Sequence[Item]]:
    """The items in their order, `BATCH` at a time."""
    for begin in range(0, len(items), BATCH):
        yield items[begin : begin + BATCH]
