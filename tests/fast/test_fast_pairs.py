"""Whole pairs through the loops: by beam and as tensors, alone and together, with and without an encoder."""

import numpy as np
import pytest
import torch
from scenes import tiny_scan

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig

SINGLE = 1e-5  # of numbers that went through tensors in single precision; covariances and angles of their order


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Two streets and a closed scan, and pairs of hardly a point or none."""
    scanners = SimulatorConfig(beams=121, movers_min=2), SimulatorConfig(beams=181, fov=360.0)
    seen = [*simulate_pairs(scanners[0], 2, 2, 70), *simulate_pairs(scanners[1], 1, 1, 71)]
    tiny = [ScanPair(tiny_scan(n), tiny_scan(m)) for n, m in ((1, 2), (9, 2), (9, 0), (0, 9))]
    return [*seen, *tiny]


@pytest.fixture(scope="module", params=["simulated", "encoder"])
def model(request: pytest.FixtureRequest) -> JointScanCRF:
    return JointScanCRF.from_pretrained(request.param)


def assert_same_prediction(found: PairPrediction, expected: PairPrediction) -> None:
    """Labels equal, the rest to single precision."""
    assert found.association.tolist() == expected.association.tolist()
    assert found.cluster.tolist() == expected.cluster.tolist()
    assert found.converged == expected.converged
    for name in ("motions", "association_confidence", "cluster_confidence"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=SINGLE, atol=SINGLE, err_msg=name)


def test_match_is_forward_by_beam(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    """`match` never makes a tensor of what `forward` pads; the numbers are the same."""
    with torch.no_grad():
        prediction = model(ScanPairBatch.collate(pairs))
    for b, (pair, found) in enumerate(zip(pairs, model.match_pairs(pairs), strict=True)):
        assert_same_prediction(found, prediction.pair(b, pair))
    alone = model.match(pairs[0].source, pairs[0].target, pairs[0].dt)
    assert_same_prediction(alone, prediction.pair(0, pairs[0]))
    assert len(alone.association) == pairs[0].source.n_beams


def test_batches_of_any_size_give_the_same(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    together = model.match_pairs(pairs)
    for size in (1, 2):
        for found, expected in zip(model.match_pairs(pairs, size), together, strict=True):
            assert_same_prediction(found, expected)


def test_some_points_move(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    found = model.match_pairs(pairs[:3])
    assert sum((of.cluster > 0).sum() for of in found) > 5
    assert sum((of.association >= 0).sum() for of in found) > 200
