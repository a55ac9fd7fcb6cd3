import dataclasses
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_pairs import make_pair, make_prediction, perfect, perturbed, random_labels

from torchcrf_scan.evaluation.counterparts import annotation_of, match_movers, relabel
from torchcrf_scan.evaluation.metrics import edit_distance, score_pair
from torchcrf_scan.scan import Scan, ScanPair


def longest_common_subsequence(one: list[int], other: list[int]) -> int:
    row = [0] * (len(other) + 1)
    for a in one:
        above = row
        row = [0]
        for j, b in enumerate(other):
            row.append(above[j] + 1 if a == b else max(above[j + 1], row[j]))
    return row[-1]


@given(st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), max_size=30))
def test_edit_distances_follow_their_definition(labels: list[tuple[int, int]]) -> None:
    """T8: SED2 = 2 N - 2 LCS, SED1 <= Hamming, SED2 <= 2 Hamming."""
    one, other = [a for a, _ in labels], [b for _, b in labels]
    hamming = sum(a != b for a, b in labels)
    strings = np.array(one, dtype=np.int64), np.array(other, dtype=np.int64)
    sed1, sed2 = edit_distance(*strings, 1), edit_distance(*strings, 2)
    assert sed2 == 2 * len(labels) - 2 * longest_common_subsequence(one, other)
    assert sed1 <= hamming
    assert sed2 <= 2 * hamming
    assert sed1 <= sed2


@given(st.integers(0, 10_000), st.permutations([1, 2, 3, 4]))
def test_numbers_of_the_movers_do_not_matter(seed: int, order: list[int]) -> None:
    """T10: renumbering the predicted movers together with their motions changes nothing, ties included."""
    rng = np.random.default_rng(seed)
    pair = make_pair(int(rng.integers(1, 30)), 20, 3, rng, drop=0.1)
    prediction = random_labels(pair, rng)
    renumbered = np.array([0, *order])
    motions = np.empty_like(prediction.motions)
    motions[renumbered] = prediction.motions
    cluster = np.where(prediction.cluster < 0, -1, renumbered[prediction.cluster])
    other = dataclasses.replace(prediction, cluster=cluster, motions=motions)
    assert score_pair(pair, other) == score_pair(pair, prediction)


@given(st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 4)), max_size=25))
def test_no_other_matching_overlaps_more(labels: list[tuple[int, int]]) -> None:
    cluster, predicted = (np.array([pair[i] for pair in labels], dtype=np.int64) for i in (0, 1))
    matched = match_movers(cluster, predicted)
    assert len(set(matched.values())) == len(matched)
    best = max(
        sum(int(((cluster == k) & (predicted == j)).sum()) for k, j in zip((1, 2, 3), order, strict=False))
        for order in permutations((1, 2, 3, 4), 3)
    )
    overlap = sum(int(((cluster == k) & (predicted == j)).sum()) for k, j in matched.items())
    assert overlap == best
    right = int((relabel(predicted, cluster, matched) == cluster).sum())
    assert right == best + int(((cluster == predicted) & (cluster <= 0)).sum())


def test_unmatched_movers_get_numbers_of_their_own() -> None:
    cluster, predicted = np.array([1, 1, 2, 0, 0]), np.array([5, 5, 0, 1, 2])
    matched = match_movers(cluster, predicted)
    assert matched == {1: 5}
    np.testing.assert_array_equal(relabel(predicted, cluster, matched), [1, 1, 0, 3, 4])


def test_ignored_and_lost_beams_change_nothing() -> None:
    rng = np.random.default_rng(2)
    pair = make_pair(60, 50, 2, rng, drop=0.2)
    prediction = perturbed(pair, rng)
    unseen = annotation_of(pair).ignore | ~pair.source.to_beams(np.ones(len(pair.source), bool), False)
    other = dataclasses.replace(
        prediction,
        association=np.where(unseen, 0, prediction.association),
        cluster=np.where(unseen, 3, prediction.cluster),
        association_confidence=np.where(unseen, 0.0, prediction.association_confidence),
        cluster_confidence=np.where(unseen, 0.0, prediction.cluster_confidence),
    )
    assert score_pair(pair, other) == score_pair(pair, prediction)
    one, same = score_pair(pair, other).sureness, score_pair(pair, prediction).sureness
    for name in ("association", "association_right", "cluster", "cluster_right"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))


def test_errors_name_what_is_wrong(small: ScanPair) -> None:
    with pytest.raises(ValueError, match="expected an annotation"):
        score_pair(dataclasses.replace(small, annotation=None), perfect(small))
    short = make_prediction(np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"all \(12,\) source beams"):
        score_pair(small, short)
    beyond = dataclasses.replace(perfect(small), association=np.full(12, 12))
    with pytest.raises(ValueError, match="association below 12, got 12"):
        score_pair(small, beyond)


@pytest.mark.parametrize("seed", range(5))
def test_scores_do_not_depend_on_the_numbering_of_the_beams(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 50, 2, rng, drop=0.2)
    answer = perturbed(pair, rng)
    truth, ways = annotation_of(pair), (np.arange(40)[::-1], np.arange(50)[::-1])
    there = np.append(ways[1], -1)
    scans = [renumbered(scan, order) for scan, order in zip((pair.source, pair.target), ways, strict=True)]
    labels = {key: getattr(truth, key)[ways[0]] for key in ("cluster", "body", "ignore")}
    annotation = dataclasses.replace(truth, association=there[truth.association][ways[0]], **labels)
    answer_there = dataclasses.replace(answer, association=there[answer.association][ways[0]], cluster=answer.cluster[ways[0]])
    turned = dataclasses.replace(pair, source=scans[0], target=scans[1], annotation=annotation)
    assert score_pair(turned, answer_there) == score_pair(pair, answer)
    assert score_pair(pair, answer).within_2 > score_pair(pair, answer).within_1


def renumbered(scan: Scan, order: np.ndarray) -> Scan:
    return Scan.from_ranges(scan.to_beams(scan.ranges, np.nan)[order], scan.beam_bearings[order])
