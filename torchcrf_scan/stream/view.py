"""A scan of the stream that was placed in the world, and the choice of the one to match to."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from torchcrf_scan.scan import Floats, Scan
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.stream.placement import grid_at


@dataclass(frozen=True, slots=True)
class View:
    """A placed scan.

    Attributes:
        grid: of all points. background: of those that do not move. pose: (3,) `T_world_sensor`. time: seconds.
    """

    scan: Scan
    grid: ScanGrid
    background: ScanGrid
    pose: Floats
    time: float

    @classmethod
    def of(cls, scan: Scan, pose: Floats, time: float) -> View:
        """A scan of which nothing is known to move."""
        grid = grid_at(scan, scan.points)
        return cls(scan, grid, grid, pose, time)


class History:
    """The last views, at most `most` of them."""

    def __init__(self, most: int) -> None:
        self._views: deque[View] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._views)

    @property
    def last(self) -> View:
        """The newest view."""
        return self._views[-1]

    def add(self, view: View, lag: float) -> None:
        """Adds a view; older ones are forgotten as soon as another one is `lag` seconds older than it."""
        self._views.append(view)
        while len(self._views) > 1 and self._views[1].time <= view.time - lag:
            self._views.popleft()

    def before(self, time: float) -> View:
        """The newest view not after a time, or the oldest."""
        return next((view for view in reversed(self._views) if view.time <= time), self._views[0])

    def clear(self) -> None:
        """Forgets all."""
        self._views.clear()
