"""Placement of a scan's background on another scan: refined motion, what it explains, covariance, unobserved directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.batch import range_noise_of
from torchcrf_scan.fast.motion import METRICS
from torchcrf_scan.fast.uncertainty import motion_covariance
from torchcrf_scan.loops.candidates import by_motion
from torchcrf_scan.prediction import LEAST_SHARE
from torchcrf_scan.scan import Bools, Floats, Scan, ScanPair
from torchcrf_scan.search.background import refine, unit_length
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.surface import surface_of
from torchcrf_scan.search.trusted import TIGHT

TRUSTED = 0.8  # share of the points explained from which a refined motion is not doubted


@dataclass(frozen=True, slots=True)
class Placement:
    """A scan's background placed on another scan.

    Attributes:
        motion: (3,) `T_other_scan`. covariance: (3, 3) of it; large along what is not observed.
        share: of the points explained. explained: (P,) bool, which.
        unobserved: (3, 3) projection on the unobserved directions (theta L, x, y) about the centre of the explained points, L their
            mean distance from it; 0 where all are observed.
    """

    motion: Floats
    covariance: Floats
    share: float
    explained: Bools
    unobserved: Floats

    @property
    def is_degenerate(self) -> bool:
        """Whether a direction is not observed."""
        return bool(self.unobserved.any())


def grid_at(scan: Scan, points: Floats) -> ScanGrid:
    """The grid of (P, 2) points of a scan, P >= 1, in its frame and the order of its beams."""
    noise = range_noise_of(ScanPair(scan, scan))
    return grid_of(surface_of(np.ascontiguousarray(points), noise, scan.is_closed, np.zeros(2)))


def explained_by(motion: Floats, grid: ScanGrid, other: ScanGrid) -> Bools:
    """(P,) bool: the points of a grid that lie on a surface of the other under a motion (3,)."""
    explained: Bools = leftover_of(grid, other, motion).source.residual < TIGHT
    return explained


def place(grid: ScanGrid, other: ScanGrid, guess: Floats, factor: float = 1.0) -> Placement:
    """Places a scan from a good guess (3,) of its motion into the other's frame.

    factor: of the covariance, as calibrated.
    """
    motion = refine(guess[None], grid, other)[0]
    explained = explained_by(motion, grid, other)
    if explained.mean() < TRUSTED and explained.sum() < (before := explained_by(guess, grid, other)).sum():  # it went astray
        motion, explained = guess, before
    return placed(grid, other, motion, explained, factor)


def placed(grid: ScanGrid, other: ScanGrid, motion: Floats, explained: Bools, factor: float) -> Placement:
    """The placement at a motion (3,) with the points explained (P,)."""
    points, surface = grid.scan.points, other.scan
    nearest = by_motion(surface.boxes, points, motion[None], np.ones(1, np.bool_), 1)[2][:, 0]
    cluster = np.where(explained, 0, -1)
    unit, noise = unit_length(grid.scan, surface), max(grid.scan.noise, surface.noise)
    line = METRICS.index("line")
    association = np.where(explained, nearest, -1)
    covariance, information, directions = motion_covariance(
        points, surface.points, surface.tangent, association, cluster, motion[None], line, unit, noise
    )
    rows = directions[0] * (information[0] < LEAST_SHARE)[:, None]
    return Placement(motion, factor * covariance[0], float(explained.mean()), explained, rows.T @ rows)
