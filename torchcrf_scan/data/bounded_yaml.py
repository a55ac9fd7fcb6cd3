"""YAML of bounded size: nested aliases expand to more than any memory holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

MOST_VALUES, DEEPEST = 10_000, 50  # of settings: ours have some fifty values, four levels deep
MOST_BYTES = 1 << 24  # of a file


def read_yaml(path: Path) -> Any:
    """The content of a file that a program wrote, such as a recorder, which lists more than settings do.

    Raises:
        yaml.YAMLError: invalid YAML, or more than it needs. UnicodeDecodeError: other bytes. OSError: it cannot be opened.
    """
    with open(path, "rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise yaml.YAMLError(f"expected at most {MOST_BYTES} bytes, got more")
    text = content.decode()
    check_size(text, 10 * MOST_VALUES)
    return yaml.safe_load(text)


def check_size(text: str, most: int = MOST_VALUES) -> None:
    """Raises yaml.YAMLError if a text expands to more values or levels than settings need; in time linear in its length."""
    sizes: dict[str, int] = {}  # number of values of every anchor
    open_: list[tuple[str | None, int]] = [(None, 0)]  # anchors being read, with the values in them so far
    for event in yaml.parse(text, yaml.SafeLoader):
        anchor, count = getattr(event, "anchor", None), 0
        if isinstance(event, yaml.CollectionStartEvent):
            open_.append((anchor, 1))
            if anchor is not None:
                sizes[anchor] = most + 1  # until it is complete: a recursive anchor is infinite
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, count = open_.pop()
        elif isinstance(event, yaml.ScalarEvent):
            count = 1
        elif isinstance(event, yaml.AliasEvent):
            anchor, count = None, sizes.get(event.anchor, 1)
        if count and anchor is not None:
            sizes[anchor] = count
        open_[-1] = (open_[-1][0], open_[-1][1] + count)
        if open_[-1][1] > most or len(open_) > DEEPEST:
            raise yaml.YAMLError(f"expected at most {most} values with aliases written out, {DEEPEST} levels deep, got more")
