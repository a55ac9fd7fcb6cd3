"""Bad input, reported in one line each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

Result = TypeVar("Result")


def attempt(failures: list[str], run: Callable[..., Result], *arguments: Any) -> Result | None:
    """The result of `run`; None for bad input, and then the reason is added to `failures`."""
    try:
        return run(*arguments)
    except (ValueError, OSError) as error:
        failures.append(one_line(error))
        return None


def one_line(error: Exception) -> str:
    """The message of an error without line breaks."""
    return " ".join(str(error).split())
