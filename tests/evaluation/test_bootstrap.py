import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_pairs import make_pair, make_small, no_movers, perfect, perturbed, random_labels

from torchcrf_scan.evaluation.bootstrap import Difference, by_blocks, by_sequence, intervals, paired_intervals
from torchcrf_scan.evaluation.metrics import PairScore, score_pair
from torchcrf_scan.evaluation.summary import summarise

SHARES = ("association_within_2", "association_accuracy", "cluster_accuracy", "iou_moving", "movers_found", "ego_success")
LABELS = ("accuracy", "sed2", "outliers_found", "outliers_true", "recall_skipped")  # the paper's Tables I and II
KEYS = {*SHARES, *(f"{of}_{name}" for of in ("association", "cluster") for name in LABELS), "motion_rotation", "motion_translation"}
SEQUENCES = ("garage", "garage", "street", "street", "street", "yard")

names = st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=30)


def two_methods(pairs: int, seed: int = 0) -> tuple[list[PairScore], list[PairScore]]:
    """A decent method and a poor one on the same pairs of two sequences, some of them without movers or true ego motion."""
    rng = np.random.default_rng(seed)
    ours, theirs = [], []
    for i in range(pairs):
        pair = make_pair(int(rng.integers(0, 40)), 30, int(rng.integers(0, 4)), rng, drop=0.1)
        for scores, predict in ((ours, perturbed), (theirs, random_labels if i % 2 else no_movers)):
            changes = {"name": str(i), "sequence": f"s{i % 2}", "has_ego_truth": i % 3 > 0}
            scores.append(dataclasses.replace(score_pair(pair, predict(pair, rng)), **changes))
    return ours, theirs


def with_right(right: Sequence[int], sequences: Sequence[str]) -> list[PairScore]:
    """Pairs of eleven points of which these many have a right cluster."""
    score = score_pair(make_small(), perfect(make_small()))
    return [
        dataclasses.replace(score, cluster=dataclasses.replace(score.cluster, right=int(n)), sequence=name)
        for n, name in zip(right, sequences, strict=True)
    ]


def is_sum_of_runs(counts: list[int], block: int, runs: int) -> bool:
    """Whether counts are `runs` runs of length `block`: from the left, each count not yet explained must begin as many."""
    left = list(counts)
    for i in range(len(left)):
        if left[i] < 0 or (left[i] and i + block > len(left)):
            return False
        runs -= left[i]
        left[i : i + block] = [n - left[i] for n in left[i : i + block]]
    return runs == 0


def is_drawn_in_blocks(counts: list[int], block: int) -> bool:
    """Whether counts of a sequence are whole blocks and, for the rest of its length, the first pairs of one more."""
    block = min(block, len(counts))
    whole, rest = divmod(len(counts), block)
    starts = range(len(counts) - block + 1) if rest else [0]
    return any(is_sum_of_runs([n - (s <= i < s + rest) for i, n in enumerate(counts)], block, whole) for s in starts)


def test_the_block_oracle() -> None:
    assert is_drawn_in_blocks([1, 2, 1, 0], 2)  # 0-1 and 1-2
    assert is_drawn_in_blocks([2, 2, 0, 0], 2)
    assert not is_drawn_in_blocks([1, 0, 2, 1], 2)
    assert not is_drawn_in_blocks([4, 0, 0, 0], 2)
    assert is_drawn_in_blocks([1, 1, 1, 0, 2], 3) is False
    assert is_drawn_in_blocks([1, 2, 2, 0, 0], 3)  # 0-2, then 1-2 of 1-3


@given(names, st.integers(0, 1000))
def test_sequences_are_drawn_whole(sequences: list[str], seed: int) -> None:
    weights = by_sequence(sequences, 20, seed)
    assert weights.shape == (20, len(sequences))
    first = [sequences.index(name) for name in sequences]
    np.testing.assert_array_equal(weights, weights[:, first])
    assert (weights[:, sorted(set(first))].sum(axis=1) == len(set(sequences))).all()


