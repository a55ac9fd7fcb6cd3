"""What earlier scans saw where a point lies now: a surface, or free space, in which only something that moved can be."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools, Floats, Ints, Scan
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.leftover import OPEN, leftover_of
from torchcrf_scan.search.surface import SEEN_THROUGH
from torchcrf_scan.search.trusted import TIGHT
from torchcrf_scan.stream.view import View

LEAST_THROUGH = 2  # scans that saw free space where a point is, from which it counts as moved,
MOST_STANDING = 1  # if at most so many saw a surface there: what moves slowly meets itself
LEAST_STANDING = 3  # scans that saw a surface there, from which a point counts as standing, if none saw free space


class Votes(NamedTuple):
    """How many earlier scans saw something at the place of every point (P,).

    Attributes:
        through: (P,) free space there. standing: (P,) a surface there.
    """

    through: Ints
    standing: Ints

    def by_beam(self, scan: Scan) -> Votes:
        """The votes on a scan's points, by beam (n_beams,)."""
        return Votes(scan.to_beams(self.through, 0), scan.to_beams(self.standing, 0))

    def of(self, index: Ints) -> Votes:
        """The votes on some points or beams."""
        return Votes(self.through[index], self.standing[index])

    @property
    def has_moved(self) -> Bools:
        """(P,) bool: the place was free until lately."""
        return (self.through >= LEAST_THROUGH) & (self.standing <= MOST_STANDING)

    @property
    def has_stood(self) -> Bools:
        """(P,) bool: the place was never seen free."""
        return (self.through == 0) & (self.standing >= LEAST_STANDING)


class Memory:
    """The last scans that are some time apart.

    Args:
        spacing: seconds between those that are kept. count: how many.
    """

    def __init__(self, spacing: float, count: int) -> None:
        self.spacing = spacing
        self._views: deque[View] = deque(maxlen=count)

    def add(self, view: View) -> None:
        """Remembers a scan, if the last one remembered is old enough."""
        if not self._views or view.time - self._views[-1].time >= self.spacing:
            self._views.append(view)

    def look(self, grid: ScanGrid, pose: Floats) -> Votes:
        """What the scans saw where the points of a grid lie, seen from a pose (3,)."""
        through, standing = np.zeros(len(grid.features), np.int64), np.zeros(len(grid.features), np.int64)
        for view in self._views:
            here = leftover_of(grid, view.grid, se2.compose(se2.inverse(view.pose), pose)).source
            through += (here.sight == SEEN_THROUGH) & (here.residual >= OPEN)
            standing += here.residual < TIGHT
        return Votes(through, standing)

    def clear(self) -> None:
        """Forgets all."""
        self._views.clear()
