"""The exact likelihood as a loss of first-order training: what the staged fit maximises, whatever is padded or unknown."""

from dataclasses import replace
from pathlib import Path

import pytest
import small_run
import torch
from support import assert_close

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.features.scales import live_weights
from torchcrf_scan.inference.pseudo_likelihood import association_chain, clustering_chain, true_plugins
from torchcrf_scan.learning.objectives import known_nodes, likelihood
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.learning.weights_fit import stack
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS

NAMES = ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS


def loss_of(model: JointScanCRF, batch: ScanPairBatch) -> torch.Tensor:
    return likelihood(model, Portion(batch), LearningConfig())["total"]


@pytest.fixture
def batch() -> ScanPairBatch:
    return ScanPairBatch.collate(small_run.small_pairs()[0][:2], torch.float64)


@pytest.fixture
def model() -> JointScanCRF:
    return JointScanCRF(small_run.small_config().model).double()


def test_its_slope_is_that_of_the_staged_fit(model: JointScanCRF, batch: ScanPairBatch) -> None:
    loss_of(model, batch).backward()
    view, fitted = model.view(batch), model.fitted
    plugins = true_plugins(view.batch, model.config.inference.clusters - 1)
    exact = {
        "association": association_chain(view, plugins, fitted.scales, fitted.boosters, model.config.inference),
        "clustering": clustering_chain(view, plugins, fitted.scales),
    }
    live = live_weights(model.config.features)
    for of_chain, vector, is_live, (name, chain) in zip(NAMES, model.weight_vectors, live, exact.items(), strict=True):
        weights = vector.detach().requires_grad_()
        (-stack([chain]).log_likelihood(weights).sum() / known_nodes(batch)).backward()
        assert weights.grad is not None
        expected = dict(zip(of_chain, weights.grad * is_live, strict=True))
        for own, weight in getattr(model, f"{name}_weights").named_parameters():
            assert_close(weight.grad, expected[own])


@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_padding_and_unknown_points_add_nothing(coupling: str, batch: ScanPairBatch) -> None:
    model = JointScanCRF(ModelConfig(coupling=coupling, features=small_run.small_config().model.features)).double()
    each = [ScanPairBatch.collate([pair], torch.float64) for pair in small_run.small_pairs()[0][:2]]
    parts = [loss_of(model, one) * known_nodes(one) for one in each]
    assert_close(loss_of(model, batch) * known_nodes(batch), torch.stack(parts).sum().detach())
    assert batch.truth is not None
    nobody = replace(batch, truth=replace(batch.truth, known=torch.zeros_like(batch.truth.known)))
    assert_close(loss_of(model, nobody), 0.0)


def test_it_is_at_most_certain_and_falls(tmp_path: Path) -> None:
    learner, watcher = small_run.run(tmp_path, small_run.small_config(objective="likelihood", steps=6, clip=0.0))
    losses = [loss for _, loss in watcher.validations]
    assert losses[0] > min(losses) > 0
    assert learner.stopping.best == min(losses)
