"""Builds the machine code that is missing: one extension module a part, by as many processes as there are cores.

layouts of example pairs -> an object file a part, at once -> linked, written beside, renamed -> used by whoever looks for it
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from torchcrf_scan.loops import machine
from torchcrf_scan.loops.background import PROGRESS_FILE, lacks_compiler
from torchcrf_scan.loops.layout import Layout
from torchcrf_scan.prepare import extension
from torchcrf_scan.prepare.record import record_layouts
from torchcrf_scan.whole_file import alone, whole_path, write_whole

LOCK_FILE = "lock"
Progress = Callable[[int, int], None]


class NoCompilerError(OSError):
    """There is no C compiler, which is needed to link the extension modules."""


def build_missing(levels: Sequence[str], progress: Progress, *, wait: bool = True) -> Path:
    """Builds the missing machine code, and removes outdated files.

    Args:
        levels: of processors, see `machine.processor_level`.
        progress: called with the number of built parts and of all parts.
        wait: wait for another process that builds; else leave the build to it.

    Returns:
        The folder of the machine code.

    Raises:
        OSError: nowhere to write, or no C compiler.
    """
    folder = machine.writable_folder()
    with alone(folder / LOCK_FILE, wait=wait) as is_alone:
        missing = {level: parts for level in levels if (parts := machine.missing(level))} if is_alone else {}
        if missing and lacks_compiler():
            raise NoCompilerError("expected a C compiler (gcc or clang) to build machine code with, got none; slow loops go on")
        count, done = sum(map(len, missing.values())), 0
        for level, parts in missing.items():
            for _ in _build_level(level, parts, folder):
                done += 1
                progress(done, count)
    return folder


def _build_level(level: str, parts: Sequence[str], folder: Path) -> Iterator[str]:
    """Builds parts for one level, and yields each when it is there."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = min(cores, len(parts))
    with (
        TemporaryDirectory(prefix="torchcrf_scan-") as scratch,
        ProcessPoolExecutor(workers, get_context("spawn"), extension.choose_processor, (level,)) as pool,
    ):
        common = pool.submit(extension.compile_common, level, Path(scratch))
        layouts = record_layouts()
        waiting: dict[Future[tuple[list[str], list[str]]], str] = {}
        for part in sorted(parts, key=list(machine.PARTS).index):
            own = {name: of for name, of in layouts.items() if machine.part_of(name) == part}
            waiting[pool.submit(extension.compile_objects, part, level, own, Path(scratch))] = part
        for future in as_completed(waiting):
            part = waiting[future]
            objects, exports = future.result()
            path = machine.library(folder, part, level)
            with whole_path(path) as beside:
                extension.link([*objects, *common.result()], exports, level, beside)
            _list_entries(path, {name: of for name, of in layouts.items() if machine.part_of(name) == part})
            _remove_older(path, part, level)
            yield part


def _list_entries(path: Path, layouts: dict[str, list[Layout]]) -> None:
    """Writes the list of a whole extension's entries, without which it is not loaded."""
    told = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "entries": layouts}
    write_whole(path.with_suffix(".json"), json.dumps(told))


def _remove_older(path: Path, part: str, level: str) -> None:
    """Removes files that this copy of the package built from older sources, with the same Python for the same level."""
    suffixes = path.name.removeprefix(machine.stem(part, level))
    for suffix in (suffixes, str(Path(suffixes).with_suffix(".json"))):
        for old in path.parent.glob(f"{part}-*-{level}{suffix}*"):
            if not old.name.startswith(machine.stem(part, level)):
                old.unlink(missing_ok=True)


def write_progress(done: int, count: int) -> None:
    """For the processes that look for machine code meanwhile."""
    (machine.writable_folder() / PROGRESS_FILE).write_text(f"{done} of {count} parts built")
