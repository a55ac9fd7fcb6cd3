"""An output that is made in a process of its own, so that drawing does not hold up the matching of scans."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from torchcrf_scan.commands.outputs import Add, Output
from torchcrf_scan.commands.stopping import SIGNALS
from torchcrf_scan.result import ScanResult
from torchcrf_scan.safe_names import one_line

WAITING = 200  # results at most that the process has not taken yet; some come while it begins


class Apart:
    """The output `output(*arguments)`, made in a process of its own. None of its results is lost: adding waits for the process.

    If the output fails, or its process dies, adding the next result or the end raises OSError. A process whose parent ends
    with an error, or is killed, ends its output with an error too.

    Args:
        output: a function of a module, which the process imports. arguments: for it, picklable.
    """

    def __init__(self, output: Callable[..., Output], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._results, self._feed = context.Pipe(duplex=False)
        self._word, self._answer = context.Pipe(duplex=False)
        self._process = context.Process(target=_make, args=(output, arguments, self._results, self._answer))
        self._thread = ThreadPoolExecutor(1)  # sends, so that the pipe's few places do not hold up the caller
        self._sent: deque[Future[None]] = deque()

    def __enter__(self) -> Add:
        with _signals_held():
            self._process.start()
        self._results.close()  # only the process has them now, and its end is noticed
        self._answer.close()
        return self._add

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if error is None:
                self._add(None)
                self._wait_for(0)
                if (fault := self._fault()) is not None:
                    raise OSError(fault)
        finally:
            self._thread.shutdown(cancel_futures=True)
            self._feed.close()
            self._process.join()
            self._word.close()

    def _add(self, result: ScanResult | None) -> None:
        self._sent.append(self._thread.submit(self._feed.send, result))
        self._wait_for(WAITING)

    def _wait_for(self, waiting: int) -> None:
        """Waits until at most so many results wait."""
        try:
            while self._sent and (len(self._sent) > waiting or self._sent[0].done()):
                self._sent.popleft().result()
        except BrokenPipeError:
            raise OSError(self._fault()) from None

    def _fault(self) -> str | None:
        """What the process said at its end: None, or what went wrong."""
        try:
            return self._word.recv()
        except EOFError:
            self._process.join()
            return f"its process ended early, with exit code {self._process.exitcode}"


def _make(output: Callable[..., Output], arguments: tuple[Any, ...], results: Connection, answer: Connection) -> None:
    """The process: adds the results that come to the output until None comes; then says what went wrong, or None."""
    fault = None
    try:
        with output(*arguments) as add:
            while (result := results.recv()) is not None:
                add(result)
    except EOFError:  # the parent ended without an end
        return
    except (ValueError, OSError) as error:
        fault = one_line(error)
    answer.send(fault)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Signals that end us come after the block. A process begun in it never gets them: its parent ends it."""
    resource_tracker.ensure_running()  # which lets signals through where it begins
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
