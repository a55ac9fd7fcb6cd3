"""One picture of a whole recording: the map, the sensor's way and the objects', and how it went over time."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcrf_scan.result import ScanResult, Status
from torchcrf_scan.scan import Floats
from torchcrf_scan.viz.frames import STATUS_COLORS
from torchcrf_scan.viz.history import STATUSES, Path, StaticMap, Tally, TrackPaths, travelled
from torchcrf_scan.viz.layout import draw_grid
from torchcrf_scan.viz.lettering import drawable
from torchcrf_scan.viz.marks import INK, NOTE, mover_look
from torchcrf_scan.viz.scene import Window

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, STRIP = 9.6, 0.8  # inches: of the map, and the height of what is drawn over time
LEFT, RIGHT, TOP, BOTTOM, GAP = 0.6, 0.25, 1.0, 0.5, 0.22  # inches around them
FLATTEST, TALLEST = 0.35, 0.85  # height over width of the map
MAP = "#9AA3AD"
LABELS = 40  # tracks with a number at most, the longest
NARROWEST_BAR = 0.004  # share of the recording; what was seen once is visible
LEAST_BAR = 0.03  # share of the recording; shorter bars have no number
LEAST_TRACK = 0.3  # metres; shorter tracks have no number on the map


class Summary:
    """What a picture of a recording needs; memory does not grow with the recording."""

    def __init__(self) -> None:
        self.tally = Tally()
        self._map, self._tracks = StaticMap(), TrackPaths()
        self._path = Path(6)  # stamp, x, y, speed, number of objects, status

    def add(self, result: ScanResult) -> None:
        """Adds one result."""
        self.tally.add(result)
        self._map.add_scan(result)
        self._tracks.add(result.stamp, result.objects)
        speed = float(np.hypot(*result.twist[1:]))
        self._path.add(result.stamp, *result.pose[1:], speed, len(result.objects), STATUSES.index(result.status))

    def plot(self, name: str) -> Figure:
        """The picture. name: of the recording."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        low, high = _window(np.concatenate([self._map.points(), *(path.rows[:, 1:3] for path in self._all_paths())]))
        height = WIDTH * float((high[1] - low[1]) / (high[0] - low[0]))
        figure = Figure(figsize=(LEFT + WIDTH + RIGHT, TOP + height + 2 * (GAP + STRIP) + BOTTOM), facecolor="white")
        FigureCanvasAgg(figure)
        size = np.array([figure.get_figwidth(), figure.get_figheight()] * 2)
        bottoms = (BOTTOM + 2 * (GAP + STRIP), BOTTOM + GAP + STRIP, BOTTOM)
        boxes = [np.array([LEFT, bottom, WIDTH, tall]) / size for bottom, tall in zip(bottoms, (height, STRIP, STRIP), strict=True)]
        plane, speed, objects = (figure.add_axes(tuple(box)) for box in boxes)
        figure.text(LEFT / size[0], 1 - 0.32 / size[1], drawable(name), fontsize=15, fontweight="bold", color=INK, parse_math=False)
        figure.text(LEFT / size[0], 1 - 0.58 / size[1], self.tally.describe(), fontsize=9.5, color=NOTE)
        self._draw_plane(plane, low, high)
        self._draw_speed(speed)
        self._draw_objects(objects)
        return figure

    def _all_paths(self) -> list[Path]:
        return [self._path, *self._tracks.paths.values()]

    def _draw_plane(self, ax: Axes, low: Floats, high: Floats) -> None:
        """Map, paths of the sensor and of the objects."""
        _frame(ax)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.plot(*self._map.points().T, ls="", marker="s", ms=1.1, mew=0, color=MAP, zorder=2, label="static points")
        for status, part in self._parts():
            color = INK if status == "ok" else STATUS_COLORS[status]
            ax.plot(part[:, 1], part[:, 2], color=color, lw=1.4 if status == "ok" else 2.2, zorder=3, solid_capstyle="round")
        rows = self._path.rows
        ax.plot(*rows[0, 1:3], ls="", marker="o", ms=7, mfc="white", mec=INK, mew=1.4, zorder=5)
        ax.plot(*rows[-1, 1:3], ls="", marker="o", ms=7, color=INK, mec="white", mew=0.8, zorder=5)
        lengths = {number: travelled(path.rows[:, 1:]) for number, path in self._tracks.paths.items()}
        longest = sorted(lengths, key=lambda number: -lengths[number])[:LABELS]
        for number, path in self._tracks.paths.items():
            color, way = mover_look(number)[0], path.rows
            ax.plot(way[:, 1], way[:, 2], color=color, lw=1.5, alpha=0.85, zorder=4, marker="." if len(way) == 1 else None)
            if number in longest and lengths[number] > LEAST_TRACK:
                label = ax.annotate(
                    str(number), tuple(way[-1, 1:]), (4, 4), textcoords="offset points", color=color, fontsize=8.5, zorder=6
                )
                label.set(fontweight="bold", path_effects=_rim())
        self._legend(ax)

    def _legend(self, ax: Axes) -> None:
        """What is on the map."""
        ax.plot([], [], color=INK, lw=1.4, label="sensor, from \N{WHITE CIRCLE} to \N{BLACK CIRCLE}")
        for status in STATUSES[1:]:
            if self.tally.statuses[status]:
                ax.plot([], [], color=STATUS_COLORS[status], lw=2.2, label=f"its pose {status}")
        if self._tracks.paths:
            ax.plot([], [], color=mover_look(1)[0], lw=1.5, label="moving objects, by number")
        ax.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, frameon=False, fontsize=8.5, borderaxespad=0.1, markerscale=5
        )

    def _draw_speed(self, ax: Axes) -> None:
        """The sensor's speed over time, and when its pose was not sure."""
        rows = self._path.rows
        _frame(ax, "speed, m/s")
        since = rows[:, 0] - rows[0, 0]
        ax.fill_between(since, rows[:, 3], color="#D0D7DE", lw=0)
        ax.plot(since, rows[:, 3], color=INK, lw=0.9)
        for status, part in self._parts():
            if status != "ok":
                ax.axvspan(part[0, 0] - rows[0, 0], part[-1, 0] - rows[0, 0], color=STATUS_COLORS[status], alpha=0.35, lw=0.8)
        ax.set(xlim=(0, max(since[-1], 1e-3)), ylim=(0, max(1.15 * float(np.percentile(rows[:, 3], 99.5)), 0.1)))
        ax.tick_params(labelbottom=False)

    def _draw_objects(self, ax: Axes) -> None:
        """When each object was seen."""
        begin, end = self._path.rows[[0, -1], 0]
        _frame(ax, "objects")
        ends: list[float] = []  # of the last bar in every lane
        for number, path in sorted(self._tracks.paths.items(), key=lambda item: float(item[1].rows[0, 0])):
            first, last = path.rows[[0, -1], 0] - begin
            last = max(last, first + NARROWEST_BAR * (end - begin))
            lane = next((k for k, free in enumerate(ends) if free <= first), len(ends))
            ends[lane : lane + 1] = [last + NARROWEST_BAR * (end - begin)]
            ax.broken_barh([(first, last - first)], (lane + 0.1, 0.8), color=mover_look(number)[0], lw=0)
            if last - first > LEAST_BAR * (end - begin):
                place = ((first + last) / 2, lane + 0.47)
                ax.text(*place, str(number), ha="center", va="center", fontsize=6.5, color="white", fontweight="bold", clip_on=True)
        ax.set(xlim=(0, max(end - begin, 1e-3)), ylim=(0, max(len(ends), 3)), yticks=[], xlabel="seconds")
        ax.xaxis.label.set(fontsize=8.5, color=NOTE)
        if not ends:
            ax.text(0.5, 0.5, "nothing moving was seen", transform=ax.transAxes, ha="center", va="center", fontsize=9, color=NOTE)

    def _parts(self) -> list[tuple[Status, Floats]]:
        """The path in parts of one status each; a part ends where the next one begins."""
        rows = self._path.rows
        cuts = [0, *(np.flatnonzero(np.diff(rows[:, 5])) + 1).tolist(), len(rows)]
        return [(STATUSES[int(rows[a, 5])], rows[max(a - 1, 0) : b]) for a, b in pairwise(cuts)]


def _window(points: Floats) -> Window:
    """Corners around nearly all points, and all of the paths, of a shape that a page can have."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(1.06 * (high - low), 1.0)
    size = np.maximum(size, (size[1] / TALLEST, size[0] * FLATTEST))
    centre = (low + high) / 2
    return centre - size / 2, centre + size / 2


def _frame(ax: Axes, label: str = "") -> None:
    draw_grid(ax)
    ax.set_ylabel(label, fontsize=8.5, color=NOTE)


def _rim() -> list[Any]:
    """White around letters."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2, foreground="white")]
