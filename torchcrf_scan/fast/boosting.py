"""Sums of decision stumps as lookup tables; `features.boosting` for one row of features."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel


class Stumps(NamedTuple):
    """A `StumpEnsemble` of F features.

    Attributes:
        thresholds: (F, T) ascending, padded with inf; table: (F, T+1) margin between them.
        finite: (F,) real thresholds. is_live: (F,) whether a feature's margin is ever other than 0.
    """

    thresholds: Array
    table: Array
    finite: Integers
    is_live: Booleans


def double_array(values: Tensor) -> Array:
    """The tensor as a contiguous array in double precision, a copy."""
    return np.ascontiguousarray(values.detach().cpu().double().numpy().copy())


def stumps_of(ensemble: StumpEnsemble) -> Stumps:
    """The ensemble as arrays."""
    thresholds, table = double_array(ensemble.thresholds), double_array(ensemble.table)
    return Stumps(thresholds, table, np.isfinite(thresholds).sum(1).astype(np.int64), (table != 0).any(1))


@kernel
def margin(stumps: Stumps, f: int, value: float) -> float:
    """Margin of feature f: that between the thresholds below the value and the others."""
    row, place, length = stumps.thresholds[f], 0, stumps.finite[f]
    while length > 0:  # without branches on the value, which could not be predicted
        half = (length + 1) >> 1
        place += half * int(row[place + half - 1] < value)
        length -= half
    return float(stumps.table[f, place])


@kernel
def add_margins(stumps: Stumps, f: int, values: Array, total: Array) -> None:
    """Adds the margin of feature f for many values at once; fast where thresholds are few. values, total: (P,)."""
    if not stumps.is_live[f]:
        return
    row, table = stumps.thresholds[f], stumps.table[f]
    for p in range(len(values)):
        total[p] += table[0]
    for t in range(stumps.finite[f]):
        threshold, step = row[t], table[t + 1] - table[t]
        for p in range(len(values)):
            total[p] += step if threshold < values[p] else 0.0
