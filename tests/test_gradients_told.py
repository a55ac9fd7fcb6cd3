"""What the README tells of every output's gradient: where there is one, where it is zero, where it has a kink."""

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest
import torch
from support import assert_close
from torch import Tensor

from torchcrf_scan import ExtraLogUnary, JointScanCRF, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.start import Start
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import PairPrediction

LABELS = ("association", "cluster", "active", "candidates", "converged", "iterations")
OF_ASSOCIATION = {"association weights", "embeddings"}
OF_CLUSTERING = {"clustering weights", "moving"}


@cache
def scene() -> tuple[ScanPairBatch, Start]:
    """Two coarse pairs of a street and their start."""
    batch = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=41), 2, 1, 3), torch.float64)
    return batch, JointScanCRF.from_pretrained("simulated", backend="eager").double().initialise(batch)


@dataclass(frozen=True)
class Layer:
    """The shipped layer on the scene, with everything that a gradient could reach."""

    leaves: dict[str, list[Tensor]]
    prediction: Prediction

    @classmethod
    def of(cls, **inference: object) -> "Layer":
        batch, start = scene()
        settings = {"motion_weights": "soft", "temperature": 1.0, "stop_early": False, "iterations": 2} | inference
        model = JointScanCRF.from_pretrained("simulated", features={"embedding": "dot"}, backend="eager", **settings).double()
        generator = torch.Generator().manual_seed(1)
        both = [torch.randn(*of.shape[:2], 4, generator=generator, dtype=of.dtype) for of in (batch.source, batch.target)]
        none = torch.zeros_like(batch.source[..., 0])
        given = [value.clone().requires_grad_() for value in (batch.source, batch.target, start.motions, *both, none, none)]
        source, target, motions, source_embedding, target_embedding, outlier, moving = given
        prediction = model(
            replace(batch, source=source, target=target),
            replace(start, motions=motions),
            source_embedding=source_embedding,
            target_embedding=target_embedding,
            extra_log_unary=ExtraLogUnary(outlier, moving),
        )
        leaves = {
            "points": [source, target],
            "start": [motions],
            "embeddings": [source_embedding, target_embedding],
            "outlier": [outlier],
            "moving": [moving],
            "association weights": list(model.association_weights.values()),
            "clustering weights": list(model.clustering_weights.values()),
        }
        return cls(leaves, prediction)

    def reached(self, output: Tensor) -> set[str]:
        """What the output's gradient reaches; it is finite there."""
        total = torch.where(output.isfinite(), output, 0.0).square().sum()
        found = set()
        for name, leaves in self.leaves.items():
            reached = torch.autograd.grad(total, leaves, retain_graph=True, allow_unused=True)
            slopes = [slope for slope in reached if slope is not None]
            assert all(bool(slope.isfinite().all()) for slope in slopes), name
            if any(bool((slope != 0).any()) for slope in slopes):
                found.add(name)
        return found


def test_labels_have_no_gradient() -> None:
    prediction = Layer.of().prediction
    for name in LABELS:
        value = getattr(prediction, name)
        assert not value.requires_grad, name
        assert not value.is_floating_point(), name
    assert prediction.uncertainty is not None
    for name in ("information", "directions", "unobserved_shift"):
        assert not getattr(prediction.uncertainty, name).requires_grad, name
    told = {*LABELS, "motions", "log_association", "log_cluster", "association_confidence", "cluster_confidence", "uncertainty"}
    assert {field.name for field in fields(Prediction)} == told  # nobody added an output that the README does not tell of


def test_soft_motions_pass_everything_on() -> None:
    layer = Layer.of()
    assert layer.prediction.uncertainty is not None
    outputs = (layer.prediction.motions, layer.prediction.log_association, layer.prediction.log_cluster)
    sure = (layer.prediction.association_confidence, layer.prediction.cluster_confidence, layer.prediction.uncertainty.covariance)
    for output in (*outputs, *sure):
        assert output is not None
        assert layer.reached(output) == set(layer.leaves)


def test_hard_motions_follow_the_points_alone_and_each_chain_its_own_weights() -> None:
    layer = Layer.of(motion_weights="hard", temperature=0.0)
    assert layer.reached(layer.prediction.motions) == {"points", "start"}
    assert layer.reached(layer.prediction.log_association) == {"points", "start", "outlier"} | OF_ASSOCIATION
    assert layer.reached(layer.prediction.log_cluster) == {"points", "start", "outlier"} | OF_CLUSTERING
    closed_form = Layer.of(motion_weights="hard", temperature=0.0, motion_metric="point")
    background = closed_form.prediction.motions[:, 0]  # it has points enough for a fit of its own
    assert closed_form.reached(background) == {"points"}


