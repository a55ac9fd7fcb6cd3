"""The trace of a search: the same answers, and the pool, the considered and the kept of the search that gave them."""

import numpy as np
import pytest

from torchcrf_scan import JointScanCRF, ModelConfig, Scan, ScanPair
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    return simulate_pairs(SimulatorConfig(beams=181, movers_min=1), 4, 4, 5)


def test_answers_are_those_of_match_pairs(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    for one, (other, _) in zip(model.match_pairs(pairs), model.trace_pairs(pairs, batch_size=3), strict=True):
        assert (one.association == other.association).all()
        assert (one.cluster == other.cluster).all()
        assert (one.motions == other.motions).all()


def test_a_trace_follows_hypotheses_from_the_pool_to_the_answer(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    dropped = 0
    for pair, (answer, trace) in zip(pairs, model.trace_pairs(pairs), strict=True):
        H = len(trace.motions)
        assert trace.members.shape == (H, len(pair.source))
        assert trace.members.any(1).all()
        assert trace.units.shape == (len(pair.source),)
        assert (trace.units > 0).all()
        assert trace.likely[trace.considered].all()
        assert len(set(trace.considered.tolist())) == len(trace.considered) == len(trace.kept)
        assert len(answer.motions) - 1 <= trace.kept.sum()  # every answered mover was kept; one without points is not answered
        assert (trace.accepted == trace.considered[trace.kept]).all()
        dropped += int((~trace.kept).sum())
    assert dropped > 0


def test_scans_without_points_have_an_empty_trace(model: JointScanCRF) -> None:
    empty = Scan.from_ranges([], [])
    few = Scan.from_ranges([2.0, 2.1], [0.0, 0.1])
    for pair in (ScanPair(empty, few), ScanPair(few, empty), ScanPair(few, few)):
        (_, trace) = model.trace_pairs([pair])[0]
        assert trace.motions.shape == (0, 3)
        assert trace.members.shape == (0, len(pair.source))
        assert np.isinf(trace.units).all()


def test_no_trace_where_the_loops_do_not_answer(pairs: list[ScanPair]) -> None:
    eager = JointScanCRF(ModelConfig(inference=InferenceConfig(backend="eager")))
    with pytest.raises(ValueError, match="trace: expected a model whose start and rounds the loops compute"):
        eager.trace_pairs(pairs)
