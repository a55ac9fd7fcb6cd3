"""Bad input, told in one line each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

Result = TypeVar("Result")


def attempt(failures: list[str], run: Callable[..., Result], *arguments: Any) -> Result | None:
    """What `run` returns, None where the input is bad; then `failures` gets the reason."""
    try:
        return run(*arguments)
    except (ValueError, OSError) as error:
        failures.append(one_line(error))
        return None


def one_line(error: Exception) -> str:
    """Its message without line breaks."""
    return " ".join(str(error).split())
