"""Which mover is which: the most shared points in all, whatever the numbers. `test_metrics` compares with every other matching."""

import numpy as np

from torchcrf_scan.evaluation.counterparts import match_movers, movers_in_order


def test_the_largest_overlap_in_all_wins() -> None:
    cluster, predicted = np.array([1, 1, 1, 2, 2, 0, -1]), np.array([7, 7, 4, 7, 7, 7, 7])  # 2 takes all it has of 7, 1 takes 4
    assert match_movers(cluster, predicted) == {1: 4, 2: 7}


def test_movers_that_share_no_point_are_not_matched() -> None:
    assert match_movers(np.array([1, 1, 0, 0]), np.array([0, -1, 1, 1])) == {}


def test_background_is_not_matched_to_a_mover() -> None:
    assert match_movers(np.zeros(4, dtype=np.int64), np.ones(4, dtype=np.int64)) == {}


def test_without_points_there_are_no_movers() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert match_movers(none, none) == {}
    assert movers_in_order(none).tolist() == []


def test_movers_come_in_the_order_of_their_first_point() -> None:
    assert movers_in_order(np.array([0, 5, -1, 2, 5, 3])).tolist() == [5, 2, 3]
