from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.pair import pair_of_scans
from torchcrf_scan.prediction import Prediction, Uncertainty
from torchcrf_scan.scan import Annotation, Scan, ScanPair


def make_scan(ranges: list[float], **sensor: float) -> Scan:
    return Scan.from_ranges(ranges, angle_min=0.0, angle_increment=0.1, **sensor)


def make_pair(n: int, m: int, **about: object) -> ScanPair:
    return ScanPair(make_scan([1.0 + 0.1 * i for i in range(n)]), make_scan([2.0 + 0.1 * j for j in range(m)]), **about)


def annotated(source: list[float], target: list[float], **changes: object) -> ScanPair:
    """Every beam became the beam of the same number, as background; `changes` replace fields of the annotation."""
    n = len(source)
    fields = {
        "association": np.arange(n),
        "cluster": np.zeros(n, dtype=np.int64),
        "motions": np.zeros((1, 3)),
        "body": np.zeros(n, dtype=np.int64),
        "ignore": np.zeros(n, dtype=bool),
    }
    return ScanPair(make_scan(source), make_scan(target), annotation=Annotation(**(fields | changes)))


# Collating.


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=4))
def test_collate_pads_at_the_end(lengths: list[tuple[int, int]]) -> None:
    pairs = [make_pair(n, m) for n, m in lengths]
    batch = ScanPairBatch.collate(pairs, dtype=torch.float64)
    N, M = (max(1, *(length[side] for length in lengths), 1) for side in (0, 1))
    assert batch.source.shape == (len(pairs), N, 2)
    assert batch.target.shape == (len(pairs), M, 2)
    assert len(batch) == len(pairs)
    for b, pair in enumerate(pairs):
        for points, mask, scan in (
            (batch.source, batch.source_mask, pair.source),
            (batch.target, batch.target_mask, pair.target),
        ):
            assert mask[b].tolist() == [i < len(scan) for i in range(mask.shape[1])]
            assert_close(points[b, : len(scan)], scan.points)
            assert not points[b, len(scan) :].any()


def test_collate_tells_what_the_pair_tells() -> None:
    ring = Scan.from_ranges(np.ones(60), np.linspace(-3.1, 3.1, 60), range_noise=0.03)
    batch = ScanPairBatch.collate([ScanPair(ring, make_scan([1.0]), dt=0.25), make_pair(3, 3)])
    assert batch.source_closed.tolist() == [True, False]
    assert batch.target_closed.tolist() == [False, False]
    assert_close(batch.dt, [0.25, 0.1])
    assert_close(batch.range_noise[0], 0.03)
    assert_close(batch.initial_motion, torch.zeros(2, 3))
    assert_close(batch.target_origin, torch.zeros(2, 2))
    assert batch.truth is None
    assert batch.source.dtype == batch.dt.dtype == batch.range_noise.dtype == torch.float32


def test_collate_of_nothing() -> None:
    with pytest.raises(ValueError, match="pairs: expected at least one pair, got none"):
        ScanPairBatch.collate([])


def test_an_empty_scan_keeps_one_masked_point() -> None:
    empty = make_scan([np.nan, np.inf])
    batch = ScanPairBatch.collate([ScanPair(empty, empty)])
    assert batch.source.shape == batch.target.shape == (1, 1, 2)
    assert not batch.source_mask.any()
    assert not batch.target_mask.any()
    assert batch.range_noise.isfinite().all()
    assert (batch.range_noise > 0).all()


@pytest.mark.parametrize("noise", [0.0, 5e-324, 1e-12])
def test_without_noise_there_is_a_little_of_it(noise: float) -> None:
    """Of points that only rounding tells apart a covariance would be no number."""
    near = Scan(np.array([1e-200, 1e-170, 0.2, 0.7]), np.array([-1.0, -0.9, 0.0, 0.1]), np.arange(4), 4, range_noise=noise)
    assert_close(ScanPairBatch.collate([ScanPair(near, near)], dtype=torch.float64).range_noise[0], 1e-9)
    assert np.isfinite(JointScanCRF.from_pretrained().match(near, near).motions).all()


def test_one_point() -> None:
    batch = ScanPairBatch.collate([make_pair(1, 1)], dtype=torch.float64)
    assert_close(batch.source, [[[1.0, 0.0]]])
    assert_close(batch.target, [[[2.0, 0.0]]])
    assert batch.source_mask.all()


@pytest.mark.parametrize("noise", [0.005, 0.03])
def test_unknown_noise_is_estimated_from_the_ranges(noise: float) -> None:
    rng = np.random.default_rng(0)
    bearings = np.linspace(-1, 1, 721)
    source, target = (Scan.from_ranges(5 / np.cos(bearings) + noise * rng.standard_normal(721), bearings) for _ in range(2))
    estimate = ScanPairBatch.collate([ScanPair(source, target)]).range_noise
    assert noise / 1.3 < float(estimate) < noise * 1.3


