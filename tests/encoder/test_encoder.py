"""The encoder and the model that has one: nothing before it has learned, what it says afterwards, saved and compiled."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support import assert_close, normal

from torchcrf_scan import JointScanCRF, ScanPairBatch
from torchcrf_scan.config import EncoderConfig, FeatureConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.encoder.encoder import ScanEncoder, unroll
from torchcrf_scan.export import UnrolledDecoder, decoder_inputs
from torchcrf_scan.features.learned import ExtraLogUnary
from torchcrf_scan.learning.checkpoint import load_weights
from torchcrf_scan.learning.objectives import make_objective
from torchcrf_scan.learning.portions import as_portion
from torchcrf_scan.learning.settings import Config, GradientConfig, LearningConfig
from torchcrf_scan.model import with_config
from torchcrf_scan.scan import ScanPair

SMALL = EncoderConfig(width=8, dilations=(1, 2))


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    return simulate_pairs(SimulatorConfig(beams=91), 2, 2, 70)


@pytest.fixture(scope="module")
def batch(pairs: list[ScanPair]) -> ScanPairBatch:
    return ScanPairBatch.collate(pairs)


def with_encoder(encoder: EncoderConfig = SMALL, *, embedding: str = "none", backend: str = "auto") -> JointScanCRF:
    """The shipped model with an encoder that has learned nothing."""
    shipped = JointScanCRF.from_pretrained("simulated", backend=backend)
    torch.manual_seed(0)
    model = JointScanCRF(replace(shipped.config, encoder=encoder, features=replace(shipped.config.features, embedding=embedding)))
    load_weights(model, shipped)
    return model.eval()


def loud(model: JointScanCRF) -> JointScanCRF:
    """The same, its encoder saying something of every point."""
    assert model.encoder is not None
    torch.nn.init.normal_(model.encoder.last.weight, generator=torch.Generator().manual_seed(1))
    return model


# --- the network --------------------------------------------------------------------------------------------------------------


def test_a_closed_scan_goes_on_round_and_an_open_one_ends() -> None:
    values = torch.tensor([[1.0, 2.0, 3.0, 9.0]])[..., None].expand(2, -1, -1)
    mask = torch.tensor([[True, True, True, False]]).expand(2, -1)
    found = unroll(values, mask, torch.tensor([True, False]), 2)[..., 0]
    assert found[0].tolist() == [2, 3, 1, 2, 3, 1, 2, 3]
    assert found[1].tolist() == [0, 0, 1, 2, 3, 0, 0, 0]


def test_a_closed_scan_has_no_first_point() -> None:
    encoder = loud(with_encoder()).encoder
    assert encoder is not None
    inputs, mask = normal(1, 20, 24).float(), torch.ones(1, 20, dtype=torch.bool)
    closed = torch.tensor([True])
    assert_close(encoder.encode(inputs.roll(7, 1), mask, closed), encoder.encode(inputs, mask, closed).roll(7, 1))


def test_padding_is_invisible() -> None:
    encoder = loud(with_encoder()).encoder
    assert encoder is not None
    inputs = normal(2, 20, 24).float()
    mask = torch.arange(20) < torch.tensor([[20], [13]])
    closed = torch.tensor([False, True])
    together = encoder.encode(inputs, mask, closed)
    assert_close(encoder.encode(inputs[1:, :13], mask[1:, :13], closed[1:])[0], together[1, :13])


# --- the model ----------------------------------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("backend", ["eager", "auto"])
def test_before_it_has_learned_it_says_nothing(batch: ScanPairBatch, backend: str) -> None:
    expected, found = JointScanCRF.from_pretrained("simulated", backend=backend)(batch), with_encoder(backend=backend)(batch)
    assert torch.equal(found.association, expected.association)
    assert torch.equal(found.cluster, expected.cluster)
    assert_close(found.motions, expected.motions)


@torch.no_grad()
def test_what_it_says_is_what_could_have_been_given(batch: ScanPairBatch) -> None:
    model, plain = loud(with_encoder(backend="eager")), JointScanCRF.from_pretrained("simulated", backend="eager")
    start = plain.initialise(batch)
    assert model.encoder is not None
    extra = model.encoder(batch, start, "eager").extra
    found, expected = model(batch, start), plain(batch, start, extra_log_unary=extra)
    assert torch.equal(found.cluster, expected.cluster)
    assert_close(found.log_cluster, expected.log_cluster)
    more = ExtraLogUnary(outlier=torch.ones_like(extra.outlier))
    both = plain(batch, start, extra_log_unary=extra.plus(more))
    assert_close(model(batch, start, extra_log_unary=more).log_cluster, both.log_cluster)
    assert not torch.equal(found.cluster, plain(batch, start).cluster)


@torch.no_grad()
def test_compiled_code_listens_to_it(batch: ScanPairBatch) -> None:
    found, expected = (loud(with_encoder(backend=backend)).double()(batch.to(torch.float64)) for backend in ("compiled", "eager"))
    assert torch.equal(found.association, expected.association.masked_fill(~batch.source_mask, -1))
    assert torch.equal(found.cluster, expected.cluster.masked_fill(~batch.source_mask, -1))
    assert_close(found.log_cluster[batch.source_mask], expected.log_cluster[batch.source_mask], tolerance=1e-4)


def test_gradients_reach_it(batch: ScanPairBatch) -> None:
    model = loud(with_encoder(replace(SMALL, embedding=4), embedding="cosine"))
    model(batch, model.initialise(batch)).log_association[batch.source_mask].exp().square().sum().backward()
    assert model.encoder is not None
    for name, parameter in model.encoder.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
    assert bool((model.encoder.last.weight.grad[2:] != 0).any())  # of the embedding


def test_it_is_saved_with_the_model(batch: ScanPairBatch, tmp_path: Path) -> None:
    model = loud(with_encoder())
    model.save_pretrained(tmp_path)
    with torch.no_grad():
        assert torch.equal(JointScanCRF.from_pretrained(tmp_path)(batch).log_cluster, model(batch).log_cluster)


@torch.no_grad()
def test_it_is_part_of_the_program_for_other_runtimes(batch: ScanPairBatch) -> None:
    model = loud(with_encoder(backend="eager"))
    start = model.initialise(batch)
    answers = UnrolledDecoder(model, 1)(**decoder_inputs(batch, start))
    inference = replace(model.config.inference, stop_early=False, iterations=1)
    expected = with_config(model, replace(model.config, inference=inference))(batch, start)
    assert_close(answers["log_cluster"], expected.log_cluster)
    quiet = UnrolledDecoder(with_encoder(backend="eager"), 1)(**decoder_inputs(batch, start))
    assert not torch.allclose(answers["log_cluster"], quiet["log_cluster"])


def test_what_cannot_be() -> None:
    with pytest.raises(ValueError, match=r"encoder\.width: expected a whole number in \[0, 1024\], got -1"):
        EncoderConfig(width=-1)
    with pytest.raises(ValueError, match=r"features\.embedding: expected dot or cosine for an encoder"):
        ModelConfig(encoder=EncoderConfig(width=4, embedding=2))
    model = with_encoder(replace(SMALL, embedding=4), embedding="dot")
    batch = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=31), 1, 1, 3))
    with pytest.raises(ValueError, match="source_embedding: expected none for a model whose encoder"):
        model(batch, source_embedding=batch.source, target_embedding=batch.target)


# --- learning -----------------------------------------------------------------------------------------------------------------


def test_it_learns_with_the_weights(pairs: list[ScanPair]) -> None:
    config = Config(
        model=ModelConfig(encoder=SMALL, features=FeatureConfig()),
        learning=LearningConfig(predicted_share=0.5),
        gradient=GradientConfig(objective="likelihood"),
    )
    objective, portion, model = make_objective(config), as_portion(pairs), with_encoder()
    optimiser = torch.optim.Adam(model.parameters(), lr=0.01)
    losses = []
    for _ in range(12):
        terms = objective(model, portion)
        losses.append(float(terms["total"].detach()))
        assert_close(terms["total"], terms["association"] + terms["cluster"])
        optimiser.zero_grad()
        terms["total"].backward()
        optimiser.step()
    assert losses[-1] < 0.98 * losses[0]
    assert model.encoder is not None
    assert bool((model.encoder.last.weight[:2] != 0).any())
    assert isinstance(model.encoder, ScanEncoder)


# --- the shipped one ----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_the_shipped_one_tells_more_outliers(batch: ScanPairBatch, pairs: list[ScanPair]) -> None:
    encoded, plain = JointScanCRF.from_pretrained("encoder"), JointScanCRF.from_pretrained("simulated")
    assert encoded.encoder is not None
    assert plain.encoder is None
    assert batch.truth is not None
    said = encoded.encoder(batch, encoded.initialise(batch)).extra.outlier
    assert said is not None
    known, is_outlier = batch.truth.known, batch.truth.association < 0
    outlier, inlier = said[known & is_outlier], said[known & ~is_outlier]
    assert outlier.mean() > inlier.mean() + 0.5
