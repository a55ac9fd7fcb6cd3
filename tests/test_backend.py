"""Both engines of the rounds answer alike: batches, threads, priors, scans with hardly a point."""

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scenes import tiny_scan

from torchcrf_scan import JointScanCRF, ScanPair, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.prediction import Prediction

SCANNER = SimulatorConfig(beams=121)


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
    return JointScanCRF.from_pretrained("simulated", backend="compiled").double()


@pytest.fixture(scope="module")
def eager() -> JointScanCRF:
    return JointScanCRF.from_pretrained("simulated", backend="eager").double()


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


@torch.no_grad()
def test_both_give_the_same_answer(compiled: JointScanCRF, eager: JointScanCRF, batch: ScanPairBatch) -> None:
    found, expected = compiled(batch), eager(batch)
    assert_alike(found, expected, batch.source_mask)
    assert all(value.dtype == torch.float64 for value in (found.motions, found.log_association, found.log_cluster))
    assert not any(value.isnan().any() for value in (found.motions, found.log_association, found.association_confidence))


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


@torch.no_grad()
def test_both_start_from_the_same_search_and_go_on_from_a_given_start(
    compiled: JointScanCRF, eager: JointScanCRF, batch: ScanPairBatch
) -> None:
    found, expected = compiled.initialise(batch), eager.initialise(batch)
    for field in fields(Start):
        assert torch.equal(getattr(found, field.name), getattr(expected, field.name)), field.name
    one = batch.select(torch.tensor([0]))
    given = replace(eager.initialise(one), reach=None, log_odds=None)
    assert_alike(compiled(one, given), eager(one, given), one.source_mask)


def test_gradients_are_asked_of_tensors(batch: ScanPairBatch) -> None:
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=1).double()
    one = batch.select(torch.tensor([0]))
    model(one).log_cluster[one.source_mask].exp().sum().backward()
    assert model.clustering_weights["sequence"].grad is not None


@pytest.mark.parametrize("empty", [(0, 9), (9, 0), (0, 0)])
@torch.no_grad()
def test_an_empty_scan_is_answered_and_changes_no_other_answer(
    compiled: JointScanCRF, pairs: list[ScanPair], empty: tuple[int, int]
) -> None:
    nothing = ScanPair(*(tiny_scan(points) for points in empty))
    alone = ScanPairBatch.collate(pairs[:2], torch.float64)
    expected, found = compiled(alone), compiled(ScanPairBatch.collate([pairs[0], nothing, pairs[1]], torch.float64))
    for b, k in ((0, 0), (1, 2)):
        n = int(alone.source_mask[b].sum())
        for name in ("association", "cluster"):
            assert torch.equal(getattr(found, name)[k, :n], getattr(expected, name)[b, :n]), name
        assert torch.equal(found.motions[k], expected.motions[b])
        assert torch.equal(found.log_cluster[k, :n], expected.log_cluster[b, :n])
    assert (found.association[1] == -1).all()
    assert (found.cluster[1] == -1).all()
    assert found.active[1].tolist() == [True] + [False] * (found.active.shape[1] - 1)
    assert found.uncertainty is not None
    assert found.association_confidence is not None
    assert found.cluster_confidence is not None
    confidences = found.association_confidence[1], found.cluster_confidence[1]
    for values in (found.motions[1], found.uncertainty.covariance[1], found.uncertainty.information[1], *confidences):
        assert values.isfinite().all()
    for log in (found.log_association[1], found.log_cluster[1]):
        assert torch.allclose(log.exp().sum(-1), torch.ones_like(log[:, 0]))
    by_beam = compiled.match_pairs([pairs[0], nothing, pairs[1]])[1]
    assert by_beam.association.tolist() == [-1] * 9
    assert np.isfinite(by_beam.motions).all()