def test_estimated_noise_stays_plausible() -> None:
    smooth = ScanPair(make_scan([1.0] * 20), make_scan([1.0] * 20))
    rough = ScanPair(make_scan([1.0, 9.0] * 10), make_scan([1.0, 9.0] * 10))
    assert_close(ScanPairBatch.collate([smooth, rough]).range_noise, [1e-3, 0.1])


# Annotation.


def test_truth_counts_points_where_the_annotation_counts_beams() -> None:
    nan = np.nan
    pair = annotated(
        [1.0, nan, 1.0, 1.0, 1.0],
        [nan, 2.0, 2.0, nan, 2.0, 2.0],
        association=np.array([1, -1, 5, -1, 2]),
        cluster=np.array([0, -1, 2, -1, 0]),
        motions=np.array([[0.1, 1.0, 2.0], [nan, nan, nan], [0.2, 3.0, 4.0]]),
        ignore=np.array([False, True, False, True, False]),
    )
    truth = ScanPairBatch.collate([pair], dtype=torch.float64).truth
    assert truth is not None
    assert truth.association.tolist() == [[0, 3, -1, 1]]
    assert truth.cluster.tolist() == [[0, 2, -1, 0]]
    assert truth.known.tolist() == [[True, True, False, True]]
    assert_close(truth.motions, pair.annotation.motions[None])
    assert truth.association.dtype == truth.cluster.dtype == torch.int64


def test_padding_of_the_truth() -> None:
    long = annotated([1.0] * 3, [1.0] * 3)
    short = annotated([1.0], [1.0], motions=np.full((2, 3), 0.5))
    truth = ScanPairBatch.collate([long, short], dtype=torch.float64).truth
    assert truth is not None
    assert truth.association.tolist() == [[0, 1, 2], [0, -1, -1]]
    assert truth.cluster.tolist() == [[0, 0, 0], [0, -1, -1]]
    assert truth.known.tolist() == [[True] * 3, [True, False, False]]
    assert_close(truth.motions, [[[0.0] * 3, [np.nan] * 3], [[0.5] * 3, [0.5] * 3]])


def test_truth_of_an_empty_scan() -> None:
    pair = annotated([np.nan] * 2, [1.0], association=np.full(2, -1), cluster=np.full(2, -1))
    truth = ScanPairBatch.collate([pair]).truth
    assert truth is not None
    assert truth.association.tolist() == truth.cluster.tolist() == [[-1]]
    assert truth.known.tolist() == [[False]]


def test_one_pair_without_annotation_leaves_the_batch_without() -> None:
    assert ScanPairBatch.collate([annotated([1.0], [1.0]), make_pair(1, 1)]).truth is None


# The batch as a whole.


def test_to_changes_floats_alone() -> None:
    batch = ScanPairBatch.collate([annotated([1.0, 2.0], [1.0, 2.0])]).to(torch.float64)
    assert batch.source.dtype == batch.dt.dtype == batch.initial_motion.dtype == torch.float64
    assert batch.source_mask.dtype == batch.source_closed.dtype == torch.bool
    assert batch.truth is not None
    assert batch.truth.association.dtype == torch.int64
    assert batch.truth.motions.dtype == torch.float64
    assert batch.to("cpu").source.device.type == "cpu"


def test_a_slice_is_a_batch() -> None:
    batch = ScanPairBatch.collate([annotated([1.0] * n, [1.0] * n) for n in (1, 3, 2)])
    part = batch[1:]
    assert len(part) == 2
    assert part.source.shape == (2, 3, 2)
    assert torch.equal(part.source_mask, batch.source_mask[1:])
    assert part.truth is not None
    assert torch.equal(part.truth.association, batch.truth.association[1:])
    with pytest.raises(TypeError, match="index: expected a slice, got int"):
        batch[0]


def three_pairs() -> ScanPairBatch:
    """Pairs of 1, 3 and 2 points that were seen from elsewhere, the third with a mover."""
    pairs = [annotated([1.0] * n, [1.0 + n] * n, motions=np.full((1 + (n == 2), 3), 0.1 * n)) for n in (1, 3, 2)]
    return ScanPairBatch.collate(pairs, torch.float64)


OFFSET = torch.tensor([[0.4, 3.0, -1.0], [-3.0, 0.0, 2.0], [0.0, 0.0, 0.0]], dtype=torch.float64)


