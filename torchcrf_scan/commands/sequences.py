"""Scores by sequence: rows of tables and entries of `--json`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar


class Scored(Protocol):
    """The score of a pair."""

    @property
    def sequence(self) -> str:
        """The recording of the pair."""


Score = TypeVar("Score", bound=Scored)


def by_sequence(scores: Sequence[Score]) -> dict[str, list[Score]]:
    """The scores of every sequence, in alphabetical order."""
    sequences = sorted({score.sequence for score in scores})
    return {sequence: [score for score in scores if score.sequence == sequence] for sequence in sequences}


def rows_of(name: str, scores: Sequence[Score]) -> dict[str, list[Score]]:
    """Row of a table -> its scores: every sequence, if there are several, then all."""
    rows = {f"{name}, {sequence or 'no sequence'}": part for sequence, part in by_sequence(scores).items()}
    return {**(rows if len(rows) > 1 else {}), f"{name}, all": list(scores)}


def without_nan(figures: Mapping[str, float]) -> dict[str, float | None]:
    """The same with null for missing values, which JSON has no number for."""
    return {key: None if math.isnan(value) else value for key, value in figures.items()}


def figures_of(scores: Sequence[Score], summarise: Callable[[Sequence[Score]], Mapping[str, float]]) -> dict[str, Any]:
    """`all` and `sequences` of `--json`: what `summarise` gives, null for missing values."""
    parts = {sequence: without_nan(summarise(part)) for sequence, part in by_sequence(scores).items()}
    return {"all": without_nan(summarise(scores)), "sequences": parts}
