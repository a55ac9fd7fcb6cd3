"""Validation of a model in training: losses and predictions on held-out pairs, divided among the processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import nn

from torchcrf_scan.baselines.ransac import match_ransac
from torchcrf_scan.baselines.start import label_nearest
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.objectives import Objective, known_nodes, start_of
from torchcrf_scan.learning.portions import Portion, as_portion
from torchcrf_scan.learning.ranks import Ranks
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import Floats, PairPrediction, ScanPair

BASELINE = "start + gated NN"
RIVAL = "trimmed ICP + RANSAC"


@dataclass(frozen=True, slots=True)
class Answers:
    """Predictions for validation pairs.

    Attributes:
        pairs: P pairs. predictions: by method, P of them.
        moving: P arrays (N,), the belief that a return moves.
        example: a batch of some of the pairs and its start.
    """

    pairs: tuple[ScanPair, ...]
    predictions: dict[str, list[PairPrediction]]
    moving: list[Floats]
    example: tuple[ScanPairBatch, Start]


@dataclass(frozen=True, slots=True)
class Validation:
    """Validation pairs; this process has those at `places`, in surveyed parts. `rivals`: by place, predictions of RANSAC."""

    pairs: tuple[ScanPair, ...]
    places: tuple[tuple[int, ...], ...]
    portions: tuple[Portion, ...]
    rivals: dict[int, PairPrediction]

    @classmethod
    def of(cls, pairs: Sequence[ScanPair], part: int, ranks: Ranks) -> Validation:
        """Surveys this process's share of the pairs, in parts of `part` pairs."""
        parts = [tuple(range(k, min(k + part, len(pairs)))) for k in range(0, len(pairs), part)][ranks.rank :: ranks.world]
        rivals = {k: match_ransac(pairs[k]) for places in parts for k in places}  # only once, as it does not learn
        portions = tuple(as_portion([pairs[k] for k in places]) for places in parts)
        return cls(tuple(pairs), tuple(parts), portions, rivals)

    @torch.no_grad()
    def losses(self, model: JointScanCRF, objective: Objective, ranks: Ranks) -> dict[str, float]:
        """Every term, per annotated node of all pairs; the same in every process."""
        sums: dict[str, float] = {}
        weight = 0.0
        with evaluating(model):
            for portion in self.portions:
                portion = portion.to(ranks.device)
                nodes = float(known_nodes(portion.batch))
                for name, value in objective(model, portion).items():
                    sums[name] = sums.get(name, 0.0) + nodes * float(value)
                weight += nodes
        everyone = ranks.gather((sums, weight))
        total = sum(weight for _, weight in everyone)
        names = [name for sums, _ in everyone for name in sums]
        return {name: sum(sums.get(name, 0.0) for sums, _ in everyone) / max(total, 1.0) for name in dict.fromkeys(names)}

    @torch.no_grad()
    def answers(self, model: JointScanCRF, ranks: Ranks) -> Answers | None:
        """Predictions of the model, of its start without a random field and of RANSAC, in the first process; None in the others."""
        found: dict[str, dict[int, PairPrediction]] = {"joint": {}, BASELINE: {}, RIVAL: self.rivals}
        moving: dict[int, Floats] = {}
        example = None
        with evaluating(model):
            for places, portion in zip(self.places, self.portions, strict=True):
                portion = portion.to(ranks.device)
                batch, start = portion.batch.without_truth(), start_of(model, portion)
                example = example or (portion.batch, start)
                answer = model(batch, start)
                for method, prediction in (("joint", answer), (BASELINE, label_nearest(batch, start))):
                    found[method] |= {k: prediction.pair(row, self.pairs[k]) for row, k in enumerate(places)}
                sure = answer.log_cluster[..., 1:-1].exp().sum(-1).cpu().double().numpy()  # (B, N)
                moving |= {k: sure[row, : len(self.pairs[k].source)] for row, k in enumerate(places)}
        everyone = ranks.gather((found, moving))
        if not ranks.is_first or example is None:
            return None
        order = range(len(self.pairs))
        together = {method: {k: v for part, _ in everyone for k, v in part[method].items()} for method in found}
        all_moving = {k: v for _, part in everyone for k, v in part.items()}
        predictions = {method: [of[k] for k in order] for method, of in together.items()}
        return Answers(self.pairs, predictions, [all_moving[k] for k in order], example)


@contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Context in which a module is in evaluation mode."""
    was_training = module.training
    module.eval()
    try:
        yield
    finally:
        module.train(was_training)