def test_a_displaced_batch_is_the_same_scene() -> None:
    batch = three_pairs()
    moved = batch.displaced(OFFSET)
    assert_close(moved.target_origin, OFFSET[:, 1:])
    assert torch.equal(moved.source, batch.source)
    assert torch.equal(moved.initial_motion, batch.initial_motion)
    assert batch.truth is not None
    assert moved.truth is not None
    assert torch.equal(moved.truth.association, batch.truth.association)
    for b, n in enumerate((1, 3, 2)):
        assert_close(moved.target[b, :n], se2.apply(OFFSET[b], batch.target[b, :n]))
        assert not moved.target[b, n:].any()  # the padding stays
        assert_close(moved.truth.motions[b, 0], se2.compose(OFFSET[b], batch.truth.motions[b, 0]))
    assert moved.truth.motions[:2, 1].isnan().all()
    assert_close(moved.truth.motions[2], batch.truth.motions[2])
    assert moved.without_truth().displaced(OFFSET).truth is None


def test_displacing_back_is_no_displacement() -> None:
    batch = three_pairs()
    again = batch.displaced(OFFSET).displaced(se2.inverse(OFFSET))
    assert again.truth is not None
    assert batch.truth is not None
    for name in ("target", "target_origin"):
        assert_close(getattr(again, name), getattr(batch, name))
    assert_close(again.truth.motions, batch.truth.motions)


def test_the_origin_goes_where_the_batch_goes() -> None:
    moved = three_pairs().displaced(OFFSET)
    assert_close(moved.scaled(torch.tensor([2.0, 3.0, 4.0]).double()).target_origin, [[6.0, -2.0], [0.0, 6.0], [0.0, 0.0]])
    assert_close(moved.select(torch.tensor([1, 0])).target_origin, OFFSET[[1, 0], 1:])
    assert_close(moved[1:].target_origin, OFFSET[1:, 1:])
    assert moved.to(torch.float32).target_origin.dtype == torch.float32


def test_without_truth() -> None:
    batch = ScanPairBatch.collate([annotated([1.0], [1.0])])
    assert batch.without_truth().truth is None
    assert batch.without_truth().source is batch.source
    assert batch.truth is not None


# Predictions.


def make_prediction(association: list[int], cluster: list[int], motions: int = 4) -> Prediction:
    """A batch of two pairs of which the second is the one that matters; row k of the motions is (k, k, k)."""
    N, K = len(association), 2
    generator = torch.Generator().manual_seed(0)
    log_association = torch.randn(2, N, K + 1, generator=generator).log_softmax(-1)
    log_cluster = torch.randn(2, N, motions + 1, generator=generator).log_softmax(-1)
    return Prediction(
        association=torch.tensor([[-1] * N, association]),
        cluster=torch.tensor([[-1] * N, cluster]),
        motions=torch.arange(motions, dtype=torch.float32)[None, :, None].expand(2, -1, 3).clone().requires_grad_(),
        active=torch.ones(2, motions, dtype=torch.bool),
        candidates=torch.zeros(2, N, K, dtype=torch.int64),
        log_association=log_association.requires_grad_(),
        log_cluster=log_cluster.requires_grad_(),
        converged=torch.tensor([False, True]),
        iterations=torch.tensor([3, 3]),
    )


def test_movers_are_numbered_by_size() -> None:
    pair = make_pair(7, 7)
    answer = make_prediction([0, 1, 2, 3, 4, 5, -1], [1, 3, 3, 0, 3, 1, -1]).pair(1, pair)
    assert answer.cluster.tolist() == [2, 1, 1, 0, 1, 2, -1]
    assert answer.motions[:, 0].tolist() == [0.0, 3.0, 1.0]  # background, three points, two points; mover 2 has none
    assert answer.motions.shape == (3, 3)
    assert answer.motions.dtype == np.float64


def test_movers_of_one_size_keep_their_order() -> None:
    answer = make_prediction([0, 1, 2, 3], [3, 1, 1, 3]).pair(1, make_pair(4, 4))
    assert answer.cluster.tolist() == [2, 1, 1, 2]


def test_the_background_stays_where_nothing_is() -> None:
    answer = make_prediction([-1, -1], [-1, -1]).pair(1, make_pair(2, 2))
    assert answer.cluster.tolist() == [-1, -1]
    assert answer.motions.tolist() == [[0.0, 0.0, 0.0]]


def test_a_prediction_counts_beams() -> None:
    nan = np.nan
    pair = ScanPair(make_scan([nan, 1.0, 1.0, nan, 1.0]), make_scan([nan, nan, 2.0, nan, 2.0]))
    prediction = make_prediction([1, -1, 0, -1], [0, -1, 2, -1])  # the fourth point is padding
    answer = prediction.pair(1, pair)
    assert answer.association.tolist() == [-1, 4, -1, -1, 2]
    assert answer.cluster.tolist() == [-1, 0, -1, -1, 1]
    assert answer.association.dtype == answer.cluster.dtype == np.int64
    for confidence, log in (
        (answer.association_confidence, prediction.log_association),
        (answer.cluster_confidence, prediction.log_cluster),
    ):
        assert confidence.dtype == np.float64
        expected = log[1].detach().exp().amax(-1).tolist()
        assert confidence.tolist() == pytest.approx([0.0, expected[0], expected[1], 0.0, expected[2]])
    assert answer.converged is True
    assert prediction.pair(0, pair).converged is False


