"""Ctrl-C and termination that let a loop end properly."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopping:
    """While it is entered, signals set `is_asked` instead of ending the program; the loop looks at it after every step.

    Further signals change nothing, as `torchrun` and a terminal both send them to all processes.

    Attributes:
        code: exit code as shells have it, 130 after Ctrl-C and 143 after termination; 0: go on.
    """

    def __init__(self) -> None:
        self.code = 0
        self._before: dict[int, Any] = {}

    @property
    def is_asked(self) -> bool:
        """Whether the loop is to end."""
        return self.code != 0

    def __enter__(self) -> Stopping:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._ask) for number in SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.code = self.code or 128 + number
