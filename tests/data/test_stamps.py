"""The time between scans, whatever the clock did."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.stamps import plausible_steps, steps_with_a_word


@pytest.mark.parametrize(
    ("stamps", "steps"),
    [
        ([0] * 4, [0.1] * 3),
        ([7.5] * 4, [0.1] * 3),
        ([3, 2.9, 2.8, 2.7], [0.1] * 3),
        ([1, 1.1, 4294967296, 4294967296.1], [0.1] * 3),
        ([1, 1.2, 1.4, 1.3, 1.5], [0.2] * 4),
        ([1, 1.2, 3601.2, 3601.4], [0.2, 3600, 0.2]),  # a pause of an hour
        ([0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3], [0.25] * 12),  # cut to seconds
        ([0, 0.2, 0.4, 0.401, 0.6, 0.8], [0.2, 0.2, 0.2, 0.199, 0.2]),  # written late
        ([0, 5, 5.5, 6], [5, 0.5, 0.5]),
        ([0, np.nan, 0.3, 0.5], [0.2, 0.2, 0.2]),
        ([0.0, 0.002, 0.004], [0.002, 0.002]),  # a fast sensor
        ([1.0], []),
    ],
)
def test_steps(stamps: list[float], steps: list[float]) -> None:
    found, made_up = plausible_steps(np.array(stamps, dtype=float))
    np.testing.assert_allclose(found, steps, atol=1e-6)
    kept = np.flatnonzero(~made_up)
    np.testing.assert_allclose(found[kept], np.diff(stamps)[kept])


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=30))
def test_steps_always_make_pairs(stamps: list[float]) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        found, made_up = plausible_steps(np.array(stamps))
    assert len(found) == len(made_up) == len(stamps) - 1
    assert (np.isfinite(found) & (found > 0) & (found <= 86400)).all()


@given(st.lists(st.floats(0.05, 0.15), min_size=1, max_size=30), st.floats(-1e9, 1e9))
def test_good_stamps_are_believed(steps: list[float], start: float) -> None:
    stamps = start + np.cumsum([0, *steps])
    found, made_up = plausible_steps(stamps)
    assert not made_up.any()
    np.testing.assert_array_equal(found, np.diff(stamps))


def test_one_word_about_it(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        steps_with_a_word(np.array([0, 0.2, 0.4]), "good.log")
        assert not caplog.records
        steps_with_a_word(np.array([0, 0.2, 0.1, 0.3, 0.2]), "bad.log")
    assert len(caplog.records) == 1
    assert "bad.log: the stamps do not tell the time between 2 of 4 pairs of scans; taken as 0.2 s" in caplog.text