def test_the_certainty_is_numbered_like_the_motions() -> None:
    prediction = make_prediction([0] * 6, [2, 3, 3, 2, 3, 0])
    numbers = torch.arange(4.0)
    uncertainty = Uncertainty(
        covariance=(10 + numbers)[None, :, None, None].expand(2, 4, 3, 3),
        information=torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 1, 1], [1, 1, 1]]).expand(2, 4, 3),
        directions=torch.eye(3)[torch.tensor([[0, 1, 2], [0, 1, 2], [1, 0, 2], [0, 1, 2]])].expand(2, 4, 3, 3),
    )
    answer = replace(prediction, uncertainty=uncertainty).pair(1, make_pair(6, 6))
    assert answer.motions[:, 0].tolist() == [0, 3, 2]
    assert answer.covariances is not None
    assert answer.unobserved_turn is not None
    assert answer.unobserved_shift is not None
    assert answer.covariances[:, 0, 0].tolist() == [10, 13, 12]
    assert answer.covariances.shape == (3, 3, 3)
    assert answer.unobserved_turn.tolist() == [False, False, False]
    assert np.abs(answer.unobserved_shift).tolist() == [[0, 0], [0, 0], [1, 0]]
    turned = replace(prediction, cluster=torch.where(prediction.cluster == 2, 1, prediction.cluster), uncertainty=uncertainty)
    assert turned.pair(1, make_pair(6, 6)).unobserved_turn.tolist() == [False, False, True]  # type: ignore[union-attr]
    assert prediction.pair(1, make_pair(6, 6)).covariances is None


def test_given_confidences_win_over_beliefs() -> None:
    prediction = make_prediction([0, 1], [0, 0])
    sure = torch.tensor([[0.0, 0.0], [0.25, 0.75]])
    answer = replace(prediction, association_confidence=sure, cluster_confidence=1 - sure).pair(1, make_pair(2, 2))
    assert answer.association_confidence.tolist() == [0.25, 0.75]
    assert answer.cluster_confidence.tolist() == [0.75, 0.25]


def test_a_prediction_of_an_empty_scan() -> None:
    pair = ScanPair(make_scan([np.nan] * 3), make_scan([np.nan]))
    answer = make_prediction([-1], [-1]).pair(1, pair)
    assert answer.association.tolist() == answer.cluster.tolist() == [-1, -1, -1]
    assert answer.association_confidence.tolist() == [0.0, 0.0, 0.0]
    assert len(answer.motions) == 1


def test_a_guess_of_the_motion_comes_along() -> None:
    scan = Scan.from_ranges(np.full(5, 2.0), np.linspace(-1.0, 1.0, 5))
    pairs = [ScanPair(scan, scan), ScanPair(scan, scan, initial_motion=np.array([0.1, 1.0, -2.0]))]
    assert_close(ScanPairBatch.collate(pairs, torch.float64).initial_motion, [[0.0, 0.0, 0.0], [0.1, 1.0, -2.0]])


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_numbers_that_a_dtype_does_not_hold_are_refused(dtype: torch.dtype) -> None:
    beyond = 2.0 * torch.finfo(dtype).max
    near, far = Scan.from_ranges([1.0], [0.0]), Scan(np.array([beyond]), np.zeros(1), np.arange(1), 1)
    for side, pair in (("source", ScanPair(far, near)), ("target", ScanPair(near, far))):
        for make in (lambda pair: ScanPairBatch.collate([pair], dtype), lambda pair: pair_of_scans(pair, dtype)):
            with pytest.raises(ValueError, match=rf"^{side}: expected numbers of {dtype} within 1e\+06, got inf$"):
                make(pair)
    with pytest.raises(ValueError, match=r"^dt: expected numbers of torch.float16 within 1e\+09, got inf$"):
        ScanPairBatch.collate([ScanPair(near, near, dt=1e6)], torch.float16)


def test_a_scan_made_by_hand_is_no_farther_than_one_that_was_read() -> None:
    near, far = Scan.from_ranges([1.0], [0.0]), Scan(np.array([1e20]), np.zeros(1), np.arange(1), 1)
    for make in (lambda pair: ScanPairBatch.collate([pair]), lambda pair: pair_of_scans(pair, torch.float64)):
        with pytest.raises(ValueError, match=r"^target: expected numbers of torch.float\d\d within 1e\+06, got 1"):
            make(ScanPair(near, far))
