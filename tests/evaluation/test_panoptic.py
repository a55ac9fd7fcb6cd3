"""Panoptic quality: by hand, against plain loops over sets of points, and for any numbers of clusters."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_causes import CAR, labelled, make_street
from made_pairs import PREDICTORS, make_pair, make_prediction

from torchcrf_scan.evaluation.panoptic import PanopticCount, count_segments, panoptic_quality
from torchcrf_scan.scan import Scan, ScanPair


def naive(cluster: list[int], predicted: list[int], void: list[bool], least: int) -> PanopticCount:
    """By sets: every segment with every other."""

    def segments(labels: list[int], keep: bool) -> dict[int, set[int]]:
        return {k: {i for i, label in enumerate(labels) if label == k and (keep or not void[i])} for k in set(labels) if k > 0}

    true, found = segments(cluster, False), segments(predicted, True)
    true = {k: points for k, points in true.items() if points}
    ious = {}
    for k, a in true.items():
        for j, whole in found.items():
            b = {i for i in whole if not void[i]}
            if 2 * len(a & b) > len(a | b):
                ious[k, j] = len(a & b) / len(a | b)
    matched_true, matched_found = {k for k, _ in ious}, {j for _, j in ious}
    missed = sum(len(points) >= least for k, points in true.items() if k not in matched_true)
    false = 0
    for j, whole in found.items():
        seen = sum(not void[i] for i in whole)
        false += j not in matched_found and seen >= least and 2 * seen >= len(whole)
    return PanopticCount(sum(ious.values()), len(ious), false, missed)


@given(
    st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 3), st.sampled_from([False, False, True])), max_size=25),
    st.integers(1, 4),
)
def test_against_plain_sets(points: list[tuple[int, int, bool]], least: int) -> None:
    cluster, predicted, void = ([row[k] for row in points] for k in range(3))
    found = count_segments(np.array(cluster, np.int64), np.array(predicted, np.int64), np.array(void, bool), least)
    expected = naive(cluster, predicted, void, least)
    assert found.overlap == pytest.approx(expected.overlap)
    assert (found.matched, found.false, found.missed) == (expected.matched, expected.false, expected.missed)


def test_by_hand() -> None:
    """The car is found but for two of its eight points, the bike is missed, five points of the wall are called a mover."""
    street = make_street()
    answer = labelled(street.answer, slice(47, 49), cluster=0)
    answer = labelled(answer, slice(49, 55), cluster=-1)
    answer = labelled(answer, slice(0, 5), cluster=7)
    count = PanopticCount.of(street.pair, answer)
    assert count == PanopticCount(0.75, 1, 1, 1)
    found = panoptic_quality([count])
    assert (found["sq"], found["rq"], found["pq"]) == pytest.approx((75.0, 50.0, 37.5))


def test_half_of_a_mover_is_no_match() -> None:
    street = make_street()
    half = PanopticCount.of(street.pair, labelled(street.answer, slice(CAR.start, CAR.start + 4), cluster=0))
    assert (half.matched, half.missed, half.false) == (1, 1, 0)  # the other half is too small to be a false mover


def test_movers_of_points_without_counterpart_are_void() -> None:
    street = make_street()
    answer = labelled(street.answer, slice(55, 60), cluster=5)
    assert PanopticCount.of(street.pair, answer) == PanopticCount(2.0, 2, 0, 0)


@given(st.integers(0, 10**6), st.sampled_from(PREDICTORS))
def test_the_numbers_of_clusters_do_not_matter(seed: int, predictor) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 40, 3, rng, 0.1)
    answer = predictor(pair, rng)
    K = int(answer.cluster.max()) + 1
    order = np.append(0, 1 + rng.permutation(K))
    renamed = make_prediction(answer.association, np.where(answer.cluster < 0, -1, order[answer.cluster]), answer.motions)
    one, other = PanopticCount.of(pair, answer), PanopticCount.of(pair, renamed)
    assert one.overlap == pytest.approx(other.overlap)
    assert (one.matched, one.false, one.missed) == (other.matched, other.false, other.missed)
    found = panoptic_quality([one])
    assert math.isnan(found["pq"]) == (one.matched + one.false + one.missed == 0)
    if one.matched:
        assert found["pq"] == pytest.approx(found["sq"] * found["rq"] / 100)
        assert 50 < found["sq"] <= 100


def test_nothing_to_match() -> None:
    assert all(math.isnan(value) for value in panoptic_quality([]).values())
    missed = panoptic_quality([PanopticCount(0.0, 0, 0, 2)])
    assert (missed["pq"], missed["rq"]) == (0.0, 0.0)
    assert math.isnan(missed["sq"])
    empty = Scan.from_ranges([], [])
    with pytest.raises(ValueError, match="expected an annotation"):
        PanopticCount.of(ScanPair(empty, empty), make_prediction(np.zeros(0, int), np.zeros(0, int), np.zeros((1, 3))))
