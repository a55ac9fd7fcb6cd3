"""TensorBoard events of a run, and its pictures on disk: what one watches first, then the weights, then pictures and tables."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.safe_names import file_name
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.viz.plots import plot_pair, save_figure
from torchcrf_scan.whole_file import naming

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GROUPS = {
    "accuracy": ("association_accuracy", "association_within_2", "cluster_accuracy", "iou_moving", "movers_found"),
    "motion": (
        *("ego_success", "ego_rotation_median", "ego_translation_median", "mover_motion_rotation", "mover_motion_centroid"),
        "found_mover_centroid_median",
    ),
    "calibration": ("association_ece", "cluster_ece", "nees_covered", "nees_mean"),
}  # figures of `summarise` that are drawn as curves
WATCHED = GROUPS["accuracy"]  # by the staged fit, which looks a few times only
LAYOUT = {
    "what one watches": {
        "loss": ["Multiline", ["objective/.*", "loss/total", "validation/total"]],
        **{name: ["Multiline", [f"accuracy/{name}"]] for name in WATCHED},
        "gradient": ["Multiline", ["gradient/.*"]],
    },
    "weights": {chain: ["Multiline", [f"weights/{chain}/.*"]] for chain in ("association", "clustering")},
}  # of the staged fit, for TensorBoard's custom scalars: one chart with many lines each


@contextmanager
def one_error(folder: Path) -> Iterator[None]:
    """Makes a failed write of events one error that names the run folder.

    TensorBoard writes in a thread, which prints its own traceback of a full disk before the next event raises the same error here.
    """
    before = threading.excepthook

    def hook(told: threading.ExceptHookArgs) -> None:
        if not (isinstance(told.exc_value, OSError) and type(told.thread).__module__.startswith("tensorboard.")):
            before(told)

    threading.excepthook = hook
    try:
        with naming(folder):
            yield
    finally:
        threading.excepthook = before


class RunLog:
    """Events and pictures of one run folder, where they hide those of an earlier run; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.writer = SummaryWriter(str(folder / "events"), purge_step=0)
        self.writer.add_custom_scalars(LAYOUT)
        self.beside: dict[str, SummaryWriter] = {}

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for writer in (self.writer, *self.beside.values()):
            writer.close()

    def objective(self, tag: str, step: int, loss: float, slope: float) -> None:
        """One optimiser step of one chain: objective and gradient per node."""
        self.writer.add_scalar(f"objective/{tag}", loss, step)
        self.writer.add_scalar(f"gradient/{tag}", slope, step)

    def weights(self, step: int, weights: Tensor) -> None:
        """Every weight of one chain, or of both in one lattice, by name."""
        association = tuple(f"association/{name}" for name in ASSOCIATION_WEIGHTS)
        clustering = tuple(f"clustering/{name}" for name in CLUSTERING_WEIGHTS)
        names = {len(of): of for of in (association, clustering, association + clustering)}[len(weights)]
        for name, value in zip(names, weights.tolist(), strict=True):
            self.writer.add_scalar(f"weights/{name}", value, step)

    def curves(self, summary: Mapping[str, float], step: int, rival: str = "") -> None:
        """The figures of `WATCHED` after a step of the fit, or those of a rival: a run of its own, drawn into the same charts."""
        if rival and rival not in self.beside:
            self.beside[rival] = SummaryWriter(str(self.folder / "events" / rival), purge_step=0)
        writer = self.beside[rival] if rival else self.writer
        for name in WATCHED:
            writer.add_scalar(f"accuracy/{name}", summary[name], step)

    def settings(self, settings: Mapping[str, Any], watched: Sequence[str]) -> None:
        """The settings of the run beside the last values of some of its scalars."""
        write_settings(self.writer, settings, watched)

    def picture(self, pair: ScanPair, prediction: PairPrediction, step: int = 0, name: str = "") -> None:
        """The pair with its prediction and the truth side by side: an event, a tag a pair, and with a name a PNG."""
        figure = plot_pair(pair, prediction)
        if name:
            save_figure(figure, self.folder / "pictures" / f"{file_name(name)}.png")
        self.figure(f"pair/{file_name(pair.name)}", figure, step)

    def figure(self, tag: str, figure: Figure, step: int = 0) -> None:
        """A figure as an event, without a PNG; it is not closed."""
        self.writer.add_figure(tag, figure, step, close=False)

    def tables(self, title: str, tables: Sequence[Table]) -> None:
        """Tables as one text."""
        self.writer.add_text(title, "\n\n".join(table.to_markdown() for table in tables))


def write_settings(writer: SummaryWriter, settings: Mapping[str, Any], watched: Sequence[str]) -> None:
    """For TensorBoard's `hparams`: settings by their full names beside the last values of the scalars of some tags."""
    allowed = {name: value if isinstance(value, bool | int | float | str) else str(value) for name, value in settings.items()}
    events = writer.file_writer
    assert events is not None
    for summary in hparams(allowed, dict.fromkeys(watched, 0.0)):
        events.add_summary(summary)
