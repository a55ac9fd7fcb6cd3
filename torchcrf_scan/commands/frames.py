"""Pairs whose second scan is in another frame: a test of methods with large unknown motions.

The method does not know the displacement; its results are transformed to the pair's own frames, to be scored like any other.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from torchcrf_scan.baselines.start import label_nearest
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.fast.choice import can_decode
from torchcrf_scan.geometry import se2
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.prediction import Prediction, Uncertainty
from torchcrf_scan.scan import FARTHEST, PairPrediction, ScanPair

Turn = float | Literal["any"]


@torch.no_grad()
def predict(model: JointScanCRF, batch: ScanPairBatch) -> Prediction:
    """The model's answers, in double precision where the loops give them, as `match_pairs` does."""
    if not can_decode(model.config, batch.source.device):
        return model(batch)
    return copy.deepcopy(model).double()(batch.to(torch.float64))


METHODS: Mapping[str, Callable[[JointScanCRF, ScanPairBatch], Prediction]] = {
    "joint": predict,
    "start": lambda model, batch: label_nearest(batch, model.initialise(batch)),
}


@dataclass(frozen=True, slots=True)
class FrameOffset:
    """Displacement of the second scans' frames.

    Attributes:
        metres: exact distance, in a random direction.
        turn: radians, to a random side, or `any`: uniform over the whole circle.
    """

    metres: float
    turn: Turn

    def __post_init__(self) -> None:
        if not 0 <= self.metres <= FARTHEST:
            raise TorchCRFScanError(f"--frame_offset: expected metres from 0 to {FARTHEST:g}, got {self.metres}")
        if self.turn != "any" and not 0 <= self.turn <= math.pi:
            raise TorchCRFScanError(f"--frame_turn: expected radians from 0 to pi, or any, got {self.turn}")

    def __str__(self) -> str:
        turn = "turned anyhow" if self.turn == "any" else f"turned by {self.turn:g} rad"
        return f"displaced by {self.metres:g} m and {turn}"

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 3) motions of the second scans' points into their new frames, float64; a pair's does not depend on `count`."""
        direction, side = (2 * math.pi * torch.rand(count, 2, dtype=torch.float64, generator=generator) - math.pi).unbind(-1)
        theta = side if self.turn == "any" else torch.full_like(side, self.turn).copysign(side)
        return torch.stack([theta, self.metres * direction.cos(), self.metres * direction.sin()], dim=-1)


@torch.no_grad()
def match_displaced(method: str, model: JointScanCRF, pairs: Sequence[tuple[ScanPair, Tensor]]) -> list[PairPrediction]:
    """Predictions of a method for pairs displaced by an offset (3,) each, in the pairs' own frames."""
    reference = next(model.parameters())
    own = [pair for pair, _ in pairs]
    offset = torch.stack([offset for _, offset in pairs]).to(reference)  # (B, 3)
    batch = ScanPairBatch.collate(own, reference.dtype).without_truth().to(reference.device).displaced(offset)
    found = METHODS[method](model, batch)
    offset = offset.to(found.motions)
    back = se2.inverse(offset)[:, None].expand_as(found.motions)
    uncertainty = found.uncertainty and turned(found.uncertainty, -offset[:, 0])
    found = replace(found, motions=se2.compose(back, found.motions), uncertainty=uncertainty)
    return found.of_pairs(own)


def turned(uncertainty: Uncertainty, angle: Tensor) -> Uncertainty:
    """The same in target frames rotated by angle (B,) radians; independent of their origin."""
    none, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = ((one, none, none), (none, angle.cos(), -angle.sin()), (none, angle.sin(), angle.cos()))
    turn = torch.stack([torch.stack(row, -1) for row in rows], -2)[:, None]  # (B, 1, 3, 3)
    return replace(uncertainty, covariance=turn @ uncertainty.covariance @ turn.mT, directions=uncertainty.directions @ turn.mT)
