"""First-order training: AdamW on portions of pairs, in one or more processes, resumable at any checkpoint.

The pairs of a step are split into parts of fixed size, independent of the number of processes; the parts' gradients are summed,
weighted by their annotated nodes. So the result does not depend on the number of processes, nor on interruptions.
"""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.optim import AdamW
from torch.optim.swa_utils import AveragedModel

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.learning.checkpoint import Store, set_random_state
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.objectives import Objective, known_nodes, make_objective
from torchcrf_scan.learning.portions import Collate, Portion, load_portions
from torchcrf_scan.learning.ranks import Ranks
from torchcrf_scan.learning.schedule import EarlyStopping, make_schedule
from torchcrf_scan.learning.settings import Config, GradientConfig
from torchcrf_scan.learning.stream import PairStream, Parts
from torchcrf_scan.learning.validation import Answers, Validation
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

log = logging.getLogger(__name__)

LINEAR = ("association_weights.", "clustering_weights.", "encoder.last.")  # parameters that log potentials are linear in


@dataclass(frozen=True, slots=True)
class Report:
    """Statistics of one step.

    Attributes:
        step: number of steps done. terms: losses per annotated node. norm: of the gradient before clipping, `norms` of each
            part of the model.
        rate: learning rate. pairs: of all processes. nodes: annotated ones among their points. seconds: duration of the step.
    """

    step: int
    terms: dict[str, float]
    norm: float
    norms: dict[str, float]
    rate: float
    pairs: int
    nodes: int
    seconds: float


class Monitor(Protocol):
    """Observer of the training; only the first process has one."""

    def stepped(self, model: JointScanCRF, report: Report) -> None:
        """Called after every step."""

    def validated(self, step: int, model: JointScanCRF, losses: dict[str, float], answers: Answers) -> None:
        """Called after every validation."""


