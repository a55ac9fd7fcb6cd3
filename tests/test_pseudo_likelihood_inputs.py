"""The pseudo-likelihood inside a larger network: embeddings, log potentials and an encoder are scored and learned."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from support import assert_close, normal
from torch import Tensor

from torchcrf_scan import ClusteringCRF, ExtraLogUnary, FeatureConfig, InferenceConfig, JointScanCRF, MatchingCRF, ModelConfig
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import EncoderConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.inference.pseudo_likelihood import clustering_chain, true_plugins
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.objectives import labelled_chains, make_objective
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.learning.settings import Config, GradientConfig, LearningConfig
from torchcrf_scan.search.pairs import survey
from torchcrf_scan.variants.lattice_likelihood import lattice_chain

SIZE = 3
ENCODER = EncoderConfig(width=8, dilations=(1, 2), embedding=SIZE)
COUPLINGS = ("motions", "lattice")


@pytest.fixture(scope="module")
def batch() -> ScanPairBatch:
    """Two annotated pairs of different sizes."""
    return ScanPairBatch.collate([simulate_pairs(SimulatorConfig(beams=b), 1, 1, b)[0] for b in (31, 25)], torch.float64)


def make_model(
    embedding: str = "none",
    coupling: str = "motions",
    layer: type[JointScanCRF] = JointScanCRF,
    encoder: EncoderConfig | None = None,
) -> JointScanCRF:
    """Small, with weights that let every input matter; a given encoder says something of every point."""
    torch.manual_seed(0)
    features, inference = FeatureConfig(embedding=embedding, stumps=4), InferenceConfig(clusters=4, candidates=3)
    encoder = encoder or EncoderConfig()
    model = layer(ModelConfig(coupling=coupling, features=features, inference=inference, encoder=encoder))
    with torch.no_grad():
        model.association_weights["data_boosting"].fill_(0.5)
        if model.encoder is not None:
            torch.nn.init.normal_(model.encoder.last.weight)
    return model.double()


def embeddings(batch: ScanPairBatch) -> dict[str, Tensor]:
    shapes = {"source_embedding": batch.source_mask.shape, "target_embedding": batch.target_mask.shape}
    return {name: normal(*shape, SIZE, seed=k) for k, (name, shape) in enumerate(shapes.items())}


def logits(batch: ScanPairBatch) -> ExtraLogUnary:
    return ExtraLogUnary(*(normal(*batch.source_mask.shape, seed=seed) for seed in (5, 6)))


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_inputs_that_say_nothing_change_nothing(batch: ScanPairBatch, coupling: str) -> None:
    expected = make_model(coupling=coupling).pseudo_log_likelihood(batch)
    model = make_model("dot", coupling)
    assert_close(model.pseudo_log_likelihood(batch).detach(), expected.detach())
    silent = {name: torch.zeros_like(value) for name, value in embeddings(batch).items()}
    none = torch.zeros_like(batch.source[..., 0])
    found = model.pseudo_log_likelihood(batch, **silent, extra_log_unary=ExtraLogUnary(none, none))
    assert_close(found.detach(), expected.detach())


@pytest.mark.parametrize("layer", [JointScanCRF, MatchingCRF, ClusteringCRF])
def test_log_potentials_are_nats(batch: ScanPairBatch, layer: type[JointScanCRF]) -> None:
    model, given = make_model(layer=layer), logits(batch)
    expected = torch.zeros(2, dtype=torch.float64)
    for name, chain, weights in labelled_chains(model, Portion(batch), LearningConfig()):
        design = chain.design()
        score = (design.features @ weights).masked_fill(~design.mask, -torch.inf)
        score[..., -1] += given.outlier
        if name == "cluster":
            score[..., 1:-1] += given.moving[..., None]
        chosen = torch.log_softmax(score, -1).gather(-1, design.label[..., None])[..., 0]
        expected = expected + torch.where(design.known, chosen, 0.0).sum(-1)
    assert_close(model.pseudo_log_likelihood(batch, extra_log_unary=given).detach(), expected.detach())


def test_log_potentials_of_the_lattice_are_those_of_both_labels(batch: ScanPairBatch) -> None:
    model, given = make_model(coupling="lattice"), logits(batch)
    ((_, chain, weights),) = labelled_chains(model, Portion(batch), LearningConfig())
    design, (A, D) = chain.design(), chain.mask.shape[2:]
    score = (design.features @ weights).masked_fill(~design.mask, -torch.inf)
    for state in range(A * D):
        j, k = divmod(state, D)
        score[..., state] += given.outlier * ((j == A - 1) + (k == D - 1)) + given.moving * (0 < k < D - 1)
    chosen = torch.log_softmax(score, -1).gather(-1, design.label[..., None])[..., 0]
    expected = torch.where(design.known, chosen, 0.0).sum(-1)
    assert_close(model.pseudo_log_likelihood(batch, extra_log_unary=given).detach(), expected.detach())


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_the_exact_likelihood_hears_of_them_too(batch: ScanPairBatch, coupling: str) -> None:
    """An extra potential shifts the score of the truth and log Z: its gradient is truth minus belief."""
    model, given = make_model(coupling=coupling), logits(batch)
    outlier = given.outlier.requires_grad_()
    view = model.view(batch, model.learned_inputs(batch, extra_log_unary=ExtraLogUnary(outlier, given.moving)))
    other = replace(view, learned=None)
    plugins = true_plugins(view.batch, 3)
    weights = model.fitted.clustering if coupling == "motions" else torch.cat(model.weight_vectors)

    def value(of: Any) -> Tensor:
        if coupling == "motions":
            return clustering_chain(of, plugins, model.scales).log_likelihood(weights)
        return lattice_chain(of, plugins, model.scales, model.boosters, model.config.inference).log_likelihood(weights)

    assert not torch.allclose(value(view), value(other))
    value(view).sum().backward()
    assert outlier.grad is not None
    assert (outlier.grad.abs() <= 2).all()
    assert outlier.grad[batch.source_mask].any()
    assert not outlier.grad[~batch.source_mask].any()


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("embedding", ["dot", "cosine"])
def test_gradients_equal_differences(coupling: str, embedding: str) -> None:
    small = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=9), 1, 1, 4), torch.float64)
    model, given = make_model(embedding, coupling), logits(small)
    inputs = [value.requires_grad_() for value in (*embeddings(small).values(), given.outlier, given.moving)]

    def value(source: Tensor, target: Tensor, outlier: Tensor, moving: Tensor) -> Tensor:
        extra = ExtraLogUnary(outlier, moving)
        return model.pseudo_log_likelihood(small, source_embedding=source, target_embedding=target, extra_log_unary=extra)

    assert torch.autograd.gradcheck(value, inputs)
    value(*inputs).sum().backward()
    for name in ("embedding", "embedding_data"):
        slope = model.association_weights[name].grad
        assert slope is not None
        assert slope != 0


# --- the encoder --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_an_encoder_is_what_could_have_been_given(batch: ScanPairBatch, coupling: str) -> None:
    model, plain = make_model("dot", coupling, encoder=ENCODER), make_model("dot", coupling)
    assert model.encoder is not None
    encoded = model.encoder(batch, model.initialise(batch))
    both = {"source_embedding": encoded.source_embedding, "target_embedding": encoded.target_embedding}
    expected = plain.pseudo_log_likelihood(batch, **both, extra_log_unary=encoded.extra).detach()
    assert_close(model.pseudo_log_likelihood(batch).detach(), expected)
    still = Start.at(batch, torch.zeros(2, 1, 3, dtype=torch.float64), torch.ones(2, 1, dtype=torch.bool))
    assert not torch.allclose(model.pseudo_log_likelihood(batch, start=still).detach(), expected)


@pytest.mark.parametrize("surveyed", [True, False])
@pytest.mark.parametrize("name", ["pseudo_likelihood", "likelihood"])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_first_order_steps_train_the_whole_encoder(batch: ScanPairBatch, coupling: str, name: str, surveyed: bool) -> None:
    model = make_model("dot", coupling, encoder=ENCODER)
    config = Config(model=model.config, gradient=GradientConfig(objective=name))
    make_objective(config)(model, Portion(batch, tuple(survey(batch)) if surveyed else (), 0))["total"].backward()
    assert model.encoder is not None
    for of, parameter in model.encoder.named_parameters():
        assert parameter.grad is not None, of
        assert parameter.grad.isfinite().all(), of
        assert parameter.grad.any(), of


def test_without_an_encoder_no_start_is_looked_for(batch: ScanPairBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(JointScanCRF, "initialise", lambda *_: pytest.fail("a search"))
    assert make_model().pseudo_log_likelihood(batch).isfinite().all()


def test_flooding_does_not_take_them(batch: ScanPairBatch) -> None:
    model = JointScanCRF(ModelConfig(inference=InferenceConfig(schedule="flooding"))).double()
    with pytest.raises(ValueError, match="schedule: expected sweep with embeddings"):
        model.pseudo_log_likelihood(batch, extra_log_unary=logits(batch))
