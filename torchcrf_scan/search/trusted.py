"""A motion is never believed unchecked: not if another one explains far more returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools, Floats
from torchcrf_scan.search.background import refine
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.unobserved import LARGE_TURN

TIGHT = 1.0  # units of `leftover_of`: a return this near to a surface is explained by it
LEAST_OF_BEST = 0.6  # of the returns that the best candidate explains,
LEAST_TURNED = 1.02  # and if far turned against the guess: a plain room explains as many turned round


@dataclass(frozen=True, slots=True)
class Backed:
    """A background motion and the returns that it explains.

    Attributes:
        motion: (3,). explained: (P,) bool. share: of the returns of either scan, the lower one: a hand before the sensor fits onto
            any wall, and explains nothing of the room. is_found: the motion is the one that the match found.
    """

    motion: Floats
    explained: Bools
    share: float
    is_found: bool


def choose_background(found: Floats, guess: Floats, source: ScanGrid, target: ScanGrid) -> Backed:
    """The motion found (3,), unless the guess (3,) or standing still explain far more returns; any more, if it is far turned."""
    first = _backed(found, source, target, True)
    least = LEAST_OF_BEST if abs(se2.wrap(found[0] - guess[0])) < LARGE_TURN else LEAST_TURNED
    if first.share >= least:  # whatever the other candidates explain
        return first
    starts = np.stack([guess, np.zeros(3)])
    others = [_backed(motion, source, target, False) for motion in (*starts, *refine(starts, source, target))]
    best = max(others, key=lambda backed: backed.share)
    return first if first.share >= least * best.share else best


def _backed(motion: Floats, source: ScanGrid, target: ScanGrid, is_found: bool) -> Backed:
    left = leftover_of(source, target, motion)
    explained, back = (side.residual < TIGHT for side in (left.source, left.target))
    return Backed(motion, explained, float(min(explained.mean(), back.mean())), is_found)
