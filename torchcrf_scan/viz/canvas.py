"""An image that is drawn anew many times a second: every mark is drawn at once, by an artist that is used again.

Texts are Pillow's, on top of all marks: matplotlib's take longer than everything else in a picture of a scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchcrf_scan.scan import Floats
from torchcrf_scan.viz.scene import Window

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

DPI = 100
PADDING = 5  # pixels of a box around its text

Image = NDArray[np.uint8]


class Canvas:
    """An image in memory. Marks are placed in a window of the plane, texts in pixels from the lower left corner.

    Args:
        size: (width, height) in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.figure import Figure

        self.size = size
        figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor="white")
        self._agg = FigureCanvasAgg(figure)
        self._ax = ax = figure.add_axes((0, 0, 1, 1))
        ax.set_axis_off()
        (self._dots,) = ax.plot([], [], ls="", mew=0)
        self._lines = ax.add_collection(LineCollection([], capstyle="round"), autolim=False)
        self._shapes = ax.add_collection(PolyCollection([]), autolim=False)
        self._agg.draw()
        self._blank: Any = self._agg.copy_from_bbox(figure.bbox)
        self._texts: list[tuple[tuple[float, float], str, dict[str, Any]]] = []

    def begin(self, window: Window) -> None:
        """Clears the image; marks that follow are in this window."""
        self._window = window
        (x, y), (x_end, y_end) = np.asarray(window).tolist()
        self._agg.restore_region(self._blank)
        self._texts.clear()
        self._ax.set_xlim(x, x_end, auto=False)
        self._ax.set_ylim(y, y_end, auto=False)

    def to_pixels(self, points: Floats) -> Floats:
        """(N, 2) pixels of points in the window."""
        low, high = self._window
        return (points - low) / (high - low) * self.size

    def dots(self, points: Floats, color: str, size: float, marker: str = "o") -> None:
        """Marks of `size` points (1/72 inch) at (N, 2) positions."""
        if len(points):
            self._dots.set(data=points.T, color=color, markersize=size, marker=marker)
            self._draw(self._dots)

    def lines(
        self, lines: Sequence[Floats], color: str | Sequence[str], width: float, alpha: float = 1.0, style: Any = "-"
    ) -> None:
        """Polygonal lines, (P, 2) each; one colour or one each."""
        if len(lines):
            self._lines.set(segments=lines, color=color, linewidth=width, alpha=alpha, linestyle=style)
            self._draw(self._lines)

    def shapes(self, shapes: Sequence[Floats], color: str | Sequence[str]) -> None:
        """Filled polygons with a white edge, (P, 2) each; one colour or one each."""
        if len(shapes):
            self._shapes.set(verts=shapes, facecolor=color, edgecolor="white", linewidth=0.6)
            self._draw(self._shapes)

    def text(self, place: tuple[float, float], text: str, **look: Any) -> None:
        """A line of text above all marks; look: as `_write` has it."""
        self._texts.append((place, text, look))

    def image(self) -> Image:
        """(height, width, 3) what was drawn since `begin`."""
        from PIL import Image as Images
        from PIL.ImageDraw import Draw

        picture = Images.frombuffer("RGBA", self.size, self._agg.buffer_rgba(), "raw", "RGBA", 0, 1).convert("RGB")
        draw = Draw(picture)
        for (x, y), text, look in self._texts:
            _write(draw, (x, self.size[1] - y), text, **look)
        return np.asarray(picture)

    def _draw(self, artist: Artist) -> None:
        self._ax.draw_artist(artist)


def _write(
    draw: ImageDraw,
    place: tuple[float, float],
    text: str,
    *,
    size: float = 12,
    color: str = "black",
    anchor: str = "ls",
    bold: bool = False,
    box: str | None = None,
) -> None:
    """Writes a line with a white rim, or on a box of a colour.

    anchor: what of the text is at its place, by Pillow's letters: left, middle or right, and then baseline (s) or middle.
    """
    font = _font(size, bold)
    if box is not None:
        left, top, right, bottom = draw.textbbox(place, text, font=font, anchor=anchor)
        around = (left - PADDING, top - PADDING, right + PADDING, bottom + PADDING)
        draw.rounded_rectangle(around, radius=PADDING, fill=box)
    draw.text(place, text, fill=color, font=font, anchor=anchor, stroke_width=0 if box else 2, stroke_fill="white")


@cache
def _font(size: float, bold: bool) -> FreeTypeFont:
    """The font that comes with matplotlib."""
    from matplotlib import get_data_path
    from PIL.ImageFont import truetype

    return truetype(Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"), size)
