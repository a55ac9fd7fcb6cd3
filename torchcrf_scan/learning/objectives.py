"""Losses of first-order training: from a model and a portion of pairs to named terms, of which `total` is minimised."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import load
from torchcrf_scan.inference import pseudo_likelihood as features
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.plugins import mix_associations, training_plugins
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.learning.settings import Config, LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import choose
from torchcrf_scan.variants.lattice_likelihood import LatticeChain
from torchcrf_scan.variants.register import BEGINNINGS, ONE_CHAINS

Objective = Callable[[JointScanCRF, Portion], dict[str, Tensor]]


def known_nodes(batch: ScanPairBatch) -> Tensor:
    """() number of annotated points: the terms of a batch are means over these, so it is the weight of the batch."""
    assert batch.truth is not None
    return (batch.truth.known & batch.source_mask).sum()


def pseudo_likelihood(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
    """Negative log pseudo-likelihood per annotated node."""
    start = None if model.encoder is None else start_of(model, portion)
    loss = -model.pseudo_log_likelihood(portion.batch, start=start).sum() / known_nodes(portion.batch).clamp(min=1)
    return {"total": loss}


def likelihood(model: JointScanCRF, portion: Portion, config: LearningConfig) -> dict[str, Tensor]:
    """Negative log of the exact likelihood of each chain per annotated node (spec 6.5), `association` and `cluster`, or `lattice`.

    At the motions of the start where they are right, if the portion was surveyed or the model has an encoder; else at the true
    ones. Costs a forward and a backward recursion over the points; memory N K^2 transitions of every feature.
    """
    nodes = known_nodes(portion.batch).clamp(min=1)
    terms: dict[str, Tensor] = {}
    for name, chain, weights in labelled_chains(model, portion, config):
        terms[name] = -chain.log_likelihood(weights).sum() / nodes
    return terms | {"total": torch.stack([*terms.values()]).sum()}


def labelled_chains(
    model: JointScanCRF, portion: Portion, config: LearningConfig
) -> Iterator[tuple[str, features.Chain | LatticeChain, Tensor]]:
    """The model's chains at the true labels, each with its name and weights.

    In joint models the clustering chain sees the model's own associations in `config.predicted_share` of surveyed pairs (A-28).
    """
    batch, fitted, inference = portion.batch, model.fitted, model.config.inference
    learned = fitted.scales, fitted.boosters, inference
    start = start_of(model, portion) if portion.surveys or model.encoder is not None else None
    generator = torch.Generator().manual_seed(portion.seed)
    inputs = model.learned_inputs(batch, start)
    view = model.view(batch, inputs)
    if start is None:
        plugins = features.true_plugins(view.batch, inference.clusters - 1)
    else:
        plugins = training_plugins(view.batch, view.in_unit(start), config, generator)
    has_association, has_clusters = model.config.has_association, model.config.has_clusters
    if one_chain := ONE_CHAINS.get(model.config.coupling):
        yield model.config.coupling, one_chain(view, plugins, *learned), torch.cat([fitted.association, fitted.clustering])
        return
    if not has_clusters:
        plugins = features.for_background_alone(plugins, view.batch)
    if has_association:
        yield "association", features.association_chain(view, plugins, *learned), fitted.association
    if has_association and has_clusters and start is not None:
        with torch.no_grad():
            predicted = model.decode(batch.without_truth(), start, inputs).association
        plugins = mix_associations(plugins, predicted, config.predicted_share, generator)
    if has_clusters:
        yield "cluster", features.clustering_chain(view, plugins, fitted.scales), fitted.clustering


def start_of(model: JointScanCRF, portion: Portion) -> Start:
    """The initial motions, from the surveys if there are any and the model starts by the search, else from InitialiseRT."""
    if not portion.surveys or model.config.start in BEGINNINGS:
        return model.initialise(portion.batch)
    return choose(portion.batch, portion.surveys, score_of(model.hypothesis_score), model.config.motions)


def make_objective(config: Config) -> Objective:
    """The loss named by `config.first_order`."""
    objective: Objective = load(LOSSES[config.first_order].function)(config)
    return objective


def make_pseudo_likelihood(config: Config) -> Objective:
    """`pseudo_likelihood`, which has no settings."""
    return pseudo_likelihood


def make_likelihood(config: Config) -> Objective:
    """`likelihood` with plug-ins according to `config.learning`."""
    return partial(likelihood, config=config.learning)
