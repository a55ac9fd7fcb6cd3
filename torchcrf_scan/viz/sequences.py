"""The paper's Figures 3 and 4: associations and clusters of consecutive scans, several methods side by side, the truth last.

Every scan is drawn in its own sensor's frame, the older ones paler; a mover keeps its colour from pair to pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import BACKGROUND, OUTLIER, PairPrediction, ScanPair
from torchcrf_scan.viz.answers import Answer, Labels, all_answers, carried_on
from torchcrf_scan.viz.layout import draw_frame, finish, make_canvas
from torchcrf_scan.viz.marks import INK, STATIC, draw_box, draw_dots, draw_lines, draw_outliers, draw_rings, draw_sensor, mover_look
from torchcrf_scan.viz.scene import Scene, Window, join_windows, make_scene, zoom_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AGES = ("#08306B", "#4A90C2", "#8DB9DA", "#C3D9EA")  # the newest scan first, as the paper's is blue


@dataclass(frozen=True, slots=True)
class Step:
    """A pair of a sequence: its points, and what one method or the annotation says. scan: number of its source of `scans`."""

    scene: Scene
    answer: Answer
    scan: int
    scans: int

    def look(self, later: int = 0) -> tuple[str, str]:
        """Colour and name of its source scan, or a later one."""
        number = self.scan + later
        return AGES[min(self.scans - number, len(AGES) - 1)], f"scan {number}" + (", the newest" if number == self.scans else "")


def consecutive(pairs: Sequence[ScanPair], first: int, most: int) -> list[int]:
    """Numbers of up to `most` pairs from the first on, each of which begins with the scan that ends the one before."""
    found = [first]
    for k in range(first + 1, min(first + most, len(pairs))):
        before, after = pairs[k - 1], pairs[k]
        if before.sequence != after.sequence or not np.array_equal(before.target.points, after.source.points):
            break
        found.append(k)
    return found


def plot_association_sequence(pairs: Sequence[ScanPair], predictions: Mapping[str, Sequence[PairPrediction]]) -> Figure:
    """The associations of consecutive pairs (the paper's Fig. 3), the largest mover of the first one magnified below.

    Args:
        pairs: P annotated pairs, each beginning with the scan that ends the one before. predictions: method -> its P predictions.

    Raises:
        TorchCRFScanError: a pair without annotation, or a prediction that does not fit its pair.
    """
    methods, zoom = _steps(pairs, predictions)
    scene = methods[0][0].scene
    figure, axes = make_canvas(scene, 1 + (zoom is not None), len(methods))
    for column, steps in enumerate(methods):
        _draw_panel(axes[0][column], scene.window, steps, _associations)
        if zoom is not None:
            draw_box(axes[0][column], zoom)
            draw_frame(axes[1][column], zoom, "magnified", "the largest mover (dashed box)")
            for step in steps:
                _associations(axes[1][column], step, 4.0)
    return finish(figure, pairs[0], len(pairs) + 1)


def plot_cluster_sequence(pairs: Sequence[ScanPair], predictions: Mapping[str, Sequence[PairPrediction]]) -> Figure:
    """The clusters of consecutive scans (the paper's Fig. 4), all but the newest; as `plot_association_sequence`."""
    methods, _ = _steps(pairs, predictions)
    figure, axes = make_canvas(methods[0][0].scene, 1, len(methods))
    for column, steps in enumerate(methods):
        _draw_panel(axes[0][column], steps[0].scene.window, steps, _clusters)
    return finish(figure, pairs[0], len(pairs) + 1)


def _steps(
    pairs: Sequence[ScanPair], predictions: Mapping[str, Sequence[PairPrediction]]
) -> tuple[list[list[Step]], Window | None]:
    """The steps of every method, the truth last, all in one window; and the window around the largest mover."""
    bare = [pair.name for pair in pairs if pair.annotation is None]
    if bare:
        raise TorchCRFScanError(f"pairs: expected annotated pairs, got {bare[0]} without annotation")
    answers: list[list[Answer]] = []
    before: Labels | None = None
    for k, pair in enumerate(pairs):
        answers.append(all_answers(pair, {name: of[k] for name, of in predictions.items()}, before))
        before = carried_on(answers[-1][-1].labels, pair)
    scenes = [make_scene(pair, [of[-1].labels]) for pair, of in zip(pairs, answers, strict=True)]
    window = join_windows([scene.window for scene in scenes])
    scenes = [replace(scene, window=window) for scene in scenes]
    methods = [
        [Step(scene, of[m], k + 1, len(pairs) + 1) for k, (scene, of) in enumerate(zip(scenes, answers, strict=True))]
        for m in range(len(answers[0]))
    ]
    return methods, zoom_on([(step.scene, step.answer.labels) for step in methods[-1]])


def _draw_panel(ax: Axes, window: Window, steps: Sequence[Step], draw: Callable[[Axes, Step, float], str]) -> None:
    """One method's panel. draw: marks of a step, returns the name of the mask of its mistakes."""
    answers = [step.answer for step in steps]
    names = [draw(ax, step, 2.0) for step in steps]
    wrong = [getattr(answer, name) for answer, name in zip(answers, names, strict=True)]
    outliers = sum(int((np.isfinite(s.scene.source[:, 0]) & (s.answer.labels.association < 0)).sum()) for s in steps)
    mistakes = "" if any(of is None for of in wrong) else f"{sum(int(of.sum()) for of in wrong)} wrong"
    draw_frame(ax, window, answers[0].name, f"{outliers} outliers in {len(steps)} pairs", mistakes)
    draw_sensor(ax, np.zeros(2), INK)


def _associations(ax: Axes, step: Step, size: float) -> str:
    scene, labels = step.scene, step.answer.labels
    associated = labels.association >= 0
    for k in np.unique(labels.cluster[associated]).tolist():
        draw_lines(ax, scene, labels, associated & (labels.cluster == k), k, width=0.4 + 0.1 * size)
    draw_dots(ax, scene.source, *step.look(), size=size)
    if step.scan + 1 == step.scans:
        draw_dots(ax, scene.target, *step.look(1), size=size)
    draw_rings(ax, scene, step.answer.wrong_association, size=2.0 + size)
    return "wrong_association"


def _clusters(ax: Axes, step: Step, size: float) -> str:
    scene, labels = step.scene, step.answer.labels
    draw_dots(ax, scene.source, STATIC, "background", labels.cluster == BACKGROUND, scene.faint, size=size)
    for k in labels.movers.tolist():
        color, marker = mover_look(k)
        draw_dots(ax, scene.source, color, f"mover {k}", labels.cluster == k, scene.faint, size=1.6 * size, marker=marker)
    draw_outliers(ax, scene, labels.cluster == OUTLIER, size=size)
    draw_rings(ax, scene, step.answer.wrong_cluster, size=2.0 + size)
    return "wrong_cluster"
