"""The picture of a document: the target's rings, the source's points in their bodies' colours, and residuals between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import (
    ClickPanTool,
    ColumnDataSource,
    CustomJS,
    DataRange1d,
    LassoSelectTool,
    PanTool,
    Scatter,
    TapTool,
    WheelZoomTool,
    ZoomInTool,
    ZoomOutTool,
)
from bokeh.plotting import figure

from torchcrf_scan.annotate.document import UNKNOWN, Document
from torchcrf_scan.annotate.queue import sureness
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints, PairPrediction
from torchcrf_scan.viz.marks import INK, NOTE, STATIC, WRONG, mover_look
from torchcrf_scan.viz.scene import make_scene

SHAPES = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle", "v": "inverted_triangle"}
CHOSEN = "#FFC400"
DOUBTFUL = 0.6  # confidence below which a point is marked


def look(label: int) -> tuple[str, str]:
    """Colour and marker of a label."""
    if label > BACKGROUND:
        color, marker = mover_look(label)
        return color, SHAPES[marker]
    return {BACKGROUND: (STATIC, "circle"), OUTLIER: (INK, "x"), UNKNOWN: ("#FFFFFF", "circle")}[label]


class Picture:
    """A figure and the points in it, which the browser selects.

    Attributes:
        figure: of bokeh. lasso, pan: its tools. zooms, pans: those that keys stand for.
        source, target: tables of points, with what is selected in the first.
    """

    def __init__(self) -> None:
        names = {"frame": "x y", "target": "x y", "links": "x0 y0 x1 y1 color", "source": "x y color line marker"}
        names |= {"doubts": "x y", "names": "x y text color"}
        tables = {name: ColumnDataSource({key: [] for key in keys.split()}, name=name) for name, keys in names.items()}
        self._frame, self.target, self._links, self.source, self._doubts, self._names = tables.values()
        spans = DataRange1d(range_padding=0.03), DataRange1d(range_padding=0.03)
        self.figure = plot = figure(
            name="scans", tools=[], toolbar_location=None, match_aspect=True, sizing_mode="stretch_both", min_border=8,
            x_range=spans[0], y_range=spans[1], x_axis_label="ahead, m", y_axis_label="left, m",
        )  # fmt: skip
        plot.grid.grid_line_color = "#EEF0F2"
        plot.outline_line_color = STATIC
        frame = plot.scatter("x", "y", source=self._frame, size=0.1, alpha=0.0)
        for span in spans:
            span.renderers = [frame]
        plot.scatter("x", "y", source=self.target, size=10, fill_color=None, line_color=NOTE, line_width=1.2)
        plot.segment("x0", "y0", "x1", "y1", source=self._links, color="color", line_width=2.5)
        plot.scatter("x", "y", source=self._doubts, size=17, fill_color=None, line_color=WRONG, line_dash="dotted", line_width=1.5)
        dots = plot.scatter(
            "x", "y", source=self.source, size=8, marker="marker", fill_color="color", line_color="line", line_width=1.5
        )
        plot.scatter([0], [0], marker="triangle", angle=-np.pi / 2, size=15, fill_color=INK, line_color="white")
        plot.text("x", "y", text="text", source=self._names, text_color="color", text_font_style="bold", x_offset=12, y_offset=-12)
        dots.nonselection_glyph = dots.glyph
        chosen = {name: getattr(dots.glyph, name) for name in ("x", "y", "marker", "fill_color")}
        dots.selection_glyph = Scatter(**chosen, size=12, line_color=CHOSEN, line_width=2.5)
        self.lasso, self.pan, wheel = LassoSelectTool(renderers=[dots]), PanTool(), WheelZoomTool()
        plot.add_tools(self.lasso, self.pan, wheel, TapTool(renderers=[dots]))
        plot.toolbar.active_scroll, plot.toolbar.active_drag = wheel, self.lasso
        larger, smaller = ZoomInTool(factor=0.2), ZoomOutTool(factor=0.2)
        self.zooms = {"+": larger, "=": larger, "-": smaller}
        ways: dict[str, Any] = {"ArrowLeft": "left", "ArrowRight": "right", "ArrowUp": "up", "ArrowDown": "down"}
        self.pans = {key: ClickPanTool(direction=way) for key, way in ways.items()}
        plot.add_tools(larger, smaller, *self.pans.values())
        self._frame.js_on_change("data", CustomJS(args={"plot": plot}, code="setTimeout(() => plot.reset.emit())"))

    def open(self, document: Document) -> None:
        """Shows another pair: its target, and all of it."""
        points = np.zeros((0, 2)) if document.scans.target is None else document.scans.target.points
        self.choose(np.zeros(0, np.int64))
        self.target.data = {"x": points[:, 0], "y": points[:, 1]}
        self.show_whole(document)

    def show_whole(self, document: Document) -> None:
        """A window around both scans."""
        self._show(np.array(make_scene(document.scans.pair, []).window))

    def show_body(self, document: Document, cluster: int) -> None:
        """A window around a cluster."""
        points = document.moved[document.of(cluster)]
        if len(points) and np.isfinite(points).all():
            margin = 0.2 + 0.5 * np.ptp(points, axis=0).max()
            self._show(np.array([points.min(axis=0) - margin, points.max(axis=0) + margin]))

    def _show(self, corners: Floats) -> None:
        self._frame.data = {"x": corners[:, 0], "y": corners[:, 1]}

    def choose(self, points: Ints) -> None:
        """Selects points of the source."""
        self.source.selected.indices = points.tolist()

    def draw(self, document: Document, active: int, prediction: PairPrediction | None, is_own: bool) -> None:
        """Shows a document. is_own: every point under the motion of its body, else all under the background's."""
        still = se2.apply(document.motions[BACKGROUND], document.scans.source)
        is_moved = is_own & np.isfinite(document.moved)  # a body's motion may be unknown
        points = np.where(is_moved, document.moved, still)
        self._draw_points(points, document)
        self._draw_links(points, document)
        doubts = points[sureness(document.scans.pair, prediction) < DOUBTFUL]
        self._doubts.data = {"x": doubts[:, 0], "y": doubts[:, 1]}
        centres = [points[document.of(k)].mean(axis=0) for k in document.movers]
        x, y = np.reshape(centres, (-1, 2)).T
        texts = [f"{k} ◄" if k == active else str(k) for k in document.movers]
        self._names.data = {"x": x, "y": y, "text": texts, "color": [look(k)[0] for k in document.movers]}

    def _draw_points(self, points: Floats, document: Document) -> None:
        looks = [look(k) for k in document.label.tolist()]
        table: dict[str, Any] = {"x": points[:, 0], "y": points[:, 1]}
        table |= {"color": [color for color, _ in looks], "marker": [marker for _, marker in looks]}
        table["line"] = [NOTE if k == UNKNOWN else color for (color, _), k in zip(looks, document.label.tolist(), strict=True)]
        self.source.data = table

    def _draw_links(self, points: Floats, document: Document) -> None:
        association = document.association
        tied = np.flatnonzero(association != OUTLIER)
        there = points[:0] if document.scans.target is None else document.scans.target.points[association[tied]]
        (x0, y0), (x1, y1) = points[tied].T, there.T
        color = [look(k)[0] if k > BACKGROUND else NOTE for k in document.label[tied].tolist()]
        self._links.data = {"x0": x0, "y0": y0, "x1": x1, "y1": y1, "color": color}
