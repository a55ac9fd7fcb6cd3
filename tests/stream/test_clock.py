"""Time from stamps of any kind."""

import logging
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.stream.clock import TICKS, USUAL, Clock

TICK = 1 / TICKS


def intervals(*stamps: float) -> list[float]:
    clock = Clock()
    return [clock.advance(stamp) for stamp in stamps]


def test_plain_stamps() -> None:
    np.testing.assert_allclose(intervals(5.0, 5.2, 5.4, 9.4), [0.0, 0.2, 0.2, 4.0], atol=TICK)


def test_stamps_that_stand_still_or_go_back_count_as_the_usual_interval() -> None:
    np.testing.assert_allclose(intervals(5.0, 5.2, 5.4, 5.4, 1.0, 1.3), [0.0, 0.2, 0.2, 0.2, 0.2, 0.3], atol=TICK)
    np.testing.assert_allclose(intervals(1.0, 1.0), [0.0, USUAL], atol=TICK)


def test_stamps_that_are_not_numbers() -> None:
    np.testing.assert_allclose(intervals(0.0, 0.2, math.nan, math.inf, 0.3, 0.5), [0.0, 0.2, 0.2, 0.2, 0.2, 0.2], atol=TICK)


@pytest.mark.parametrize("step", [0.1, 0.05, 1 / 30])
def test_equal_steps_are_equal_at_any_time(step: float) -> None:
    clock = Clock()
    times = []
    for k in range(1000):
        clock.advance(k * step)
        times.append(clock.now)
    assert len({later - earlier for earlier, later in pairwise(times[::5])}) == 1
    assert clock.elapsed == pytest.approx(999 * step, abs=1e-9)  # rounded steps would sum up to 0.4 ms


def test_told_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        intervals(5.0, 5.1, 5.1, 5.1, 4.0)
    assert len(caplog.records) == 1
    assert "5.1" in caplog.text


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=2, max_size=20))
def test_time_always_advances(stamps: list[float]) -> None:
    clock = Clock()
    assert clock.advance(stamps[0]) == 0.0
    for stamp in stamps[1:]:
        before = clock.now
        interval = clock.advance(stamp)
        assert 0 < interval < math.inf
        assert clock.now >= before


def test_stamps_that_differ_by_less_than_any_scanner_needs_count_as_the_usual_interval() -> None:
    np.testing.assert_allclose(intervals(0.0, 1e-300, 2e-300, 1e-9), [0.0, USUAL, USUAL, USUAL], atol=TICK)
