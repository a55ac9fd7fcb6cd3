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


def plot_precision_recall(score: Floats, is_moving: ArrayLike) -> Figure:
    """Precision against recall of moving points, without a curve if none moves. score: (P,). is_moving: (P,) bool."""
    from sklearn.metrics import average_precision_score, precision_recall_curve

    figure, (ax,) = _panels(1)
    _frame(ax, "moving points", "recall", "precision")
    if np.any(is_moving):
        precision, recall, _ = precision_recall_curve(is_moving, score)
        name = f"average precision {average_precision_score(is_moving, score):.2f}"
        ax.step(recall, precision, where="post", color=SOURCE, label=name)  # the area below the steps is the average precision
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
