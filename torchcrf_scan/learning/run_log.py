"""TensorBoard events of a run, and its pictures on disk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.viz.plots import plot_pair, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RunLog:
    """Events and pictures of one run folder; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.writer = SummaryWriter(str(folder / "events"))

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.writer.close()

    def objective(self, tag: str, step: int, loss: float, slope: float, weights: Tensor) -> None:
        """One optimiser step of one chain: objective and gradient per node, and every weight by name."""
        self.writer.add_scalar(f"objective/{tag}", loss, step)
        self.writer.add_scalar(f"gradient/{tag}", slope, step)
        both = (*(f"association/{name}" for name in ASSOCIATION_WEIGHTS), *(f"clustering/{name}" for name in CLUSTERING_WEIGHTS))
        names = {len(of): of for of in (ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, both)}[len(weights)]
        for name, value in zip(names, weights.tolist(), strict=True):
            self.writer.add_scalar(f"weights/{tag}/{name}", value, step)

    def metrics(self, method: str, summary: dict[str, float], step: int = 0) -> None:
        """Every finite number of a summary."""
        for name, value in summary.items():
            if np.isfinite(value):
                self.writer.add_scalar(f"test/{name}/{method}", value, step)

    def settings(self, settings: Mapping[str, Any], summary: Mapping[str, float]) -> None:
        """The settings of the run with its results."""
        write_settings(self.writer, settings, summary)

    def picture(self, pair: ScanPair, prediction: PairPrediction, step: int = 0) -> None:
        """The pair with its prediction and the truth side by side: an event and a PNG."""
        figure = plot_pair(pair, prediction)
        save_figure(figure, self.folder / "pictures" / f"{step:02d}_{pair.name}.png")
        self.figure("pair", figure, step)

    def figure(self, tag: str, figure: Figure, step: int = 0) -> None:
        """A figure as an event, without a PNG; it is not closed."""
        self.writer.add_figure(tag, figure, step, close=False)

    def table(self, table: Table, step: int = 0) -> None:
        """A table as text, under its title."""
        self.writer.add_text(f"tables/{table.title}", table.to_markdown(), step)


def write_settings(writer: SummaryWriter, settings: Mapping[str, Any], metrics: Mapping[str, float], step: int = 0) -> None:
    """For TensorBoard's `hparams`: settings by their full names, and finite metrics as `final/NAME`."""
    allowed = {name: value if isinstance(value, bool | int | float | str) else str(value) for name, value in settings.items()}
    final = {f"final/{name}": float(value) for name, value in metrics.items() if np.isfinite(value)}
    events = writer.file_writer
    assert events is not None
    for summary in hparams(allowed, final):
        events.add_summary(summary)
    for name, value in final.items():
        writer.add_scalar(name, value, step)
