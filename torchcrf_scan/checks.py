"""Validation of settings: every error names the setting, the expected value and the value given.

The annotation of a settings field holds its bounds, e.g. `Annotated[int, Within(1, 100)]`; `check_fields` converts and
checks all fields when the dataclass is constructed, whether from a command, a file or Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sized
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError

Settings = TypeVar("Settings")

UNIONS = (Union, UnionType)
SHOWN = 80  # characters of a wrong value that a message repeats


@dataclass(frozen=True, slots=True)
class Within:
    """Bounds of a number: from `least` to `most`; `above` excludes `least`, `below` excludes `most`."""

    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    below: bool = False

    def allows(self, value: float) -> bool:
        """Whether a number lies within the bounds; NaN never does."""
        is_low = value > self.least if self.above else value >= self.least
        return is_low and (value < self.most if self.below else value <= self.most)

    def __str__(self) -> str:
        if self.most == math.inf:
            return f" above {self.least}" if self.above else f", {self.least} or more"
        return f" in {'(' if self.above else '['}{self.least}, {self.most}{')' if self.below else ']'}"


@dataclass(frozen=True, slots=True)
class AtMost:
    """A list of limited length."""

    count: int

    def allows(self, value: Sized) -> bool:
        """Whether a list is short enough."""
        return len(value) <= self.count

    def __str__(self) -> str:
        return f" of at most {self.count}"


class OneOf:
    """A string out of a fixed set of choices."""

    def __init__(self, *choices: str) -> None:
        self.choices = choices

    def allows(self, value: str) -> bool:
        """Whether a string is one of the choices."""
        return value in self.choices

    def __str__(self) -> str:
        return f": one of {', '.join(self.choices)}"


Share = Annotated[float, Within(0, 1)]
Amount = Annotated[float, Within(0)]
Positive = Annotated[float, Within(0, above=True)]
Seed = Annotated[int, Within(0, 2**31 - 1)]  # range of every random generator, with room for small offsets


def check_fields(settings: Any, prefix: str = "") -> None:
    """Converts every field of a frozen dataclass to its type (2 to 2.0, a list to a tuple) and checks its bounds.

    Args:
        settings: the instance under construction; called from `__post_init__`.
        prefix: of the names in messages, e.g. `gradient.`.

    Raises:
        TorchCRFScanError: a value of another type, not finite, or out of bounds.
    """
    kind: Any = type(settings)
    for name, hint in _annotations(kind).items():
        value = getattr(settings, name)
        object.__setattr__(settings, name, _converted(f"{prefix}{name}", hint, value))


def from_values(kind: Callable[..., Settings], values: object, name: str) -> Settings:
    """Settings from a dictionary as produced by `asdict` and stored in files; missing keys take their defaults.

    Raises:
        TorchCRFScanError: not a dictionary, an unknown setting, or a value rejected by `check_fields`.
    """
    if not isinstance(values, Mapping):
        raise TorchCRFScanError(f"{name}: expected settings by name, got {_shown(values)}")
    hints = _annotations(kind)
    unknown = [str(key) for key in values if key not in hints]
    if unknown:
        raise TorchCRFScanError(f"{name}: expected settings among {', '.join(hints)}, got {_shown(', '.join(unknown))}")
    return kind(**{key: from_values(hints[key], of, key) if is_dataclass(hints[key]) else of for key, of in values.items()})


@cache
def _annotations(kind: Any) -> dict[str, Any]:
    """The fields of a dataclass with their full type annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def _converted(name: str, hint: Any, value: Any) -> Any:
    """The value converted to its annotated type."""
    base, bounds = (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
    if not _suits(base, value):
        raise TorchCRFScanError(f"{name}: expected {_description(hint)}, got {_shown(value)}")
    if get_origin(base) in UNIONS:
        base = next(of for of in get_args(base) if _suits(of, value))
    if get_origin(base) is tuple:
        converted = tuple(_converted(name, get_args(base)[0], of) for of in value)
    else:
        converted = base(value) if base in (bool, int, float) else value
    if converted is not None and not all(bound.allows(converted) for bound in bounds):
        raise TorchCRFScanError(f"{name}: expected {_description(hint)}, got {_shown(value)}")
    return converted


def _suits(base: Any, value: Any) -> bool:
    """Whether a value is of a type or converts to it without loss; numbers must be finite."""
    if get_origin(base) in UNIONS:
        return any(_suits(of, value) for of in get_args(base))
    if get_origin(base) is tuple:
        return isinstance(value, list | tuple)
    if base is bool or isinstance(value, bool):
        return base is bool and isinstance(value, bool | np.bool_)
    if base is float:
        return isinstance(value, Real) and _is_finite(value)
    return isinstance(value, Integral if base is int else base)


def _is_finite(value: Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer too large for a float
        return False


def _description(hint: Any) -> str:
    """The values that an annotation allows, in words."""
    if get_origin(hint) is Annotated:
        bounds = "".join(map(str, hint.__metadata__))
        if type(None) in get_args(hint.__origin__):  # which has no bounds
            return f"nothing or {' or '.join(_description(of) for of in get_args(hint.__origin__)[:-1])}{bounds}"
        return bounds.removeprefix(": ") if hint.__origin__ is str else _description(hint.__origin__) + bounds
    if get_origin(hint) in UNIONS:
        return " or ".join(map(_description, get_args(hint)))
    known = {int: "a whole number", float: "a finite number", bool: "true or false", str: "a text", type(None): "nothing"}
    return known.get(hint, "a list" if get_origin(hint) is tuple else f"settings ({getattr(hint, '__name__', hint)})")


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