@given(names, st.integers(1, 7), st.integers(0, 1000))
def test_blocks_keep_the_length_of_every_sequence_and_come_in_runs(sequences: list[str], block: int, seed: int) -> None:
    weights = by_blocks(sequences, block, 5, seed)
    assert weights.shape == (5, len(sequences))
    for name in set(sequences):
        of_name = weights[:, [i for i, other in enumerate(sequences) if other == name]]
        assert (of_name.sum(axis=1) == of_name.shape[1]).all()
        assert all(is_drawn_in_blocks(counts, block) for counts in of_name.tolist())


def test_every_block_and_sequence_is_drawn_about_as_often() -> None:
    blocks = by_blocks(["a"] * 4, 2, 20_000)
    np.testing.assert_allclose(blocks.mean(axis=0), [2 / 3, 4 / 3, 4 / 3, 2 / 3], atol=0.03)
    np.testing.assert_allclose(by_sequence(SEQUENCES, 20_000).mean(axis=0), 1.0, atol=0.03)


def test_a_sequence_not_longer_than_a_block_never_varies() -> None:
    assert (by_blocks(SEQUENCES, 3, 50) == 1).all()
    assert not (by_blocks(SEQUENCES, 1, 50) == 1).all()


def test_equal_seeds_give_equal_draws() -> None:
    np.testing.assert_array_equal(by_blocks(SEQUENCES, 2, 9, 3), by_blocks(SEQUENCES, 2, 9, 3))
    np.testing.assert_array_equal(by_sequence(SEQUENCES, 9, 3), by_sequence(SEQUENCES, 9, 3))
    assert (by_sequence(SEQUENCES, 9, 3) != by_sequence(SEQUENCES, 9, 4)).any()


@given(st.integers(1, 12), st.integers(0, 1000))
def test_values_and_differences_are_those_of_the_summaries(pairs: int, seed: int) -> None:
    ours, theirs = two_methods(pairs, seed)
    weights = by_blocks([score.sequence for score in ours], 2, 10)
    our, their = summarise(ours), summarise(theirs)
    differences, values = paired_intervals(ours, theirs, weights), intervals(ours, weights)
    assert set(differences) == set(values) == KEYS
    for key in KEYS:
        assert differences[key].value == pytest.approx(our[key] - their[key], abs=1e-9, nan_ok=True)
        assert values[key].value == pytest.approx(our[key], abs=1e-9, nan_ok=True)
        assert not values[key].low > values[key].high


def test_levels_are_resampled_like_the_pairs() -> None:
    """A resample without any correct object says nothing of its errors, and is left out."""
    ours, _ = two_methods(6)
    weights = np.array([[2, 0, 1, 3, 0, 0], [0, 1, 0, 0, 2, 1], [1, 1, 1, 1, 1, 1]])
    drawn = [[i for i, n in enumerate(row) for _ in range(n)] for row in weights]
    for key, interval in intervals(ours, weights).items():
        low, high = np.nanpercentile([summarise([ours[i] for i in row])[key] for row in drawn], [2.5, 97.5])
        assert (interval.low, interval.high) == pytest.approx((low, high), abs=1e-9)


def test_resamples_are_summarised_like_the_pairs() -> None:
    ours, theirs = two_methods(6)
    weights = np.array([[2, 0, 1, 3, 0, 0], [0, 0, 0, 0, 0, 1]])
    differences = paired_intervals(ours, theirs, weights)
    drawn = [[i for i, n in enumerate(row) for _ in range(n)] for row in weights]
    for key in SHARES:
        resampled = [summarise([ours[i] for i in row])[key] - summarise([theirs[i] for i in row])[key] for row in drawn]
        low, high = np.percentile(resampled, [2.5, 97.5])
        assert (differences[key].low, differences[key].high) == pytest.approx((low, high), abs=1e-9)


def test_a_method_does_not_differ_from_itself() -> None:
    ours, _ = two_methods(9)
    for interval in paired_intervals(ours, list(ours), by_blocks([score.sequence for score in ours], 2, 100)).values():
        assert interval == Difference(0.0, 0.0, 0.0)
        assert not interval.excludes_zero


