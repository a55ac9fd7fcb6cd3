"""Figures of confidences: reliability, precision and recall of moving points, confidences of a pair point by point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from torchcrf_scan.evaluation.calibration import expected_calibration_error, reliability
from torchcrf_scan.scan import Floats, PairPrediction, ScanPair
from torchcrf_scan.viz.marks import INK, NOTE, SOURCE, TARGET

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE = 4.0  # inches of a panel


def plot_reliability(answers: dict[str, tuple[ArrayLike, ArrayLike]]) -> Figure:
    """Accuracy against confidence, one panel per kind of label; perfect calibration is the diagonal.

    answers: name -> (P,) confidences and (P,) whether they were right.
    """
    figure, axes = _panels(len(answers))
    for ax, (name, (confidence, right)) in zip(axes, answers.items(), strict=True):
        rows = [row for row in reliability(confidence, right) if row.count]
        total = sum(row.count for row in rows)
        ax.plot([0, 1], [0, 1], color=NOTE, lw=0.8, ls=(0, (4, 3)))
        ax.bar([row.low for row in rows], [row.count / total for row in rows], [row.high - row.low for row in rows],
               align="edge", color=TARGET, alpha=0.3, label="share of the answers")  # fmt: skip
        ax.plot([row.confidence for row in rows], [row.accuracy for row in rows], color=SOURCE, marker="o", ms=3, label="accuracy")
        error = 100 * expected_calibration_error(confidence, right)
        _frame(ax, f"{name}: calibration error {error:.1f} %", "confidence", "accuracy")
        ax.legend(loc="upper left", fontsize=7)
    return figure


def precision_recall(score: Floats, is_positive: ArrayLike) -> tuple[Floats, Floats, float]:
    """Precision and recall at every threshold, from the highest score down, and the average precision (NaN without positives).

    score: (P,). is_positive: (P,) bool. Returns (T,), (T,) for T different scores.
    """
    positive = np.asarray(is_positive, dtype=bool)
    order = np.argsort(-score, kind="stable")
    right = np.cumsum(positive[order])
    last = np.append(np.diff(score[order]) != 0, True) if len(score) else np.zeros(0, dtype=bool)  # equal scores form one threshold
    precision = right[last] / np.arange(1, len(score) + 1)[last]
    if not positive.any():
        return precision, np.full(len(precision), np.nan), float("nan")
    recall = right[last] / positive.sum()
    return precision, recall, float((np.diff(recall, prepend=0.0) * precision).sum())


def plot_precision_recall(curves: dict[str, tuple[Floats, ArrayLike]]) -> Figure:
    """Precision against recall of moving points. curves: name -> (P,) scores and (P,) whether the point moves."""
    figure, (ax,) = _panels(1)
    for (name, (score, moving)), color in zip(curves.items(), (SOURCE, TARGET, INK, NOTE), strict=False):
        precision, recall, average = precision_recall(score, moving)
        # steps: the area under the curve is then the average precision
        ax.step(np.append(0 * recall[:1], recall), np.append(precision[:1], precision), where="pre", color=color,
                label=f"{name}: average precision {average:.2f}")  # fmt: skip
    _frame(ax, "moving points", "recall", "precision")
    ax.legend(loc="lower left", fontsize=7)
    return figure


def plot_confidence(pair: ScanPair, prediction: PairPrediction) -> Figure:
    """The source points, coloured by the confidences of their association and of their cluster."""
    figure, axes = _panels(2)
    points, beam = pair.source.points, pair.source.beam
    for ax, name in zip(axes, ("association", "cluster"), strict=True):
        sure = getattr(prediction, f"{name}_confidence")[beam]
        dots = ax.scatter(points[:, 0], points[:, 1], c=sure, s=6, vmin=0, vmax=1, cmap="viridis")
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(f"{name} confidence", loc="left", fontsize=9, color=INK)
        figure.colorbar(dots, ax=ax, shrink=0.8)
    return figure


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE * count, SIZE), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _frame(ax: Axes, title: str, x: str, y: str) -> None:
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel(x, fontsize=8)
    ax.set_ylabel(y, fontsize=8)
    ax.set_title(title, loc="left", fontsize=9, color=INK)
    ax.grid(color="#E6E8EB", lw=0.6)
