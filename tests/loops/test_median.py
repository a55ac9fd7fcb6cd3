"""The lower median, against sorting."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.loops.median import lower_median


@pytest.mark.parametrize(
    ("values", "median"), [([3.0], 3.0), ([4.0, 1.0], 1.0), ([5.0, 1.0, 3.0], 3.0), ([4.0, 4.0, 2.0, 9.0], 4.0)]
)
def test_the_lower_median(values: list[float], median: float) -> None:
    assert lower_median(np.array(values, np.float64)) == median


@given(st.lists(st.floats(-9, 9), min_size=1, max_size=30))
def test_half_of_the_values_are_no_larger(values: list[float]) -> None:
    assert lower_median(np.array(values)) == sorted(values)[(len(values) - 1) // 2]
