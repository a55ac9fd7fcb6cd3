"""The layout of an entry's arguments, for which machine code is built and which every call is checked against.

A layout is `float`, `int` or `bool`; `float64:2` for an array of two dimensions, in C order, aligned and writeable; or a list for a
tuple: its class as `module:name` (empty for a plain one), then the layouts of its items.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any, get_type_hints

import numpy as np

Layout = str | list[Any]

NUMBERS = {"float": (float, int, np.floating, np.integer), "int": (int, np.integer), "bool": (bool, np.bool_)}
REMEMBERED = 8  # tuples of a layout


def layout_of(value: Any, hint: Any = None) -> Layout:
    """The layout of an example. hint: its annotation, which decides whether a number may have a fraction."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}:{value.ndim}"
    if isinstance(value, tuple):
        kind = type(value)
        name = "" if kind is tuple else f"{kind.__module__}:{kind.__qualname__}"
        hints = list(get_type_hints(kind).values()) if name else [None] * len(value)
        return [name, *(layout_of(item, item_hint) for item, item_hint in zip(value, hints, strict=True))]
    if hint is float or isinstance(value, (float, np.floating)):
        return "float"
    for name in ("bool", "int"):
        if isinstance(value, NUMBERS[name]):
            return name
    raise TypeError(f"argument of an entry: expected numbers, arrays and tuples of them, got {type(value).__name__}")


def layouts_of(function: Callable[..., Any], arguments: Sequence[Any]) -> list[Layout]:
    """The layouts of a call's arguments."""
    hints = get_type_hints(function)
    names = function.__code__.co_varnames[: len(arguments)]
    return [layout_of(argument, hints.get(name)) for name, argument in zip(names, arguments, strict=True)]


def class_of(name: str) -> type:
    """The class of a tuple in a layout."""
    module, _, kind = name.partition(":")
    return getattr(import_module(module), kind) if name else tuple


def fits(layout: Layout) -> Callable[[Any], bool]:
    """A check whether a value has a layout. It runs for every argument of every call, so it tests the minimum only."""
    if isinstance(layout, list):
        return _fits_tuple(json.dumps(layout))
    name, _, dimensions = layout.partition(":")
    if dimensions:
        return _fits_array(np.dtype(name), int(dimensions))
    kinds = NUMBERS[name]
    return lambda value: isinstance(value, kinds)


@cache
def _fits_tuple(layout: str) -> Callable[[Any], bool]:
    """One for all entries that take such a tuple: it remembers the last ones that fit, which go from entry to entry."""
    name, *items = json.loads(layout)
    kind: Any = class_of(name)
    checks, fitting = [fits(item) for item in items], dict[int, Any]()

    def check(value: Any) -> bool:
        if fitting.get(id(value), fitting) is value:
            return True
        if type(value) is not kind or len(value) != len(checks):
            return False
        for fits_item, item in zip(checks, value, strict=True):
            if not fits_item(item):
                return False
        if len(fitting) >= REMEMBERED:
            fitting.clear()
        fitting[id(value)] = value
        return True

    return check


def _fits_array(dtype: np.dtype[Any], dimensions: int) -> Callable[[Any], bool]:
    array = np.ndarray

    def check(value: Any) -> bool:
        return type(value) is array and value.dtype == dtype and value.ndim == dimensions and value.flags.carray

    return check
