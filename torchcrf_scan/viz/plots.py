"""Figures of a pair: associations, clusters and velocities of every point, beside the annotation if there is one.

All positions are in the source sensor's frame (x ahead, y left, metres); target points are drawn at their own coordinates, so the
line of an association also shows the motion of the sensor. Arrows show velocities relative to the world: for a mover with motion
T and the background's B, both `T_target_source`, its centroid c travels B^-1(T(c)) - c in `dt` seconds.

Matplotlib is imported when a figure is made, not with this module, and pyplot is not used: no global state, no display.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Floats, PairPrediction, ScanPair
from torchcrf_scan.viz.answers import Answer, all_answers, judge, predicted_labels, true_labels
from torchcrf_scan.viz.layout import draw_frame, finish, make_canvas
from torchcrf_scan.viz.marks import (
    INK,
    SOURCE,
    STATIC,
    TARGET,
    draw_arrows,
    draw_box,
    draw_dots,
    draw_lines,
    draw_outliers,
    draw_rings,
    draw_sensor,
    mover_look,
)
from torchcrf_scan.viz.scene import Scene, make_scene
from torchcrf_scan.whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_COLUMNS = 5


def plot_pair(pair: ScanPair, prediction: PairPrediction | None = None) -> Figure:
    """Draws a pair, its prediction (first row) and its annotation (next row, with the prediction's mistakes ringed).

    Columns: both scans in their sensors' frames (next row: with the sensor's motion undone); associations; clusters with the
    movers' velocities and the sensor's motion; the largest mover magnified. Rows and columns without content are left out.

    Raises:
        TorchCRFScanError: the prediction does not fit the pair.
    """
    truth = true_labels(pair)
    guess = None if prediction is None else predicted_labels(pair, "prediction", prediction, truth)
    rows = []
    if guess is not None:
        rows.append(Answer("predicted", guess))
    if truth is not None:
        rows.append(Answer("true", truth) if guess is None else judge("true", truth, pair, guess, truth))
    scene = make_scene(pair, [row.labels for row in reversed(rows)])
    columns = 1 if not rows else 3 + (scene.zoom is not None)
    figure, axes = make_canvas(scene, max(len(rows), 1), columns)
    _draw_scans(axes[0][0], scene)
    for index, (answer, panels) in enumerate(zip(rows, axes, strict=False)):
        if index > 0:
            _draw_registered(panels[0], scene, answer)
        _draw_associations(panels[1], scene, answer, f"{answer.name} associations")
        _draw_clusters(panels[2], scene, answer, f"{answer.name} clusters")
        if scene.zoom is not None:
            _draw_zoom(panels[3], scene, answer, "magnified")
    return finish(figure, pair)


def plot_associations(pair: ScanPair, predictions: Mapping[str, PairPrediction]) -> Figure:
    """Draws the associations of several methods side by side, the truth last, the largest mover magnified below each.

    Args:
        pair: with an annotation, mistakes are ringed (more than `ASSOCIATION_TOLERANCE` beams off, or outlier against inlier).
        predictions: method name -> its prediction of this pair.

    Raises:
        TorchCRFScanError: there is nothing to draw, or a prediction does not fit the pair.
    """
    answers = all_answers(pair, predictions)
    scene = make_scene(pair, [answer.labels for answer in reversed(answers)])
    rows_each = 1 + (scene.zoom is not None)
    figure, axes = make_canvas(scene, rows_each * -(-len(answers) // MAX_COLUMNS), min(len(answers), MAX_COLUMNS))
    for index, answer in enumerate(answers):
        row, column = divmod(index, MAX_COLUMNS)
        _draw_associations(axes[row * rows_each][column], scene, answer, answer.name)
        if scene.zoom is not None:
            _draw_zoom(axes[row * rows_each + 1][column], scene, answer, "magnified")
    return finish(figure, pair)


def plot_clusters(pair: ScanPair, predictions: Mapping[str, PairPrediction]) -> Figure:
    """Draws the clusters and velocities of several methods side by side, the truth last.

    Args:
        pair: with an annotation, mistakes are ringed; movers are matched to the true ones first and share their colours.
        predictions: method name -> its prediction of this pair.

    Raises:
        TorchCRFScanError: there is nothing to draw, or a prediction does not fit the pair.
    """
    answers = all_answers(pair, predictions)
    scene = make_scene(pair, [answer.labels for answer in reversed(answers)])
    figure, axes = make_canvas(scene, -(-len(answers) // MAX_COLUMNS), min(len(answers), MAX_COLUMNS))
    for index, answer in enumerate(answers):
        _draw_clusters(axes[index // MAX_COLUMNS][index % MAX_COLUMNS], scene, answer, answer.name)
    return finish(figure, pair)


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: float = 130.0) -> None:
    """Writes a PNG atomically; creates missing folders.

    Raises:
        TorchCRFScanError: `path` does not end in .png.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise TorchCRFScanError(f"path: expected a name ending in .png, got {path.name!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        figure.savefig(file, format="png", dpi=dpi)


# Panels


def _draw_scans(ax: Axes, scene: Scene) -> None:
    draw_frame(ax, scene.window, "both scans", "each in its own sensor's frame")
    draw_dots(ax, scene.target, TARGET, "target scan", size=3.0)
    draw_dots(ax, scene.source, SOURCE, "source scan", size=3.0)
    draw_sensor(ax, np.zeros(2), INK)


def _draw_registered(ax: Axes, scene: Scene, answer: Answer) -> None:
    """Both scans in the target's frame: static points coincide, movers are apart."""
    background = answer.labels.motion(BACKGROUND)
    draw_frame(ax, scene.window, "sensor's motion undone", f"source moved by the {answer.name} background motion")
    draw_dots(ax, scene.target, TARGET, "target scan", size=3.0)
    if np.isfinite(background).all():
        draw_dots(ax, se2.apply(background, scene.source), SOURCE, "source scan", size=3.0)
        draw_sensor(ax, background[1:], SOURCE)
    draw_sensor(ax, np.zeros(2), TARGET)


def _draw_associations(ax: Axes, scene: Scene, answer: Answer, title: str) -> None:
    outliers = int((np.isfinite(scene.source[:, 0]) & (answer.labels.association < 0)).sum())
    draw_frame(ax, scene.window, title, f"{outliers} outliers", _mistakes(answer.wrong_association, scene))
    _associations(ax, scene, answer, size=2.4)
    if scene.zoom is not None:
        draw_box(ax, scene.zoom)
    draw_sensor(ax, np.zeros(2), INK)


def _draw_zoom(ax: Axes, scene: Scene, answer: Answer, title: str) -> None:
    assert scene.zoom is not None
    draw_frame(ax, scene.zoom, title, "the largest mover (dashed box)")
    _associations(ax, scene, answer, size=5.0)


def _draw_clusters(ax: Axes, scene: Scene, answer: Answer, title: str) -> None:
    labels = answer.labels
    draw_frame(ax, scene.window, title, _ego_motion(labels.motion(BACKGROUND)), _mistakes(answer.wrong_cluster, scene))
    static = labels.cluster == BACKGROUND
    draw_dots(ax, scene.source, STATIC, "background", static, scene.faint, size=3.0)
    for index, k in enumerate(labels.movers.tolist()):
        color, marker = mover_look(k)
        name = "" if index else "mover, with its speed"
        draw_dots(ax, scene.source, color, name, labels.cluster == k, scene.faint, size=4.6, marker=marker)
    draw_outliers(ax, scene, labels.cluster == OUTLIER, size=3.6)
    draw_rings(ax, scene, answer.wrong_cluster, size=6.5)
    draw_arrows(ax, scene, labels)
    draw_sensor(ax, np.zeros(2), INK)


def _associations(ax: Axes, scene: Scene, answer: Answer, size: float) -> None:
    labels = answer.labels
    associated = labels.association >= 0
    draw_dots(ax, scene.target, TARGET, "target scan", size=size)
    for k in np.unique(labels.cluster[associated]).tolist():
        draw_lines(ax, scene, labels, associated & (labels.cluster == k), k, width=0.5 + 0.12 * size)
    draw_dots(ax, scene.source, SOURCE, "source scan", associated, scene.faint, size=size)
    draw_outliers(ax, scene, ~associated, size=1.6 + 0.8 * size)
    draw_rings(ax, scene, answer.wrong_association, size=4.5 + size)


def _ego_motion(background: Floats) -> str:
    if not np.isfinite(background).all():
        return "sensor's motion unknown"
    theta, x, y = se2.inverse(background)
    dx, dy, degrees = round(x, 2) + 0.0, round(y, 2) + 0.0, round(float(np.degrees(theta)), 1) + 0.0  # + 0.0: never -0.00
    return f"sensor: dx {dx:+.2f} m, dy {dy:+.2f} m, d\N{GREEK SMALL LETTER THETA} {degrees:+.1f}\N{DEGREE SIGN}"


def _mistakes(wrong: Bools | None, scene: Scene) -> str:
    if wrong is None:
        return ""
    judged = int((np.isfinite(scene.source[:, 0]) & ~scene.faint).sum())
    return f"{int(wrong.sum())} of {judged} wrong"
