"""True movers and the hypotheses that are theirs."""

from dataclasses import replace

import numpy as np
import pytest
from made_causes import MOTIONS, UNITS, Street

from torchcrf_scan.evaluation.causes.movers import TOLERANCE_SHARE, TrueMover, gap


def car_of(street: Street, units: np.ndarray = UNITS) -> TrueMover:
    truth = street.pair.annotation
    assert truth is not None
    return TrueMover.of(1, street.pair, truth, units)


def test_the_gap_of_two_motions_by_plain_loops() -> None:
    points, one, other = np.array([[1.0, 2.0], [-3.0, 0.5]]), np.array([0.3, 0.1, -0.2]), np.array([-0.1, 0.4, 0.0])

    def moved(motion: np.ndarray, point: np.ndarray) -> complex:
        return complex(*point) * np.exp(1j * motion[0]) + complex(*motion[1:])

    assert gap(points, one, other) == pytest.approx([abs(moved(one, p) - moved(other, p)) for p in points])


def test_the_tolerance_is_two_units_or_an_eighth_of_the_way(street: Street) -> None:
    assert car_of(street).tolerance == pytest.approx(0.2)
    assert car_of(street, UNITS / 100).tolerance == pytest.approx(0.6 * TOLERANCE_SHARE)
    assert car_of(street).is_right(MOTIONS[1] + [[0.0, 0.19, 0.0], [0.0, 0.21, 0.0], [0.0, np.nan, 0.0]]).tolist() == [
        True,
        False,
        False,
    ]


def test_a_hypothesis_of_the_mover_moves_its_points_as_they_moved(street: Street) -> None:
    trace = street.trace
    car = car_of(street)
    assert car.right_hypotheses(trace).tolist() == [0]
    elsewhere = replace(trace, motions=np.tile(MOTIONS[1], (3, 1)))  # the bike's and the wall's points are not the car's
    assert car.right_hypotheses(elsewhere).tolist() == [0]


def test_the_hypothesis_that_covers_the_mover_best_comes_first(street: Street) -> None:
    own = street.trace.members[0]
    part = own & (np.cumsum(own) <= 5)
    more = own | (np.arange(60) < 20)
    trace = replace(street.trace, motions=np.tile(MOTIONS[1], (3, 1)), members=np.stack([part, more, own]))
    assert car_of(street).right_hypotheses(trace).tolist() == [2, 0, 1]


def test_a_mover_without_counterparts_is_known_by_its_body(street: Street) -> None:
    truth = street.pair.annotation
    assert truth is not None
    cluster = np.where(truth.cluster == 1, -1, truth.cluster)
    gone = replace(truth, cluster=cluster, association=np.where(cluster < 0, -1, truth.association))
    assert TrueMover.of(1, street.pair, gone, UNITS).is_member.sum() == 8
