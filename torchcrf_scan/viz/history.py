"""What pictures remember of a recording: a path, a map, tracks. Each is thinned at a bound, so that memory does not grow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.result import MovingObject, ScanResult, Status
from torchcrf_scan.scan import BACKGROUND, Floats

PATH = 4000  # rows of a path that are kept at most
CELLS = 60_000  # of a map
TRACKS = 300
TRACK_PATH = 200  # rows of a track
CELL = (0.02, 0.5)  # metres, the finest and the coarsest that a map begins with
CELLS_ACROSS = 250  # of the typical range of the first scan, at the beginning


STATUSES: tuple[Status, ...] = ("ok", "degenerate", "lost")


@dataclass
class Tally:
    """Counts of a recording.

    Attributes:
        scans: number of results, and by `statuses`. metres: travelled. seconds: from the first to the last. objects: their numbers.
    """

    scans: int = 0
    metres: float = 0.0
    seconds: float = 0.0
    statuses: Counter[Status] = field(default_factory=Counter)
    objects: set[int] = field(default_factory=set)
    _first: float = 0.0
    _last: Floats | None = None

    def add(self, result: ScanResult) -> None:
        """Counts one result."""
        self.scans += 1
        self.statuses[result.status] += 1
        self.objects.update(one.number for one in result.objects)
        if self._last is None:
            self._first = result.stamp
        else:
            self.metres += float(np.hypot(*(result.pose[1:] - self._last)))
        self.seconds = result.stamp - self._first
        self._last = result.pose[1:].copy()

    def describe(self) -> str:
        """The counts in words."""
        shares = [
            f"{status} {100 * self.statuses[status] / max(self.scans, 1):.1f} %" for status in STATUSES if self.statuses[status]
        ]
        moving = f"{len(self.objects)} moving object{'' if len(self.objects) == 1 else 's'}"
        return f"{self.scans} scans, {self.seconds:.1f} s, {self.metres:.1f} m travelled, {moving}; {', '.join(shares)}"


class Path:
    """Rows of numbers in the order of time, and always the last; at `limit` every second one goes, later ones come as rarely."""

    def __init__(self, width: int, limit: int = PATH) -> None:
        assert limit % 2 == 0
        self._rows, self._last = np.empty((limit, width)), np.empty((1, width))
        self._used = self._count = 0
        self._stride = 1

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, *row: float) -> None:
        """Appends a row."""
        if self._used == len(self._rows) and self._count % self._stride == 0:
            self._used //= 2
            self._rows[: self._used] = self._rows[::2].copy()
            self._stride *= 2
        if self._count % self._stride == 0:
            self._rows[self._used] = row
            self._used += 1
        self._last[0] = row
        self._count += 1

    @property
    def rows(self) -> Floats:
        """(R, width)."""
        kept = self._rows[: self._used]
        return kept if (self._count - 1) % self._stride == 0 else np.concatenate([kept, self._last])


class StaticMap:
    """Where static points were seen: the mean of them in every cell of a grid, which becomes coarser when there are too many."""

    def __init__(self, limit: int = CELLS) -> None:
        self._limit, self._cell = limit, 0.0  # metres; 0 before the first points
        self._index: dict[tuple[int, int], int] = {}
        self._sums = np.zeros((limit, 2))
        self._hits = np.zeros(limit)

    def add_scan(self, result: ScanResult) -> None:
        """Adds the static points of a scan, unless its pose is lost."""
        if result.status != "lost" and len(result.scan):
            self.add(se2.apply(result.pose, static_points(result)), float(np.percentile(result.scan.ranges, 75)))

    def add(self, points: Floats, reach: float) -> None:
        """Adds the static points of a scan. points: (N, 2) in the world; reach: a typical range, for the size of the cells."""
        if not len(points):
            return
        self._cell = self._cell or float(np.clip(reach / CELLS_ACROSS, *CELL))
        while len(self._index) + len(points) > self._limit:
            self._coarsen()
        self._insert(points, points, np.ones(len(points)))

    def points(self, hits: int = 2) -> Floats:
        """(P, 2) the means of the cells with at least `hits` points."""
        used = len(self._index)
        seen = self._hits[:used] >= hits
        return self._sums[:used][seen] / self._hits[:used][seen, None]

    def _insert(self, places: Floats, sums: Floats, hits: Floats) -> None:
        cells = np.floor(places / self._cell).astype(np.int64)
        index = self._index
        rows = np.array([index.setdefault((x, y), len(index)) for x, y in cells.tolist()])
        np.add.at(self._sums, rows, sums)
        np.add.at(self._hits, rows, hits)

    def _coarsen(self) -> None:
        """Cells of twice the size, without what was seen once only (unless that is most of it)."""
        used = len(self._index)
        sums, hits = self._sums[:used].copy(), self._hits[:used].copy()
        keep = hits > 1 if (hits > 1).sum() > used / 4 else hits > 0
        self._cell *= 2
        self._index.clear()
        self._sums[:used], self._hits[:used] = 0.0, 0.0
        self._insert(sums[keep] / hits[keep, None], sums[keep], hits[keep])


def static_points(result: ScanResult) -> Floats:
    """(P, 2) the scan's points of the background that do not move, in the sensor's frame."""
    beam = result.scan.beam
    return result.scan.points[(result.track[beam] == BACKGROUND) & ~result.moving[beam]]


class TrackPaths:
    """The paths of the objects by number, (stamp, x, y) each; of too many the shortest are forgotten."""

    def __init__(self, limit: int = TRACKS) -> None:
        self._limit = limit
        self.paths: dict[int, Path] = {}

    def add(self, stamp: float, objects: Iterable[MovingObject]) -> None:
        """Adds where the objects are now; predicted positions are left out."""
        for one in objects:
            if one.points == 0:
                continue
            if one.number not in self.paths:
                self.paths[one.number] = Path(3, TRACK_PATH)
            self.paths[one.number].add(stamp, *one.position)
            if len(self.paths) > self._limit:
                self._forget(one.number)

    def _forget(self, newest: int) -> None:
        """Forgets the shorter half, not the newest."""
        lengths = {number: travelled(path.rows[:, 1:]) for number, path in self.paths.items() if number != newest}
        for number in sorted(lengths, key=lambda number: lengths[number])[: self._limit // 2]:
            del self.paths[number]


def travelled(positions: Floats) -> float:
    """Metres from the first to the farthest of (R, 2) positions."""
    return float(np.hypot(*(positions - positions[0]).T).max()) if len(positions) else 0.0
