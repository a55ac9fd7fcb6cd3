"""Loops over numbers and arrays: machine code where it has been built (`torchcrf_scan.loops.machine`), plain Python elsewhere.

A kernel calls kernels. An entry is a kernel that other code calls as well: only there does an answer cross into machine code.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from torchcrf_scan.loops import machine
from torchcrf_scan.loops.layout import fits

F = TypeVar("F", bound=Callable[..., Any])
Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

log = logging.getLogger(__name__)


Watch = Callable[["Entry", tuple[Any, ...]], None]  # is told of a call


class Entry:
    """A kernel called from Python, with positional arguments.

    Machine code does not check the types and layout of its arguments. Arguments of other layouts are processed by the same
    loops in plain Python, and a warning names the entry once.

    Attributes:
        name: module and function, without the package's name. python: the function itself.
        watch: see `in_python`.
    """

    watch: Watch | None = None

    def __init__(self, python: Callable[..., Any]) -> None:
        self.python = python
        self.name = f"{python.__module__.partition('.')[2]}.{python.__name__}"
        self.__name__, self.__doc__, self.__module__ = python.__name__, python.__doc__, python.__module__
        self._code: Callable[..., Any] | None = None
        self._checks: tuple[Callable[[Any], bool], ...] = ()
        self._has_warned = False

    def __call__(self, *arguments: Any) -> Any:
        """The function's value, by machine code where there is some."""
        if self.watch is not None:
            self.watch(self, arguments)
        else:
            code = self._code or self._find()
            if code is not None and self._takes(arguments):
                return code(*arguments)
        with np.errstate(all="ignore"):  # as machine code, which never warns
            return self.python(*arguments)

    def _find(self) -> Callable[..., Any] | None:
        """The machine code, once there is some."""
        found = machine.find(self.name)
        if found is not None:
            self._checks = tuple(fits(layout) for layout in found.layouts)
            self._code = found.code
        return self._code

    def _takes(self, arguments: tuple[Any, ...]) -> bool:
        if len(arguments) == len(self._checks):
            for check, argument in zip(self._checks, arguments, strict=True):
                if not check(argument):
                    break
            else:
                return True
        if not self._has_warned:
            self._has_warned = True
            log.warning("%s: arguments that its machine code is not made for, answered by slow loops", self.name)
        return False


@contextmanager
def in_python(watch: Watch = lambda entry, arguments: None) -> Iterator[None]:
    """Every entry answers by plain Python meanwhile, and `watch` is told of every call."""
    before, Entry.watch = Entry.watch, staticmethod(watch)
    try:
        yield
    finally:
        Entry.watch = before


KERNELS: list[Callable[..., Any]] = []
ENTRIES: dict[str, Entry] = {}


def kernel(function: F) -> F:
    """A function of numbers and arrays that is compiled into the machine code of those that call it."""
    KERNELS.append(function)
    return function


def entry(function: F) -> F:
    """A kernel that is called from elsewhere too."""
    made = Entry(kernel(function))
    ENTRIES[made.name] = made
    return cast(F, made)
