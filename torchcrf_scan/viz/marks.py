"""The marks on a panel: dots, crosses, rings, lines and arrows, and their colours."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from torchcrf_scan.scan import BACKGROUND, Bools, Floats
from torchcrf_scan.viz.answers import Labels
from torchcrf_scan.viz.scene import Scene, Window, mover_velocities

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SOURCE, TARGET = "#4F7396", "#F28E2B"
STATIC, INK, NOTE, WRONG = "#A3A9B0", "#1F2328", "#57606A", "#C1121F"
MOVERS = ("#009E73", "#CC5FA6", "#0072B2", "#D55E00", "#6F4E9C", "#35A7DB")  # after Okabe and Ito, colour-blind safe
MARKERS = "osD^v"  # one for every six movers
FAINT = 0.22  # opacity of unannotated points
MAX_SPEED_LABELS = 10  # labels of the largest movers only; more would cover the picture


def draw_dots(
    ax: Axes,
    points: Floats,
    color: str,
    label: str,
    mask: Bools | None = None,
    faint: Bools | None = None,
    *,
    size: float,
    marker: str = "o",
) -> None:
    """Points of a mask, all without one; faint ones are transparent and not in the legend."""
    mask = np.ones(len(points), dtype=bool) if mask is None else mask
    for part, alpha in _by_opacity(mask, faint):
        name = label if alpha == 1.0 else ""
        ax.plot(*points[part].T, ls="", marker=marker, ms=size, mew=0, color=color, alpha=alpha, label=name, zorder=3)


def draw_outliers(ax: Axes, scene: Scene, mask: Bools, size: float) -> None:
    """Crosses on source points."""
    for part, alpha in _by_opacity(mask, scene.faint):
        name = "outlier" if alpha == 1.0 else ""
        ax.plot(*scene.source[part].T, ls="", marker="x", ms=size, mew=0.8, color=INK, alpha=alpha, label=name, zorder=3.2)


def draw_rings(ax: Axes, scene: Scene, mask: Bools | None, size: float) -> None:
    """Rings around the source points with wrong predictions."""
    if mask is not None and mask.any():
        points = scene.source[mask].T
        ax.plot(*points, ls="", marker="o", ms=size, mfc="none", mec=WRONG, mew=0.9, label="predicted wrong", zorder=4)


def draw_lines(ax: Axes, scene: Scene, labels: Labels, mask: Bools, cluster: int, width: float) -> None:
    """Lines from source points to their target points, in the cluster's colour; one artist, broken by NaN."""
    color = NOTE if cluster <= BACKGROUND else mover_look(cluster)[0]
    for part, alpha in _by_opacity(mask, scene.faint):
        ends = np.stack([scene.source[part], scene.target[labels.association[part]]], axis=1)  # (n, 2 ends, 2)
        path = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        name = "association" if cluster <= BACKGROUND and alpha == 1.0 else ""
        ax.plot(*path.T, color=color, lw=width, alpha=0.75 * alpha, label=name, zorder=2)


def draw_arrows(ax: Axes, scene: Scene, labels: Labels) -> None:
    """Arrows and speeds of the movers whose motion is known."""
    known = mover_velocities(scene.source, scene.dt, labels)
    if not known:
        return
    centroids, velocities = np.stack([c for c, _ in known.values()]), np.stack([v for _, v in known.values()])
    ax.quiver(
        *centroids.T, *(scene.arrow_seconds * velocities).T, color=[mover_look(k)[0] for k in known], angles="xy", scale_units="xy",
        scale=1, units="inches", width=0.03, edgecolor="white", linewidth=0.4, minshaft=1.5, zorder=6,
    )  # fmt: skip
    largest = sorted(known, key=lambda k: -int((labels.cluster == k).sum()))[:MAX_SPEED_LABELS]
    for k in largest:
        centroid, velocity = known[k]
        _speed_label(ax, scene, centroid + scene.arrow_seconds * velocity, velocity, mover_look(k)[0])
    note = f"arrow: {scene.arrow_seconds:g} s of travel"
    ax.text(0.985, 0.015, note, transform=ax.transAxes, ha="right", va="bottom", fontsize=8, color=NOTE, zorder=7)


def _speed_label(ax: Axes, scene: Scene, tip: Floats, velocity: Floats, color: str) -> None:
    """Writes the speed at the arrow's tip, moved into the picture if necessary."""
    low, high = scene.window
    place = np.clip((tip - low) / (high - low), 0.02, 0.95)
    side = "left" if place[0] < 0.15 else "right" if place[0] > 0.85 else "center"
    speed, up = float(np.hypot(*velocity)), velocity[1] >= 0.0 and place[1] < 0.9
    x, y = (low + place * (high - low)).tolist()
    ax.annotate(
        f"{speed:.2f} m/s" if speed < 10.0 else f"{speed:.1f} m/s", (x, y), (0, 5 if up else -5), textcoords="offset points",
        ha=side, va="bottom" if up else "top", fontsize=9, fontweight="bold", color=color,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6}, in_layout=False, zorder=7,
    )  # fmt: skip


def draw_box(ax: Axes, window: Window) -> None:
    """The dashed outline of a window that is magnified elsewhere."""
    (x, y), (x_end, y_end) = window
    ax.plot([x, x_end, x_end, x, x], [y, y, y_end, y_end, y], color=INK, lw=0.8, ls=(0, (4, 3)), zorder=5)


def draw_sensor(ax: Axes, position: Floats, color: str) -> None:
    """A triangle that points ahead."""
    ax.plot(*position, ls="", marker=(3, 0, -90), ms=9, color=color, mec="white", mew=0.8, label="sensor", zorder=5)


def mover_look(cluster: int) -> tuple[str, str]:
    """Colour and marker of a mover."""
    round_, index = divmod(cluster - 1, len(MOVERS))
    return MOVERS[index], MARKERS[round_ % len(MARKERS)]


def _by_opacity(mask: Bools, faint: Bools | None) -> Iterator[tuple[Bools, float]]:
    faint = np.zeros_like(mask) if faint is None else faint
    for part, alpha in ((mask & ~faint, 1.0), (mask & faint, FAINT)):
        if part.any():
            yield part, alpha
