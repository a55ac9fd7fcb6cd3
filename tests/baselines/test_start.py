"""Start + nearest neighbour: labels by hand, against plain loops, and the same for every batch."""

import math

import numpy as np
import pytest
import torch

from torchcrf_scan import JointScanCRF, ScanPair, ScanPairBatch
from torchcrf_scan.baselines.start import label_nearest, match_start, match_static
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.scan import Scan

RING = Scan.from_ranges(np.full(8, 5.0), np.linspace(-1.4, 1.4, 8))


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF().eval()


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Three pairs of different sizes."""
    return [simulate_pairs(SimulatorConfig(beams=beams), 1, 1, seed)[0] for seed, beams in enumerate((41, 61, 51))]


def make_start(batch: ScanPairBatch, motions: list[list[float]], association: list[int], active: list[bool] | None = None) -> Start:
    """The same motions and associations for every pair."""
    B = len(batch)
    mask = torch.tensor([active or [True] * len(motions)]).repeat(B, 1)
    return Start(
        torch.tensor([motions]).repeat(B, 1, 1), mask, torch.tensor([association]).repeat(B, 1), torch.zeros_like(batch.target)
    )


def shifted_pair(offsets: list[float]) -> ScanPair:
    """A wall of points 5 m ahead, one metre apart; point i of the target is `offsets[i]` further to the left."""
    left = np.arange(len(offsets)) * 1.0
    ends = left + offsets
    return ScanPair(
        Scan.from_ranges(np.hypot(5.0, left), np.arctan2(left, 5.0)), Scan.from_ranges(np.hypot(5.0, ends), np.arctan2(ends, 5.0))
    )


def test_every_point_goes_with_the_motion_that_fits_it_best() -> None:
    pair = shifted_pair([0.0, 0.0, 0.3, 0.3, 0.3, 0.6])
    batch = ScanPairBatch.collate([pair])
    start = make_start(batch, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 0.6]], [0, 1, 2, 3, -1, 5])
    found = label_nearest(batch, start).pair(0, pair)
    assert found.association.tolist() == [0, 1, 2, 3, -1, 5]
    assert found.cluster.tolist() == [0, 0, 1, 1, -1, 2]
    assert np.allclose(found.motions, [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.6]])


def test_inactive_motions_are_no_choice_and_larger_movers_come_first() -> None:
    pair = shifted_pair([0.0, 0.3, 0.6, 0.6])
    batch = ScanPairBatch.collate([pair])
    start = make_start(batch, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 0.6]], [0, 1, 2, 3])
    assert label_nearest(batch, start).pair(0, pair).cluster.tolist() == [0, 2, 1, 1]
    start = make_start(batch, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 0.6]], [0, 1, 2, 3], [True, True, False])
    assert label_nearest(batch, start).pair(0, pair).cluster.tolist() == [0, 1, 1, 1]


def test_beliefs_are_certain_and_agree_with_the_labels() -> None:
    batch = ScanPairBatch.collate([shifted_pair([0.0, 0.3, 0.0])])
    found = label_nearest(batch, make_start(batch, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]], [0, 1, -1]))
    assert found.log_association.exp().tolist() == [[[1, 0], [1, 0], [0, 1]]]
    assert found.log_cluster.exp().tolist() == [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]]
    assert found.candidates[..., 0].tolist() == [[0, 1, 0]]
    assert found.converged.all()


def test_match_start_keeps_the_motions_and_associations_of_the_start(model: JointScanCRF, pairs: list[ScanPair]) -> None:
    for pair, found in zip(pairs, match_start(model, pairs), strict=True):
        start = model.initialise(ScanPairBatch.collate([pair]))
        assert found.association.tolist() == start.association[0].tolist()  # simulated files hold valid returns only
        assert ((found.cluster < 0) == (found.association < 0)).all()
        assert np.allclose(found.motions[0], start.motions[0, 0], atol=1e-5)


def test_labels_equal_plain_loops_at_the_true_motions(
    model: JointScanCRF, pairs: list[ScanPair], monkeypatch: pytest.MonkeyPatch
) -> None:
    for pair in pairs:
        assert pair.annotation is not None
        motions = torch.from_numpy(pair.annotation.motions).float()[None]
        active = torch.ones(motions.shape[:2], dtype=torch.bool)
        batch = ScanPairBatch.collate([pair])
        start = Start(motions, active, nearest_association(batch, motions, active), torch.zeros_like(batch.target))
        monkeypatch.setattr(model, "initialise", lambda batch, start=start: start)
        cluster = np.full(len(pair.source), -1)
        for i, j in enumerate(start.association[0].tolist()):
            if j >= 0:
                ends = [se2.apply(motion, pair.source.points[i : i + 1])[0] for motion in pair.annotation.motions]
                cluster[i] = np.argmin([math.dist(end, pair.target.points[j]) for end in ends])
        found = match_start(model, [pair])[0]
        order = [k for k in range(1, len(pair.annotation.motions)) if (cluster == k).any()]
        order.sort(key=lambda k: -(cluster == k).sum())
        assert found.cluster.tolist() == [order.index(k) + 1 if k > 0 else k for k in cluster.tolist()]
        assert np.allclose(found.motions, pair.annotation.motions[[0, *order]], atol=1e-6)
        assert (cluster > 0).any()


@pytest.mark.parametrize("method", ["start", "static"])
def test_batches_do_not_matter(model: JointScanCRF, pairs: list[ScanPair], method: str) -> None:
    def run(batch_size: int) -> list:
        return match_start(model, pairs, batch_size) if method == "start" else match_static(pairs, batch_size)

    for alone, together in zip(run(1), run(2), strict=True):
        assert (alone.association == together.association).all()
        assert (alone.cluster == together.cluster).all()
        assert np.allclose(alone.motions, together.motions, atol=1e-5)


def test_match_start_uses_the_dtype_of_the_model(pairs: list[ScanPair]) -> None:
    found = match_start(JointScanCRF().double(), pairs[:1])[0]
    assert found.motions.shape[1] == 3
    assert found.converged


def test_static_keeps_everything_where_it_is() -> None:
    turned = Scan.from_ranges(RING.ranges + 1.0, RING.bearings)  # every point a metre away: beyond the gate
    same, apart = match_static([ScanPair(RING, RING), ScanPair(RING, turned)])
    assert same.association.tolist() == list(range(8))
    assert same.cluster.tolist() == [0] * 8
    assert same.motions.tolist() == [[0.0, 0.0, 0.0]]
    assert same.association_confidence.tolist() == [1.0] * 8
    assert apart.association.tolist() == apart.cluster.tolist() == [-1] * 8


def test_beams_without_a_return_and_empty_scans_have_no_partner(model: JointScanCRF) -> None:
    holes = Scan.from_ranges([5.0, np.nan, 5.0, 5.0], [0.0, 0.1, 0.2, 0.3])
    empty = Scan.from_ranges([np.nan, np.nan], [0.0, 0.1])
    pairs = [ScanPair(holes, holes), ScanPair(holes, empty), ScanPair(empty, holes)]
    for found in (match_static(pairs), match_start(model, pairs)):
        assert found[0].association.tolist() == [0, -1, 2, 3]
        assert found[0].association_confidence.tolist() == [1, 0, 1, 1]
        assert found[1].association.tolist() == [-1] * 4
        assert found[2].association.tolist() == [-1] * 2


def test_no_pairs_no_predictions(model: JointScanCRF) -> None:
    assert match_start(model, []) == match_static([]) == []
