"""TensorBoard events of first-order training: scalars by group, histograms, figures, the graph, the settings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import wraps
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec

import numpy as np
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import SCHEDULES
from torchcrf_scan.evaluation.calibration import Sureness
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.evaluation.metrics import score_pairs
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.inference import pseudo_likelihood
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.graph import write_graph
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.run_log import GROUPS, WATCHED, write_settings
from torchcrf_scan.learning.settings import Config
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS
from torchcrf_scan.variants import sweep
from torchcrf_scan.viz.curves import plot_confidence, plot_precision_recall, plot_reliability
from torchcrf_scan.viz.plots import plot_associations, plot_clusters

if TYPE_CHECKING:
    from torchcrf_scan.learning.gradient import Report
    from torchcrf_scan.learning.validation import Answers

log = logging.getLogger(__name__)
P = ParamSpec("P")

LAYOUT = {
    group: {name: ["Multiline", [f"{group}/{name}/.*"]] for name in GROUPS[group]} for group in ("motion", "calibration")
}  # beside that of `run_log`, which TensorBoard merges with it
DATA, OUTLIER = len(LOCAL_CHANNELS), len(LOCAL_CHANNELS) + 1  # columns of the boosted margins among the unary features


def while_it_can_write(show: Callable[Concatenate[TrainingMonitor, P], None]) -> Callable[Concatenate[TrainingMonitor, P], None]:
    """Wraps a method so that a full disk is logged and ends the monitoring, but not the training."""

    @wraps(show)
    def guarded(monitor: TrainingMonitor, /, *args: P.args, **kwargs: P.kwargs) -> None:
        if not monitor.is_full:
            try:
                show(monitor, *args, **kwargs)
            except OSError as error:
                monitor.is_full = True
                log.warning("nothing more is written for TensorBoard: %s", error)

    return guarded


class TrainingMonitor:
    """The events of first-order training, in the folder `training` beside those of the staged fit; a context manager.

    Args:
        folder: the run folder. config: of the run.
        first_step: of a resumed run; older events from this step on are hidden. None: all older events are hidden.
    """

    def __init__(self, folder: Path, config: Config, first_step: int | None = None) -> None:
        self.config = config
        self.is_full = False
        self.writer = SummaryWriter(str(folder / "training"), purge_step=first_step or 0)
        self.has_graph = first_step is not None or not config.gradient.graph
        if first_step is None:
            self.writer.add_custom_scalars(LAYOUT)

    def __enter__(self) -> TrainingMonitor:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @while_it_can_write
    def close(self) -> None:
        """Flushes the remaining events."""
        self.writer.close()

    @while_it_can_write
    def stepped(self, model: JointScanCRF, report: Report) -> None:
        """Losses, gradients, weights and speed of one step."""
        seconds = max(report.seconds, 1e-9)
        scalars = {f"loss/{name}": value for name, value in report.terms.items()}
        scalars |= {f"gradient/{name}": value for name, value in {"norm": report.norm, **report.norms}.items()}
        scalars |= {f"weights/{name}": value for name, value in named_weights(model).items()}
        scalars |= {"schedule/learning_rate": report.rate, "schedule/temperature": self.temperature}
        scalars |= {"throughput/pairs_per_second": report.pairs / seconds, "throughput/nodes_per_second": report.nodes / seconds}
        self._scalars(scalars, report.step)

    @property
    def temperature(self) -> float:
        """Temperature at which the loss reads out beliefs."""
        config = self.config
        is_own = config.has_steps and LOSSES[config.first_order].has_temperature
        return config.unrolled.temperature if is_own else config.model.inference.temperature

    @while_it_can_write
    def validated(self, step: int, model: JointScanCRF, losses: Mapping[str, float], answers: Answers) -> None:
        """Losses, metrics beside those of the baselines, histograms and pictures of one validation."""
        self._scalars({f"validation/{name}": value for name, value in losses.items()}, step)
        for method, predictions in answers.predictions.items():
            found = summarise(score_pairs(answers.pairs, predictions))
            names = [(group, name) for group, of_group in GROUPS.items() for name in of_group]
            self._scalars({f"{group}/{name}/{method}": found[name] for group, name in names}, step)
        self._figures(step, answers)
        batch, start = answers.example
        for name, values in {**boosted_margins(model, batch), **belief_changes(model, batch, start)}.items():
            if len(values):
                self.writer.add_histogram(name, values, step)
        if not self.has_graph:
            self.has_graph = True
            write_graph(self.writer, model, batch, start)

    @while_it_can_write
    def finished(self, settings: Mapping[str, Any]) -> None:
        """The settings of the run beside what the last validation told, for TensorBoard's `hparams`."""
        tags = ["validation/total", *(f"accuracy/{name}/joint" for name in WATCHED)]
        write_settings(self.writer, settings, tags if self.config.gradient.validation else [])

    def _scalars(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            if np.isfinite(value):
                self.writer.add_scalar(name, value, step)

    def _figures(self, step: int, answers: Answers) -> None:
        first = {method: of_method[0] for method, of_method in answers.predictions.items()}
        pair, joint_answer = answers.pairs[0], first["joint"]
        sure = [Sureness.of(*both) for both in zip(answers.pairs, answers.predictions["joint"], strict=True)]
        by_kind = {
            name: (
                np.concatenate([getattr(of, name) for of in sure]),
                np.concatenate([getattr(of, f"{name}_right") for of in sure]),
            )
            for name in ("association", "cluster")
        }
        figures = {
            "pair/associations": plot_associations(pair, first),
            "pair/clusters": plot_clusters(pair, first),
            "pair/confidence": plot_confidence(pair, joint_answer),
            "all/reliability": plot_reliability({name: of for name, of in by_kind.items() if len(of[0])}),
            "all/moving points": plot_precision_recall(*moving_points(answers)),
        }
        for name, figure in figures.items():
            self.writer.add_figure(name, figure, step, close=False)


def moving_points(answers: Answers) -> tuple[np.ndarray, np.ndarray]:
    """(P,) probability of moving of every return and (P,) whether it moves, for returns with an annotated body."""
    scores, truths = [], []
    for pair, score in zip(answers.pairs, answers.moving, strict=True):
        truth, beam = annotation_of(pair), pair.source.beam
        body, known = truth.body[beam], ~truth.ignore[beam]
        known &= body >= 0
        scores.append(score[known])
        truths.append(body[known] > 0)
    return np.concatenate(scores), np.concatenate(truths)


def named_weights(model: JointScanCRF) -> dict[str, float]:
    """Every learned scalar with a name, as `association/NAME` or `clustering/NAME`."""
    chains = {"association": model.association_weights, "clustering": model.clustering_weights}
    return {f"{chain}/{name}": float(weight.detach()) for chain, weights in chains.items() for name, weight in weights.items()}


@torch.no_grad()
def boosted_margins(model: JointScanCRF, batch: ScanPairBatch) -> dict[str, Tensor]:
    """(P,) margins by name: of true and wrong pairs of points, and of inliers and outliers; at the true motions."""
    if not model.config.has_association:
        return {}
    view = model.view(batch)
    plugins = pseudo_likelihood.true_plugins(view.batch, model.config.inference.clusters - 1)
    chain = pseudo_likelihood.association_chain(view, plugins, model.scales, model.boosters, model.config.inference)
    is_true = torch.zeros_like(chain.mask).scatter_(-1, chain.label[..., None], True)
    is_pair = (chain.mask & chain.known[..., None])[..., :-1]
    data, outlier = chain.unary[..., :-1, DATA], chain.unary[..., -1, OUTLIER]
    return {
        "margins/data, true pairs": data[is_pair & is_true[..., :-1]],
        "margins/data, wrong pairs": data[is_pair & ~is_true[..., :-1]],
        "margins/outlier, true outliers": outlier[chain.known & is_true[..., -1]],
        "margins/outlier, others": outlier[chain.known & ~is_true[..., -1]],
    }


@torch.no_grad()
def belief_changes(model: JointScanCRF, batch: ScanPairBatch, start: Start) -> dict[str, Tensor]:
    """(P,) by round, the largest change of every point's cluster beliefs: the residual of the messages.

    Messages on a chain are exact, so convergence is a matter of the rounds only.
    """
    if not SCHEDULES[model.config.inference.schedule].takes_couplings:
        return {}
    view = model.view(batch, model.learned_inputs(batch, start))
    found = sweep.rounds(view, view.in_unit(start), model.fitted, model.config)
    beliefs = [of.state.log_cluster.exp() for of in found]
    if beliefs[0].shape != beliefs[-1].shape:  # CRF-Matching has other states than its start
        beliefs = beliefs[1:]
    mask = batch.source_mask
    return {f"residuals/round {k}": (after - before).abs().amax(-1)[mask] for k, (before, after) in enumerate(pairwise(beliefs), 1)}
