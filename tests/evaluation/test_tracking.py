"""Scores of objects over time, on cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.evaluation.tracking import TrackFrame, frame_of_points, frame_of_positions, track_scores

pytest.importorskip("trackeval", reason="needs trackeval (extra tracking)")


def frames(true: list[list[int]], found: list[list[int]], similarity: float = 1.0) -> list[TrackFrame]:
    """Scans in which the i-th true object and the i-th found one are alike."""
    made = []
    for ours, theirs in zip(true, found, strict=True):
        made.append(TrackFrame(np.array(ours, dtype=int), np.array(theirs, dtype=int), similarity * np.eye(len(ours), len(theirs))))
    return made


def test_all_right() -> None:
    scores = track_scores([frames([[7, 9]] * 10, [[1, 2]] * 10)])
    assert all(scores[key] == pytest.approx(100) for key in ("hota", "deta", "assa", "mota", "idf1", "recall", "precision"))
    assert (scores["id_switches"], scores["objects"], scores["tracks"], scores["sightings"]) == (0, 2, 2, 20)


def test_another_number_halfway() -> None:
    scores = track_scores([frames([[7]] * 10, [[1]] * 5 + [[2]] * 5)])
    assert scores["id_switches"] == 1
    assert scores["mota"] == pytest.approx(90)
    assert scores["assa"] == pytest.approx(50)
    assert scores["hota"] == pytest.approx(100 * np.sqrt(0.5))


def test_lost_for_a_while_and_one_too_many() -> None:
    scores = track_scores([frames([[7]] * 10, [[1]] * 4 + [[]] * 2 + [[1, 2]] * 4)])
    assert (scores["recall"], scores["precision"]) == (pytest.approx(80), pytest.approx(100 * 8 / 12))
    assert scores["mota"] == pytest.approx(100 * (8 - 4) / 10)
    assert scores["id_switches"] == 0


def test_sequences_are_pooled_and_their_numbers_are_their_own() -> None:
    right, missed = frames([[1]] * 6, [[1]] * 6), frames([[1]] * 2, [[]] * 2)
    scores = track_scores([right, missed])
    assert scores["recall"] == pytest.approx(75)
    assert scores["objects"] == 2


@pytest.mark.parametrize(("true", "found"), [([], []), ([[]], [[]]), ([[1]], [[]]), ([[]], [[1]])])
def test_nothing_there_or_nothing_found(true: list, found: list) -> None:
    scores = track_scores([frames(true, found)])
    assert np.isfinite(list(scores.values())).all()
    assert scores["hota"] == 0


def test_no_sequences() -> None:
    with pytest.raises(ValueError, match="sequences: expected at least one"):
        track_scores([])


def test_points_in_common() -> None:
    body = np.array([0, 1, 1, 1, 1, 2, 2, 2, 2, -1])
    track = np.array([0, 5, 5, 5, 0, 6, 6, 6, 6, 6])
    frame = frame_of_points(body, track, least=3)
    np.testing.assert_array_equal(frame.true, [1, 2])
    np.testing.assert_array_equal(frame.found, [5, 6])
    np.testing.assert_allclose(frame.similarity, [[3 / 4, 0], [0, 4 / 5]])


def test_objects_of_few_points_are_neither_asked_for_nor_counted() -> None:
    body = np.array([1, 1, 2, 2, 2, 2, 0, 0])
    track = np.array([5, 5, 6, 6, 6, 6, 7, 7])
    frame = frame_of_points(body, track, least=3)
    np.testing.assert_array_equal(frame.true, [2])
    np.testing.assert_array_equal(frame.found, [6, 7])


@given(st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), max_size=40))
def test_similarities_are_shares(labels: list[tuple[int, int]]) -> None:
    body, track = np.array(labels, dtype=int).reshape(-1, 2).T
    frame = frame_of_points(body, track, least=2)
    assert frame.similarity.shape == (len(frame.true), len(frame.found))
    assert ((frame.similarity >= 0) & (frame.similarity <= 1)).all()
    same = frame_of_points(body, body, least=1)
    np.testing.assert_array_equal(same.similarity, np.eye(len(same.true)))


def test_distances() -> None:
    everyone = np.ones(2, dtype=bool)
    frame = frame_of_positions(np.array([1, 2]), np.array([[0.0, 0], [5, 0]]), everyone, np.array([3]), np.array([[0.0, 0.5]]), 2.0)
    np.testing.assert_allclose(frame.similarity, [[0.75], [0.0]])
    empty = frame_of_positions(np.zeros(0, int), np.zeros((0, 2)), everyone[:0], np.array([3]), np.array([[0.0, 0.5]]), 2.0)
    assert empty.similarity.shape == (0, 1)


def test_who_is_hidden_need_not_be_found_and_may_be_predicted() -> None:
    asked, positions = np.array([True, False]), np.array([[0.0, 0.3], [5.0, 0.9], [9.0, 0.0]])
    frame = frame_of_positions(np.array([1, 2]), np.array([[0.0, 0], [5, 0]]), asked, np.array([3, 4, 5]), positions, 2.0)
    np.testing.assert_array_equal(frame.true, [1])
    np.testing.assert_array_equal(frame.found, [3, 5])
