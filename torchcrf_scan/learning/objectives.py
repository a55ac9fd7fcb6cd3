"""The losses of first-order training: from a model and a portion of pairs to named terms, of which `total` is descended."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import Config
from torchcrf_scan.inference.initialise import Start, choose
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.model import JointScanCRF

Objective = Callable[[JointScanCRF, Portion], dict[str, Tensor]]


def known_nodes(batch: ScanPairBatch) -> Tensor:
    """() real points that somebody annotated: what the terms of a batch are means over, and so its weight among others."""
    assert batch.truth is not None
    return (batch.truth.known & batch.source_mask).sum()


def pseudo_likelihood(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
    """Negative log pseudo-likelihood per known node."""
    loss = -model.pseudo_log_likelihood(portion.batch).sum() / known_nodes(portion.batch).clamp(min=1)
    return {"total": loss}


@torch.no_grad()
def start_of(model: JointScanCRF, portion: Portion) -> Start:
    """The motions to begin with, from what was surveyed, or looked for now."""
    if not portion.surveys:
        return model.initialise(portion.batch)
    clusters = 1 if model.config.chains == "matching" else model.config.inference.clusters - 1
    device = portion.batch.source.device
    if device.type == "cpu":
        return choose(portion.batch, portion.surveys, model.hypothesis_score, clusters)
    found = choose(portion.batch.to("cpu"), portion.surveys, copy.deepcopy(model.hypothesis_score).cpu(), clusters)
    moved: dict[str, Any] = {f.name: getattr(found, f.name) for f in fields(found)}
    moved = {name: None if value is None else value.to(device) for name, value in moved.items()}
    return Start(**moved)


def make_objective(config: Config) -> Objective:
    """The loss that `config.first_order` names."""
    if config.first_order == "pseudo_likelihood":
        return pseudo_likelihood
    from torchcrf_scan.learning.unrolled import unrolled_loss

    def unrolled(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
        return unrolled_loss(model, portion.batch, config.unrolled, start_of(model, portion))

    return unrolled
