"""Which of the objects that are followed move."""

import numpy as np
import pytest

from torchcrf_scan.result import MovingObject
from torchcrf_scan.stream.movers import Movers

STEP = 0.1  # seconds between scans


def sighting(
    place: tuple[float, float], velocity: tuple[float, float], deviation: float, points: int, number: int = 1
) -> MovingObject:
    covariance = np.diag([0.01, 0.01, deviation**2, deviation**2])
    return MovingObject(number, np.array(place), np.array(velocity), covariance, 0.0, (0.5, 0.5), points, 1.0)


def moves(places: list[float], speed: float, deviation: float = 0.1, points: int = 6) -> list[bool]:
    """Whether an object that was seen at these places along x, with a velocity along x, moves, scan after scan."""
    movers = Movers(0.2)
    return [bool(movers.update(STEP * k, [sighting((x, 0.0), (speed, 0.0), deviation, points)])) for k, x in enumerate(places)]


def test_what_goes_where_its_velocity_points_moves_from_its_second_sighting_on() -> None:
    assert moves([0.0, 0.05, 0.1, 0.15], 0.5) == [False, True, True, True]


def test_it_still_counts_when_it_has_stopped() -> None:
    movers = Movers(0.2)
    for k in range(3):
        movers.update(STEP * k, [sighting((0.05 * k, 0.0), (0.5, 0.0), 0.1, 6)])
    assert movers.update(0.5, [sighting((0.1, 0.0), (0.0, 0.0), 0.1, 6)])


@pytest.mark.parametrize(
    ("places", "speed", "deviation", "points"),
    [
        pytest.param([0.0] * 6, 0.5, 0.1, 6, id="a velocity without a way"),
        pytest.param([-0.05 * k for k in range(6)], 0.5, 0.1, 6, id="the way goes back"),
        pytest.param([0.05 * k for k in range(6)], 0.5, 0.4, 6, id="the velocity is not certain"),
        pytest.param([0.01 * k for k in range(6)], 0.1, 0.01, 6, id="too slow"),
        pytest.param([0.05 * k for k in range(6)], 0.5, 0.1, 1, id="single points"),
    ],
)
def test_what_does_not_move(places: list[float], speed: float, deviation: float, points: int) -> None:
    assert not any(moves(places, speed, deviation, points))


def test_what_is_large_and_fast_beyond_doubt_moves_at_once() -> None:
    assert moves([0.0], 3.0, 0.1, 20) == [True]
    assert moves([0.0], 3.0, 1.0, 20) == [False]


def test_a_scan_without_it_neither_helps_nor_hurts() -> None:
    movers = Movers(0.2)
    seen = [sighting((0.05 * k, 0.0), (0.5, 0.0), 0.1, 6) for k in range(3)]
    hidden = sighting((0.05, 0.0), (0.5, 0.0), 0.1, 0)
    answers = [bool(movers.update(STEP * k, [of])) for k, of in enumerate([seen[0], hidden, seen[2]])]
    assert answers == [False, False, True]


def test_objects_are_told_apart_and_forgotten() -> None:
    movers = Movers(0.2)
    for k in range(3):
        both = [sighting((0.05 * k, 0.0), (0.5, 0.0), 0.1, 6, 1), sighting((3.0, 0.0), (0.0, 0.0), 0.1, 6, 2)]
        found = movers.update(STEP * k, both)
    assert [of.number for of in found] == [1]
    assert movers.update(0.3, []) == ()
    assert movers.update(0.4, [sighting((0.2, 0.0), (0.5, 0.0), 0.1, 6, 1)]) == ()
