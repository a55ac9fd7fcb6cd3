"""Recordings written again without what moves, in their own formats."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from torchcrf_scan.data.clean_bag import writing_clean_bag
from torchcrf_scan.data.clean_carmen import writing_clean_carmen
from torchcrf_scan.data.formats import find_format
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.text_lines import is_gzipped
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import ScanResult

LOG = "clean.log"
TEXT, BAGS = "CARMEN log", ("ROS 1 bag", "MCAP file", "ROS 2 database", "folder of ROS 2")


def clean_name(source: Path) -> str:
    """The name of the clean recording of a source: a log, a bag, or a folder of ROS 2.

    Raises:
        TorchCRFScanError: a format that is not written.
    """
    form = find_format(source)
    if form is not None and form.name == TEXT:
        return f"{LOG}.gz" if is_gzipped(source) else LOG
    if form is not None and form.name in BAGS:
        return "clean.bag" if form.name == BAGS[0] else "clean"
    raise TorchCRFScanError(f"--clean: expected a {TEXT} or a bag, got {source}, a {'file' if form is None else form.name}")


def writing_clean(source: Path, target: Path, options: ReadOptions) -> AbstractContextManager[Callable[[ScanResult], None]]:
    """A clean recording under construction: yields `write(result)`, to be called with the results of the source's scans.

    Args:
        source: a recording for which `clean_name` has a name. target: file or folder to write.
        options: with which the source was read.
    """
    if target.name.removesuffix(".gz") == LOG:
        return writing_clean_carmen(source, target, options)
    return writing_clean_bag(source, target, options.topic)
