"""Angles on a circle, and places on a rising scale."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.loops.circle import BACKWARDS, first_from, rising_turn, turn_apart, turn_between, within_circle


def test_search_finds_the_first_that_is_not_below() -> None:
    rising = np.array([0.0, 1.0, 1.0, 3.0])
    for value in (-1.0, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0):
        assert first_from(rising, value) == np.searchsorted(rising, value)


@pytest.mark.parametrize("angle", [-20.0, -math.tau, -1.0, 0.0, 1.0, math.tau, 30.0])
def test_circles_are_those_of_the_remainder(angle: float) -> None:
    assert within_circle(angle) == pytest.approx(angle % math.tau)


@given(st.floats(-3.0, 3.0), st.floats(0.0, 6.2))
def test_a_turn_is_counted_counter_clockwise(before: float, turn: float) -> None:
    after = (before + turn + math.pi) % math.tau - math.pi
    for found in (rising_turn(after - before), turn_apart(after - before), turn_between(before, after)):
        assert found == pytest.approx(turn, abs=2 * BACKWARDS if turn < BACKWARDS else 1e-9)


def test_a_hair_back_is_no_turn_and_more_is_nearly_a_whole_one() -> None:
    for turn in (rising_turn, turn_apart, lambda angle: turn_between(0.0, angle)):
        assert turn(-0.5 * BACKWARDS) == 0
        assert turn(-2 * BACKWARDS) == pytest.approx(math.tau - 2 * BACKWARDS)


@given(st.lists(st.floats(-9, 9), max_size=20), st.floats(-10, 10))
def test_the_first_that_is_not_below_any_value(values: list[float], value: float) -> None:
    rising = np.sort(np.array(values, dtype=np.float64))
    assert first_from(rising, value) == sum(v < value for v in rising)
