"""Checks of settings: every error names the setting, what was expected and what it got."""

from __future__ import annotations

import math


def choose(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError where a value is none of the choices."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value}")


def within(name: str, value: float, least: float, most: float) -> None:
    """Raises ValueError where a value is not in [least, most]."""
    if not least <= value <= most:  # NaN is not
        expected = f"{least} or more" if most == math.inf else f"a number in [{least}, {most:g}]"
        raise ValueError(f"{name}: expected {expected}, got {value}")
