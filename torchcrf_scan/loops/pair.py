"""One pair of scans and the start of its rounds as arrays in double precision, without padding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, finite, initial_motion_of, range_noise_of
from torchcrf_scan.loops.jit import Array, Booleans, Integers
from torchcrf_scan.scan import FARTHEST, LONGEST, ScanPair


class Pair(NamedTuple):
    """Two scans of N and M points, metres; the attributes are those of `ScanPairBatch`.

    Attributes:
        source: (N, 2). target: (M, 2). noise: `range_noise`. initial_motion: (3,). target_origin: (2,). dt: seconds.
    """

    source: Array
    target: Array
    source_closed: bool
    target_closed: bool
    noise: float
    initial_motion: Array
    target_origin: Array
    dt: float

    @property
    def fewest_points(self) -> int:
        """Number of points of the scan that has fewer."""
        return min(len(self.source), len(self.target))


class PairStart(NamedTuple):
    """The start of the rounds of one pair of N and M points; the attributes are those of `inference.start.Start`.

    Attributes:
        motions: (C, 3). active: (C,). association: (N,). target_tangents: (M, 2). reach: (N, C).
        log_odds: (C,); (0,): `active` is final.
    """

    motions: Array
    active: Booleans
    association: Integers
    target_tangents: Array
    reach: Array
    log_odds: Array


def array_of(values: Tensor) -> Array:
    """The tensor as a contiguous array in double precision."""
    return np.ascontiguousarray(values.detach().cpu().double().numpy())


def pair_of(batch: ScanPairBatch, b: int) -> Pair:
    """Pair b of a batch without its padding."""
    n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
    return Pair(
        array_of(batch.source[b, :n]),
        array_of(batch.target[b, :m]),
        bool(batch.source_closed[b]),
        bool(batch.target_closed[b]),
        float(batch.range_noise[b]),
        array_of(batch.initial_motion[b]),
        array_of(batch.target_origin[b]),
        float(batch.dt[b]),
    )


def pair_of_scans(pair: ScanPair, dtype: torch.dtype) -> Pair:
    """The pair rounded to a dtype as `ScanPairBatch.collate` rounds it, so that `match` and `forward` give the same labels."""

    def rounded(name: str, values: NDArray | float, most: float = FARTHEST) -> Array:
        return array_of(finite(name, torch.as_tensor(values, dtype=torch.float64).to(dtype), most))

    return Pair(
        rounded("source", pair.source.points),
        rounded("target", pair.target.points),
        pair.source.is_closed,
        pair.target.is_closed,
        rounded("range_noise", range_noise_of(pair)).item(),
        rounded("initial_motion", initial_motion_of(pair)),
        np.zeros(2),
        rounded("dt", pair.dt, LONGEST).item(),
    )


def padded(parts: Sequence[NDArray], shape: tuple[int, ...], value: float | NDArray) -> Tensor:
    """(B, *shape) the parts, padded with a value at the end of every axis."""
    together = np.empty((len(parts), *shape), parts[0].dtype)
    together[:] = value
    for row, part in zip(together, parts, strict=True):
        row[tuple(slice(length) for length in part.shape)] = part
    return torch.from_numpy(together)