def test_given_motions_are_those_of_the_start() -> None:
    layer = Layer.of(motion_metric="given")
    assert layer.reached(layer.prediction.motions) == {"start"}
    assert_close(layer.prediction.motions.detach(), scene()[1].motions)


def test_detached_motions_end_the_path_to_the_other_chain() -> None:
    one_round = Layer.of(detach_motion=True, iterations=1)
    assert one_round.reached(one_round.prediction.log_cluster) == {"points", "outlier"} | OF_CLUSTERING
    assert one_round.reached(one_round.prediction.motions) >= OF_ASSOCIATION | OF_CLUSTERING


def test_max_marginals_have_finite_gradients_and_soft_motions_too() -> None:
    layer = Layer.of(temperature=0.0)
    for output in (layer.prediction.motions, layer.prediction.log_association, layer.prediction.log_cluster):
        assert layer.reached(output) >= OF_ASSOCIATION | OF_CLUSTERING


def test_flooding_has_no_gradient() -> None:
    batch, start = scene()
    model = JointScanCRF.from_pretrained("simulated", schedule="flooding", iterations=1, backend="eager").double()
    prediction = model(batch, start)
    for name in ("motions", "log_association", "log_cluster", "association_confidence", "cluster_confidence"):
        assert not getattr(prediction, name).requires_grad, name


def test_clusters_that_do_not_exist_keep_the_starts_motion() -> None:
    layer = Layer.of()
    absent = ~scene()[1].active
    assert bool(absent.any())
    assert layer.reached(layer.prediction.motions[absent]) <= {"start"}
    assert bool((layer.prediction.log_cluster[..., :-1].amax(1)[absent] == -torch.inf).all())


def test_beliefs_sum_to_one_so_their_sum_has_no_gradient() -> None:
    layer = Layer.of()
    real = scene()[0].source_mask
    for log_beliefs in (layer.prediction.log_association, layer.prediction.log_cluster):
        total = log_beliefs[real].exp().sum(-1)
        assert_close(total.detach(), torch.ones_like(total))
        weights = [*layer.leaves["association weights"], *layer.leaves["clustering weights"]]
        slopes = torch.autograd.grad(total.sum(), weights, retain_graph=True, allow_unused=True)
        assert all(slope is None or float(slope.abs()) < 1e-6 for slope in slopes)


def test_padding_is_uniform() -> None:
    pairs = [*simulate_pairs(SimulatorConfig(beams=41), 1, 1, 3), *simulate_pairs(SimulatorConfig(beams=31), 1, 1, 3)]
    batch = ScanPairBatch.collate(pairs, torch.float64)
    prediction = JointScanCRF.from_pretrained("simulated", backend="eager", iterations=1).double()(batch)
    assert bool((~batch.source_mask).any())
    for log_beliefs in (prediction.log_association[~batch.source_mask], prediction.log_cluster[~batch.source_mask]):
        assert_close(log_beliefs.detach().exp(), torch.full_like(log_beliefs, 1 / log_beliefs.shape[-1]))


def test_matching_by_beam_is_arrays_without_gradient() -> None:
    (pair,) = simulate_pairs(SimulatorConfig(beams=41), 1, 1, 3)
    answer = JointScanCRF.from_pretrained("simulated", backend="eager", iterations=1).match(pair.source, pair.target, pair.dt)
    for field in fields(PairPrediction):
        assert isinstance(getattr(answer, field.name), np.ndarray | bool), field.name


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_a_tie_is_a_kink_of_max_marginals_and_none_of_marginals(temperature: float) -> None:
    """Two equal states before a third of a chain of two nodes: one-sided slopes differ at temperature 0 alone."""

    def belief(step: float) -> Tensor:
        log_unary = torch.zeros(1, 2, 2, dtype=torch.float64)
        log_unary[0, 0, 0] = step
        log_pairwise = torch.tensor([[[[0.0, -1.0], [0.0, -2.0]]]], dtype=torch.float64)
        return chain_beliefs(log_unary, log_pairwise, torch.ones(1, 2, dtype=torch.bool), temperature)[0, 1, 0]

    ahead, back = ((belief(step) - belief(0.0)) / step for step in (1e-6, -1e-6))
    assert bool((ahead - back).abs() > 0.1) == (temperature == 0)
