"""First-order training: AdamW on portions of pairs, in one process or many, that can be broken off and gone on with anywhere.

A step's pairs come in parts of fixed size, whatever the number of processes; the gradients of the parts are added up, each weighted
by its known nodes. So many processes descend as one does, and a run that goes on does what it would have done.
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


@dataclass(frozen=True, slots=True)
class Report:
    """One step.

    Attributes:
        step: steps done. terms: losses per known node. norm: of the gradient before it was cut, `norms` of the model's every part.
        rate: learning rate. pairs: of all processes. nodes: known ones among their points. seconds: that the step took.
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
    """Who looks on. Only the first process has one."""

    def stepped(self, model: JointScanCRF, report: Report) -> None:
        """After every step."""

    def validated(self, step: int, model: JointScanCRF, losses: dict[str, float], answers: Answers) -> None:
        """After every look at the validation pairs."""


class Learner:
    """A model and all that changes while it learns."""

    def __init__(self, model: JointScanCRF, config: GradientConfig, ranks: Ranks) -> None:
        self.model, self.config, self.ranks = model.to(ranks.device), config, ranks
        self.parameters = [(name, p) for name, p in model.named_parameters() if p.requires_grad]
        self.optimiser = AdamW([p for _, p in self.parameters], lr=config.learning_rate, weight_decay=config.weight_decay)
        self.schedule = make_schedule(self.optimiser, config)
        self.stopping = EarlyStopping(config.patience)
        self.best: dict[str, Tensor] | None = None
        self.step = 0

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the training goes on."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "best": self.best,
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "stopping": self.stopping.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state, of which it takes a copy: the optimiser would write into it."""
        state = copy.deepcopy(state)
        self.step, self.best = state["step"], state["best"]
        self.model.load_state_dict(state["model"])
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
        return Report(self.step, means, norm, norms, rate, self.config.batch_size, total, time.perf_counter() - began)

    def _average(self, sums: dict[str, Tensor], nodes: Tensor) -> tuple[dict[str, float], int]:
        """Makes sums over nodes, the gradients among them, means over the nodes of all processes: one message for everything."""
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
        """Cuts the gradient; leaves it out where it is not finite. Returns its norm, and that of every part of the model."""
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
        """Takes a validation loss into account."""
        if self.stopping.look(self.step, loss):
            self.best = copy.deepcopy(self.model.state_dict())


def has_amp(config: GradientConfig, device: torch.device) -> bool:
    """Whether to calculate in bfloat16 where that is good enough: asked for, and on a GPU that has it."""
    return config.amp and device.type == "cuda" and torch.cuda.is_bf16_supported()


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
    """Descends `config.first_order` from the model's weights or a checkpoint; leaves the best weights in the model, on the CPU.

    Args:
        pairs: that samples are drawn from where not all are simulated. held_out: validation pairs; none: the last weights are best.
        store: where the first process writes checkpoints. state: one of them to go on from; the same in every process.

    Raises:
        ValueError: the parts of a step cannot be shared out among the processes.
    """
    gradient = config.gradient
    if gradient.batch_size // gradient.part % ranks.world:
        parts = f"{gradient.batch_size} / {gradient.part}"
        raise ValueError(f"gradient.part: expected {parts} parts to be shared out among {ranks.world} processes, got a remainder")
    objective = make_objective(config)
    needs_start = LOSSES[config.first_order].needs_start
    learner = Learner(model, gradient, ranks)
    validation = Validation.of(held_out, gradient.part, ranks)

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
    parts_left = Parts(gradient.batch_size, gradient.part, learner.step, gradient.steps, ranks.rank, ranks.world)
    collate = Collate(config.learning.disturbance, gradient.seed, needs_start)
    portions = load_portions(PairStream(gradient, pairs), parts_left, collate, gradient.workers)
    while learner.step < gradient.steps and not learner.stopping.is_over:
        report = learner.descend(objective, portions)
        if monitor is not None:
            monitor.stepped(model, report)
        is_last = learner.step == gradient.steps
        if learner.step % gradient.validate_every == 0 or is_last:
            look()
        if learner.step % gradient.checkpoint_every == 0 or is_last or learner.stopping.is_over:
            save()
    if learner.best is not None:
        model.load_state_dict(learner.best)
    model.to("cpu").eval()
    return learner
