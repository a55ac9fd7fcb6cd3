"""The layout of a figure: a grid of panels of one size, their frames and titles, one legend for all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchcrf_scan.scan import ScanPair
from torchcrf_scan.viz.lettering import drawable
from torchcrf_scan.viz.marks import INK, NOTE, WRONG
from torchcrf_scan.viz.scene import Scene, Window

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

PANEL_HEIGHT = 3.3  # inches
SMALLEST_TITLE = 6.5  # points


def make_canvas(scene: Scene, rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    """A figure and its panels, row by row; a panel is invisible until it gets a frame."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = scene.window[1] - scene.window[0]
    size = (PANEL_HEIGHT * float(width / height) * columns + 0.4, (PANEL_HEIGHT + 0.45) * rows + 0.7)
    figure = Figure(figsize=size, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()  # until the panel gets a frame
    return figure, [list(row) for row in axes]


def draw_frame(ax: Axes, window: Window, title: str, note: str, mistakes: str = "") -> None:
    """Axes of a window, with a title, a note below it and the mistakes in the corner."""
    ax.set_axis_on()
    ax.set_aspect("equal")
    (x, y), (x_end, y_end) = window
    ax.set_xlim(x, x_end)
    ax.set_ylim(y, y_end)
    ax.set_autoscale_on(False)
    draw_grid(ax)
    left = ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK, pad=19, parse_math=False)
    right = ax.set_title(mistakes, loc="right", fontsize=9, color=WRONG, pad=19)
    _shrink(left, 0.84 * PANEL_HEIGHT * float((x_end - x) / (y_end - y)) - _width(right))  # 0.84: ticks and gaps take the rest
    ax.text(0.0, 1.015, note, transform=ax.transAxes, fontsize=8.5, color=NOTE, va="bottom", in_layout=False)


def draw_grid(ax: Axes) -> None:
    """A pale grid below the marks, and a pale frame."""
    ax.grid(color="#E6E8EB", lw=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=7, color="#B8BEC5", labelcolor=NOTE, length=2.5)
    for spine in ax.spines.values():
        spine.set_color("#B8BEC5")


def _shrink(text: Text, room: float) -> None:
    """Reduces the font size of a text to a width in inches, but not below `SMALLEST_TITLE`."""
    text.set_fontsize(max(float(text.get_fontsize()) * min(1.0, room / max(_width(text), 1e-6)), SMALLEST_TITLE))


def _width(text: Text) -> float:
    """Width in inches."""
    assert text.figure is not None
    return float(text.get_window_extent().width / text.figure.dpi)


def finish(figure: Figure, pair: ScanPair, scans: int = 2) -> Figure:
    """Adds the pair's name and one legend for all panels. scans: consecutive ones, of which the pair's are the first."""
    name = pair.name or pair.sequence or "scan pair"
    what = f"{len(pair.source)} and {len(pair.target)} returns" if scans == 2 else f"{scans} scans from here on"
    counts = f"{what}, {pair.dt:.3g} s apart; x ahead, y left, metres"
    figure.suptitle(f"{drawable(name)}: {counts}", x=0.008, ha="left", fontsize=11.5, color=INK, parse_math=False)
    entries: dict[str, Artist] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        columns = len(entries) if figure.get_figwidth() > 8.0 else 3
        handles, labels = list(entries.values()), list(entries)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, markerscale=1.4)
    return figure
