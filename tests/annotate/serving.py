"""What a test gets that serves the page, and a window of it without a browser."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from torchcrf_scan.annotate.store import Store
from torchcrf_scan.cli import main
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.scan import Annotation

Serve = Callable[..., tuple[ForkServerProcess, str]]  # of the output and more options: the process and the page's address


def run_command(arguments: list[str], told: Path, full: Path | None) -> None:
    """`torchcrf-scan`, in a process of its own. told: the file of its stdout; full: while this file is there the disk is full."""
    sync = os.fsync

    def fsync(number: int) -> None:
        if full is not None and full.exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(number)

    os.fsync = fsync
    with told.open("w") as sys.stdout:
        sys.exit(main(arguments))


def saved_file(output: Path, name: str) -> Path:
    """The file of a pair, finished or not."""
    store = Store(output)
    return store.finished(name) if store.finished(name).exists() else store.unfinished(name)


def saved(output: Path, name: str) -> Annotation:
    annotation = read_pair(saved_file(output, name)).annotation
    assert annotation is not None
    return annotation


def title_of(text: str) -> str:
    """The name of the pair on the page."""
    return text.split("<b>")[2].split("</b>")[0] if text else ""


class Keys:
    """A window that presses keys, a client of the server, which has answered when `press` returns."""

    def __init__(self, session: Any) -> None:
        self.session, self.pressed = session, 0

    def press(self, *keys: str) -> None:
        for key in keys:
            self.pressed += 1
            self.session.document.get_model_by_name("keys").tags = [key, False, self.pressed]
        self.session.force_roundtrip()


@contextmanager
def window(address: str) -> Iterator[Keys]:
    from bokeh.client import pull_session

    session = pull_session(url=address)
    try:
        yield Keys(session)
    finally:
        session.close()


def shown(address: str) -> str:
    """The name of the pair that is open, as one more window shows it."""
    with window(address) as keys:
        return title_of(keys.session.document.get_model_by_name("title").text)
