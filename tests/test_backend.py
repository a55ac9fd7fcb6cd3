"""Which code answers, and that both answer alike: batches, threads, priors, scans with hardly a point."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcrf_scan import JointScanCRF, Scan, ScanPair, ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.fast.choice import can_decode, can_search, is_numba_installed
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.material import collect
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.prediction import Prediction

needs_numba = pytest.mark.skipif(not is_numba_installed(), reason="needs numba, the extra fast")
POINTS = torch.zeros(1, 3, 2)
SCANNER = SimulatorConfig(beams=121)


def tiny_scan(points: int) -> Scan:
    bearings = np.linspace(-0.5, 0.5, 9)
    return Scan.from_ranges(np.where(np.arange(9) < points, 4.0, np.inf), bearings)


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Three streets, one seen with odometry, and pairs of 1 and 2 points."""
    streets = simulate_pairs(SCANNER, 3, 3, 70)
    assert streets[0].annotation is not None
    known = replace(streets[0], initial_motion=streets[0].annotation.motions[0] + [0.004, 0.03, -0.02])
    bare = [replace(pair, annotation=None) for pair in (*streets, known)]
    return [*bare, ScanPair(tiny_scan(1), tiny_scan(2)), ScanPair(tiny_scan(9), tiny_scan(2))]


@pytest.fixture(scope="module")
def batch(pairs: list[ScanPair]) -> ScanPairBatch:
    return ScanPairBatch.collate(pairs, torch.float64)


@pytest.fixture(scope="module")
def compiled() -> JointScanCRF:
    return JointScanCRF.from_pretrained(backend="compiled").double()


@pytest.fixture(scope="module")
def eager() -> JointScanCRF:
    return JointScanCRF.from_pretrained(backend="eager").double()


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def assert_alike(found: Prediction, expected: Prediction, mask: torch.Tensor) -> None:
    """The same of every real point; motions and beliefs to rounding."""
    assert torch.equal(found.association, expected.association.masked_fill(~mask, -1))
    assert torch.equal(found.cluster, expected.cluster.masked_fill(~mask, -1))
    assert torch.equal(found.active, expected.active)
    assert torch.equal(found.iterations, expected.iterations)
    assert torch.equal(found.converged, expected.converged)
    turn, shift = se2.distance(found.motions, expected.motions)
    assert float(turn[expected.active].max()) < 1e-5
    assert float(shift[expected.active].max()) < 1e-4
    for name in ("log_association", "log_cluster", "association_confidence", "cluster_confidence"):
        of_found, of_expected = (getattr(prediction, name)[mask] for prediction in (found, expected))
        assert torch.allclose(of_found, of_expected, atol=1e-3), name
    assert found.uncertainty is not None
    assert expected.uncertainty is not None
    assert torch.equal(found.uncertainty.degenerate[expected.active], expected.uncertainty.degenerate[expected.active])


@needs_numba
@torch.no_grad()
def test_both_give_the_same_answer(compiled: JointScanCRF, eager: JointScanCRF, batch: ScanPairBatch) -> None:
    found, expected = compiled(batch), eager(batch)
    assert_alike(found, expected, batch.source_mask)
    assert all(value.dtype == torch.float64 for value in (found.motions, found.log_association, found.log_cluster))
    assert not any(value.isnan().any() for value in (found.motions, found.log_association, found.association_confidence))


@needs_numba
@torch.no_grad()
def test_a_batch_is_a_loop_whatever_the_threads(compiled: JointScanCRF, batch: ScanPairBatch, two_threads: None) -> None:
    together = compiled(batch)
    for b in range(len(batch)):
        alone = compiled(batch.select(torch.tensor([b])))
        n = int(batch.source_mask[b].sum())
        assert torch.equal(alone.association[0, :n], together.association[b, :n])
        assert torch.equal(alone.cluster[0, :n], together.cluster[b, :n])
        assert torch.equal(alone.motions[0], together.motions[b])
        assert torch.equal(alone.log_cluster[0, :n], together.log_cluster[b, :n])


@needs_numba
@torch.no_grad()
def test_both_start_alike_and_go_on_from_a_given_start(compiled: JointScanCRF, eager: JointScanCRF, batch: ScanPairBatch) -> None:
    found, expected = compiled.initialise(batch), eager.initialise(batch)
    assert torch.equal(found.active, expected.active)
    assert torch.equal(found.association, expected.association)
    assert found.reach is not None
    assert expected.reach is not None
    assert torch.equal(found.reach[batch.source_mask], expected.reach[batch.source_mask])
    assert torch.allclose(found.motions, expected.motions, atol=1e-5)
    assert torch.allclose(found.target_tangents, expected.target_tangents)
    assert_alike(compiled(batch, expected), eager(batch, expected), batch.source_mask)


@needs_numba
def test_gradients_are_asked_of_tensors(batch: ScanPairBatch) -> None:
    model = JointScanCRF.from_pretrained(motion_weights="soft", iterations=1).double()
    one = batch.select(torch.tensor([0]))
    model(one).log_cluster[one.source_mask].exp().sum().backward()
    assert model.clustering_weights["sequence"].grad is not None


@needs_numba
def test_learning_looks_at_pairs_with_either() -> None:
    pairs = simulate_pairs(SCANNER, 2, 2, 71)
    config = LearningConfig(disturbance=0.0)
    found, expected = (collect(pairs, config, backend=backend) for backend in ("compiled", "eager"))
    for one, other in zip(found.surveys, expected.surveys, strict=True):
        assert one is not None
        assert other is not None
        assert torch.allclose(one.background, other.background, atol=1e-4)
        assert torch.equal(one.hypotheses.members, other.hypotheses.members)
        assert torch.allclose(one.features, other.features, atol=2e-2)


@needs_numba
@torch.no_grad()
def test_an_empty_scan_is_left_to_tensors(compiled: JointScanCRF, pairs: list[ScanPair]) -> None:
    batch = ScanPairBatch.collate([pairs[0], ScanPair(tiny_scan(0), tiny_scan(9))], torch.float64)
    prediction = compiled(batch)
    assert (prediction.association[1] == -1).all()
    assert prediction.motions.isfinite().all()


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (ModelConfig(inference=InferenceConfig(schedule="flooding", backend="compiled")), "schedule: flooding"),
        (ModelConfig(inference=InferenceConfig(temperature=1.0, backend="compiled")), "temperature: 1.0"),
        (ModelConfig(coupling="lattice", inference=InferenceConfig(backend="compiled")), "coupling: lattice"),
        (ModelConfig(chains="matching", inference=InferenceConfig(backend="compiled")), "chains: matching"),
    ],
)
def test_what_is_not_compiled_is_said(config: ModelConfig, reason: str) -> None:
    with pytest.raises(ValueError, match=f"backend: expected for compiled .*{reason}"):
        can_decode(config, POINTS, needs_gradient=False)
    automatic = replace(config, inference=replace(config.inference, backend="auto"))
    assert not can_decode(automatic, POINTS, needs_gradient=False)


def test_without_numba_tensors_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchcrf_scan.fast.choice.is_numba_installed", lambda: False)
    assert not can_search("auto", POINTS)
    assert not can_decode(ModelConfig(), POINTS, needs_gradient=False)
    with pytest.raises(ValueError, match="backend: expected for compiled numba"):
        can_search("compiled", POINTS)


def test_a_gradient_needs_tensors() -> None:
    assert not can_decode(ModelConfig(), POINTS, needs_gradient=True)
    with pytest.raises(ValueError, match="no gradient"):
        can_decode(ModelConfig(inference=InferenceConfig(backend="compiled")), POINTS, needs_gradient=True)
