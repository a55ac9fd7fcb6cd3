"""Bad input, reported in one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from torchcrf_scan.safe_names import one_line

Result = TypeVar("Result")


def attempt(failures: list[str], run: Callable[..., Result], *arguments: Any) -> Result | None:
    """The result of `run`; None for bad input, and then the reason is added to `failures`."""
    try:
        return run(*arguments)
    except (ValueError, OSError) as error:
        failures.append(one_line(error))
        return None


@dataclass
class LeftOut:
    """Malformed scans and messages of recordings that are left out. count: how many; first: why the first was."""

    count: int = 0
    first: str = ""

    def add(self, error: ValueError) -> None:
        """Counts one; to be called as `on_bad`."""
        self.first = self.first or one_line(error)
        self.count += 1

    def __str__(self) -> str:
        """The end of a line."""
        if self.count < 2:
            return f"; 1 scan or message left out, because of {self.first}" if self.count else ""
        return f"; {self.count} scans or messages left out, the first because of {self.first}"