def test_a_certain_difference_is_told() -> None:
    sequences = ["a"] * 10 + ["b"] * 10
    interval = paired_intervals(with_right([11] * 20, sequences), with_right([0] * 20, sequences), by_blocks(sequences, 5, 100))[
        "cluster_accuracy"
    ]
    assert interval == Difference(100.0, 100.0, 100.0)
    assert interval.excludes_zero


@pytest.mark.parametrize("weights", [by_sequence(["a"] * 6, 50), by_blocks(["a"] * 6, 6, 50)])
def test_resamples_that_are_all_the_same_have_no_bounds(weights: np.ndarray) -> None:
    ours, theirs = with_right([9] * 6, ["a"] * 6), with_right([3] * 6, ["a"] * 6)
    interval = paired_intervals(ours, theirs, weights)["cluster_accuracy"]
    assert interval.value == pytest.approx(600 / 11)
    assert math.isnan(interval.low)
    assert math.isnan(interval.high)
    assert not interval.excludes_zero


@pytest.mark.parametrize(("low", "high", "excludes"), [(0.1, 2.0, True), (-2.0, -0.1, True), (-0.1, 0.1, False), (0.0, 1.0, False)])
def test_an_interval_excludes_zero_on_one_side_of_it(low: float, high: float, excludes: bool) -> None:
    assert Difference((low + high) / 2, low, high).excludes_zero is excludes


def test_intervals_cover_a_known_difference() -> None:
    """Thirty alike sequences of two pairs; the methods share what a sequence adds, and differ by 3 of 11 points on average."""
    rng = np.random.default_rng(0)
    sequences = [str(i // 2) for i in range(60)]
    weights = by_sequence(sequences, 400)
    covered = []
    for _ in range(150):
        easy = np.repeat(rng.integers(0, 3, 30), 2)
        gain = np.repeat(rng.integers(1, 6, 30), 2)
        interval = paired_intervals(with_right(3 + easy + gain, sequences), with_right(3 + easy, sequences), weights)
        covered.append(interval["cluster_accuracy"].low <= 300 / 11 <= interval["cluster_accuracy"].high)
    assert 0.88 <= np.mean(covered) <= 0.99


def test_alike_pairs_of_a_sequence_widen_the_interval_by_sequence() -> None:
    sequences = [str(i // 10) for i in range(60)]
    gain = np.repeat([1, 5, 2, 4, 3, 6], 10) + np.arange(60) % 2
    ours, theirs = with_right(2 + gain, sequences), with_right([2] * 60, sequences)
    wide, narrow = (
        paired_intervals(ours, theirs, weights)["cluster_accuracy"]
        for weights in (by_sequence(sequences, 500), by_blocks(sequences, 2, 500))
    )
    assert wide.high - wide.low > 5 * (narrow.high - narrow.low)


def test_errors_name_what_is_wrong() -> None:
    ours, theirs = two_methods(4)
    weights = by_blocks(["a"] * 4, 2, 10)
    with pytest.raises(ValueError, match="ours: expected at least one pair, got none"):
        paired_intervals([], [], weights)
    with pytest.raises(ValueError, match="theirs: expected the 4 pairs of `ours`, got 3"):
        paired_intervals(ours, theirs[:3], weights)
    with pytest.raises(ValueError, match="same order, at 0 '0' of 's0', got '3' of 's1'"):
        paired_intervals(ours, theirs[::-1], weights)
    moved = [dataclasses.replace(score, sequence="elsewhere") for score in theirs]
    with pytest.raises(ValueError, match="'0' of 'elsewhere'"):
        paired_intervals(ours, moved, weights)
    for wrong in (weights[:, :3], weights[0], weights[:0]):
        with pytest.raises(ValueError, match=r"weights: expected shape \(resamples, 4\), got"):
            paired_intervals(ours, theirs, wrong)
    with pytest.raises(ValueError, match="sequences: expected at least 1, got 0"):
        by_sequence([])
    with pytest.raises(ValueError, match="block: expected at least 1, got 0"):
        by_blocks(["a"], 0)
    with pytest.raises(ValueError, match="resamples: expected at least 1, got 0"):
        by_sequence(["a"], 0)
