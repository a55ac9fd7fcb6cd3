"""What a log's readings show of its "no return"."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.no_return import find_no_return

RNG = np.random.default_rng(0)


@given(st.floats(5.0, 80.0), st.integers(20, 500), st.integers(0, 2**32 - 1))
def test_a_peak_at_the_end_is_found(nothing: float, count: int, seed: int) -> None:
    walls = np.random.default_rng(seed).uniform(0.5, nothing - 0.1, 1000)
    found = find_no_return(np.concatenate([walls, np.full(count, nothing)]))
    near = (walls > nothing - 1.0).sum()  # more than a tenth of the peak in a window hides it
    assert found == nothing if count >= 10 * near else found is None or found == nothing


@pytest.mark.parametrize(
    "readings",
    [
        RNG.uniform(1, 20, 5000),  # walls everywhere
        10 + 0.01 * RNG.standard_normal(5000),  # the end of a corridor, seen by a sensor that stands
        np.round(np.concatenate([RNG.uniform(1, 8, 3000), 8 + 0.01 * RNG.standard_normal(2000)]), 2),
        np.full(100, 3.0),  # a round room: nothing but one reading
        np.array([1.0, 2.0, 8.19]),  # too few
        np.zeros(0),
        np.array([np.nan, np.inf, 0.0, -1.0]),
    ],
    ids=["walls", "corridor", "wall", "round", "few", "none", "invalid"],
)
def test_walls_are_none(readings: np.ndarray) -> None:
    assert find_no_return(readings) is None


def test_two_roundings_of_one_value_are_found() -> None:
    found = find_no_return(np.concatenate([RNG.uniform(1, 20, 500), np.full(30, 32.76), np.full(60, 32.77)]))
    assert found == 32.76