class Learner:
    """A model with the state of its training."""

    def __init__(self, model: JointScanCRF, config: GradientConfig, ranks: Ranks) -> None:
        self.model, self.config, self.ranks = model.to(ranks.device), config, ranks
        self.parameters = [(name, p) for name, p in model.named_parameters() if p.requires_grad]
        self.optimiser = AdamW([p for _, p in self.parameters], lr=config.learning_rate, weight_decay=config.weight_decay)
        self.schedule = make_schedule(self.optimiser, config)
        self.stopping = EarlyStopping(config.patience)
        self.best: dict[str, Tensor] | None = None
        self.mean = AveragedModel(self.model)
        self.initial = {name: p.detach().clone() for name, p in self.model.named_parameters() if name.startswith(LINEAR)}
        self.step = 0

    def state_dict(self) -> dict[str, Any]:
        """The state from which training can be resumed."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "best": self.best,
            "mean": self.mean.state_dict(),
            "initial": self.initial,
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "stopping": self.stopping.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state, of which it takes a copy, because the optimiser writes into it."""
        state = copy.deepcopy(state)
        self.step, self.best, self.initial = state["step"], state["best"], state["initial"]
        self.model.load_state_dict(state["model"])
        self.mean.load_state_dict(state["mean"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.stopping.load_state_dict(state["stopping"])

    def descend(self, objective: Objective, portions: Iterator[Portion]) -> Report:
        """One step on the next portions, this process's parts of the step."""
        began = time.perf_counter()
        self.model.train()
        self.optimiser.zero_grad(set_to_none=True)
        sums: dict[str, Tensor] = {}
        nodes = torch.zeros((), dtype=torch.float64, device=self.ranks.device)
        for _ in range(self.config.batch_size // self.config.part // self.ranks.world):
            portion = next(portions).to(self.ranks.device)
            weight = known_nodes(portion.batch)
            with torch.autocast(self.ranks.device.type, torch.bfloat16, enabled=has_amp(self.config, self.ranks.device)):
                terms = objective(self.model, portion)
            if terms["total"].requires_grad:
                (terms["total"] * weight).backward()
            sums = {name: sums.get(name, 0.0) + value.detach().double() * weight for name, value in terms.items()}
            nodes = nodes + weight
        means, total = self._average(sums, nodes)
        norm, norms = self._finish()
        rate = float(self.schedule.get_last_lr()[0])
        self.optimiser.step()
        self.schedule.step()
        self.step += 1
        if self.step > self.config.steps * (1 - self.config.average):
            self.mean.update_parameters(self.model)
        return Report(self.step, means, norm, norms, rate, self.config.batch_size, total, time.perf_counter() - began)

    def _average(self, sums: dict[str, Tensor], nodes: Tensor) -> tuple[dict[str, float], int]:
        """Turns sums over nodes, gradients included, into means over the nodes of all processes, in a single message."""
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for _, p in self.parameters]
        flat = torch.cat([*(g.double().flatten() for g in gradients), torch.stack([*sums.values(), nodes])])
        flat = self.ranks.sum(flat)
        total = int(flat[-1])
        flat = flat / max(total, 1)
        *parts, terms = flat.split([*(g.numel() for g in gradients), len(sums) + 1])
        for (_, parameter), part in zip(self.parameters, parts, strict=True):
            parameter.grad = part.view_as(parameter).to(parameter.dtype)
        return dict(zip(sums, terms[:-1].tolist(), strict=True)), total

    def _finish(self) -> tuple[float, dict[str, float]]:
        """Clips the gradient and skips the step if it is not finite. Returns its norm, and that of every part of the model."""
        squares: dict[str, float] = {}
        for name, parameter in self.parameters:
            assert parameter.grad is not None
            group = name.split(".")[0]
            squares[group] = squares.get(group, 0.0) + float(parameter.grad.double().square().sum())
        norm = sum(squares.values()) ** 0.5
        if not norm < float("inf"):
            log.warning("step %d left out: its gradient is not finite", self.step + 1)
            self.optimiser.zero_grad(set_to_none=True)
        elif norm > self.config.clip > 0:
            for _, parameter in self.parameters:
                assert parameter.grad is not None
                parameter.grad.mul_(self.config.clip / norm)
        return norm, {name: value**0.5 for name, value in squares.items()}

    def keep_best(self, loss: float) -> None:
        """Updates the best weights and the early stopping by a validation loss."""
        if self.stopping.look(self.step, loss):
            self.best = copy.deepcopy(self.model.state_dict())

    @torch.no_grad()
    def finish(self) -> None:
        """Leaves the final weights in the model: those of the least validation loss or the mean of the last steps, then blended."""
        if self.best is not None:
            self.model.load_state_dict(self.best)
        elif int(self.mean.n_averaged):
            self.model.load_state_dict(self.mean.module.state_dict())
        for name, parameter in self.model.named_parameters():
            if name in self.initial:
                parameter.lerp_(self.initial[name].to(parameter), 1 - self.config.trained_share)


def has_amp(config: GradientConfig, device: torch.device) -> bool:
    """Whether to use bfloat16: enabled in the settings, and supported by the GPU."""
    return config.amp and device.type == "cuda" and torch.cuda.is_bf16_supported()


def refuse_remainder(gradient: GradientConfig, ranks: Ranks) -> None:
    """Raises TorchCRFScanError where the parts of a step cannot be divided evenly among the processes."""
    if gradient.batch_size // gradient.part % ranks.world:
        parts = f"{gradient.batch_size} / {gradient.part}"
        raise TorchCRFScanError(
            f"gradient.part: expected {parts} parts to be shared out among {ranks.world} processes, got a remainder"
        )


def portions_from(step: int, config: Config, pairs: Sequence[ScanPair], ranks: Ranks) -> Iterator[Portion]:
    """This process's portions of all steps after `step`."""
    gradient = config.gradient
    parts = Parts(gradient.batch_size, gradient.part, step, gradient.steps, ranks.rank, ranks.world)
    needs_start = LOSSES[config.first_order].needs_start or config.model.encoder.width > 0  # motions that align the scans for it
    collate = Collate(config.learning.disturbance, gradient.seed, needs_start)
    return load_portions(PairStream(gradient, pairs), parts, collate, gradient.workers)


def train_by_gradient(
    model: JointScanCRF,
    config: Config,
    pairs: Sequence[ScanPair],
    held_out: Sequence[ScanPair],
    store: Store,
    ranks: Ranks,
    monitor: Monitor | None = None,
    *,
    state: dict[str, Any] | None = None,
) -> Learner:
    """Descends `config.first_order` from the model's weights or a checkpoint; leaves the final weights in the model, on the CPU.

    Args:
        pairs: source of the samples that are not simulated. held_out: validation pairs; empty: the last weights are kept.
        store: written by the first process. state: a checkpoint to resume, the same in every process.

    Raises:
        TorchCRFScanError: the parts of a step cannot be divided evenly among the processes.
    """
    gradient = config.gradient
    refuse_remainder(gradient, ranks)
    objective = make_objective(config)
    learner, validation = Learner(model, gradient, ranks), Validation.of(held_out, gradient.part, ranks)

    def look() -> None:
        if not held_out:
            return
        losses = validation.losses(model, objective, ranks)
        learner.keep_best(losses["total"])
        answers = validation.answers(model, ranks)
        log.info("step %d: validation loss %.5f, best %.5f", learner.step, losses["total"], learner.stopping.best)
        if monitor is not None and answers is not None:
            monitor.validated(learner.step, model, losses, answers)

    def save() -> None:
        if ranks.is_first:
            store.write(learner.step, learner.state_dict())

    if state is None:
        torch.manual_seed(gradient.seed)
        look()
        save()
    else:
        learner.load_state_dict(state)
        set_random_state(state["random"])
    portions = portions_from(learner.step, config, pairs, ranks)
    while learner.step < gradient.steps and not learner.stopping.is_over:
        report = learner.descend(objective, portions)
        if monitor is not None:
            monitor.stepped(model, report)
        is_last = learner.step == gradient.steps
        if learner.step % gradient.validate_every == 0 or is_last:
            look()
        if learner.step % gradient.checkpoint_every == 0 or is_last or learner.stopping.is_over:
            save()
    learner.finish()
    model.to("cpu").eval()
    return learner
