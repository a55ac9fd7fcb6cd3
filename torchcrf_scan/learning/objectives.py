"""The losses of first-order training: from a model and a portion of pairs to named terms, of which `total` is descended."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import Config, LearningConfig
from torchcrf_scan.inference import pseudo_likelihood as chain_features
from torchcrf_scan.inference.initialise import Start, choose
from torchcrf_scan.learning.plugins import mix_associations, training_plugins
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


def likelihood(model: JointScanCRF, portion: Portion, config: LearningConfig) -> dict[str, Tensor]:
    """Negative exact log-likelihood of each chain per known node, at the motions of the start where they are right (spec 6.5).

    The clustering chain is told the model's own associations in `config.predicted_share` of the pairs (A-28).
    """
    batch, start = portion.batch, start_of(model, portion)
    generator = torch.Generator().manual_seed(portion.seed)
    view = model.view(batch, model.learned_inputs(batch, start))
    plugins = training_plugins(view.batch, start.scaled(view.factor), config, generator)
    chains, inference = model.config.chains, model.config.inference
    weights, nodes = model.weight_vectors, known_nodes(batch).clamp(min=1)
    terms: dict[str, Tensor] = {}
    if chains == "matching":
        plugins = chain_features.for_background_alone(plugins)
    if chains != "clustering":
        chain = chain_features.association_chain(view, plugins, model.scales, model.boosters, inference)
        terms["association"] = -chain.log_likelihood(weights[0]).sum() / nodes
    if chains != "matching":
        if chains == "joint":
            with torch.no_grad():
                predicted = model(batch.without_truth(), start).association
            plugins = mix_associations(plugins, predicted, config.predicted_share, generator)
        chain = chain_features.clustering_chain(view, plugins, model.scales)
        terms["cluster"] = -chain.log_likelihood(weights[1]).sum() / nodes
    return terms | {"total": torch.stack([*terms.values()]).sum()}


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
    if config.first_order == "likelihood":
        return partial(likelihood, config=config.learning)
    from torchcrf_scan.learning.unrolled import unrolled_loss

    def unrolled(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
        return unrolled_loss(model, portion.batch, config.unrolled, start_of(model, portion))

    return unrolled
