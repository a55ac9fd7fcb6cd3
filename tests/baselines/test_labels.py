"""From points to beams and back: numbering of movers, invalid beams, empty answers."""

import numpy as np
from checks import check
from rooms import EMPTY, HOLES, ONE

from torchcrf_scan.baselines.labels import all_outliers, as_background, to_prediction
from torchcrf_scan.scan import ScanPair

PAIR = ScanPair(HOLES, HOLES)  # beams 0, 2, 3 and 5 are valid
MOTIONS = np.arange(12.0).reshape(4, 3)


def test_movers_are_numbered_by_size_and_empty_ones_dropped() -> None:
    found = to_prediction(PAIR, np.array([3, -1, 1, 0]), np.array([1, -1, 3, 3]), MOTIONS, converged=False)
    check(PAIR, found)
    assert found.association.tolist() == [5, -1, -1, 2, -1, 0]
    assert found.cluster.tolist() == [2, -1, -1, 1, -1, 1]
    assert found.motions.tolist() == MOTIONS[[0, 3, 1]].tolist()
    assert not found.converged


def test_equal_sizes_keep_their_order() -> None:
    found = to_prediction(PAIR, np.arange(4), np.array([2, 1, 2, 1]), MOTIONS)
    assert found.cluster.tolist() == [2, -1, 1, 2, -1, 1]


def test_target_points_is_the_way_back() -> None:
    association = np.array([3, -1, 1, 0])
    assert PAIR.target_points(as_background(PAIR, association, MOTIONS[0]).association).tolist() == association.tolist()


def test_all_outliers_of_empty_scans() -> None:
    for pair in (ScanPair(EMPTY, ONE), ScanPair(ONE, EMPTY), ScanPair(EMPTY, EMPTY)):
        found = all_outliers(pair, MOTIONS[1])
        check(pair, found)
        assert (found.association == -1).all()
        assert found.motions.tolist() == [MOTIONS[1].tolist()]
