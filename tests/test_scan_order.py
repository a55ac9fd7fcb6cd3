"""Beams in any order and direction: the answer of the sorted scan, in the numbering given."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from torchcrf_scan import JointScanCRF
from torchcrf_scan.scan import Scan, ScanPair

TURN = np.radians(np.arange(-180, 180.0))
MODEL = JointScanCRF.from_pretrained()


def seen(x: float, y: float, heading: float, bearings: np.ndarray = TURN) -> np.ndarray:
    """(N,) ranges in a room of 10 x 8 m with a bay, from a pose in it."""
    direction = bearings + heading
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(direction) > 0, 6.0 - x, -4.0 - x) / np.cos(direction)
        to_y = np.where(np.sin(direction) > 0, 5.0 - y, -3.0 - y) / np.sin(direction)
    return np.minimum(to_x, to_y) + 0.004 * np.sin(17 * direction) + 0.5 * (np.abs(direction - 0.8) < 0.2)


RANGES = seen(0.0, 0.0, 0.0), seen(0.2, 0.1, 0.05)


def orders() -> dict[str, np.ndarray]:
    shuffled = np.random.default_rng(0).permutation(360)
    return {"clockwise": np.arange(360)[::-1], "from the middle": np.roll(np.arange(360), 100), "shuffled": shuffled}


@pytest.mark.parametrize("name", orders())
def test_the_answer_is_in_the_numbering_given(name: str) -> None:
    order = orders()[name]
    right = MODEL.match(*(Scan.from_ranges(r, TURN, range_max=30.0) for r in RANGES))
    answer = MODEL.match(*(Scan.from_ranges(r[order], TURN[order], range_max=30.0) for r in RANGES))
    np.testing.assert_array_equal(answer.motions, right.motions)
    np.testing.assert_array_equal(np.where(answer.association < 0, -1, order[answer.association]), right.association[order])
    for key in ("cluster", "cluster_confidence", "association_confidence"):
        np.testing.assert_array_equal(getattr(answer, key), getattr(right, key)[order])
    assert (right.association >= 0).mean() > 0.9
    np.testing.assert_allclose(right.motions[0][0], -0.05, atol=5e-3)


def test_a_negative_increment_is_clockwise() -> None:
    right = MODEL.match(*(Scan.from_ranges(r, TURN, range_max=30.0) for r in RANGES))
    scans = [Scan.from_ranges(r[::-1], angle_min=TURN[-1], angle_increment=-np.radians(1.0), range_max=30.0) for r in RANGES]
    answer = MODEL.match(*scans)
    np.testing.assert_allclose(answer.motions, right.motions, atol=1e-6)
    assert scans[0].beam[0] == 359


def test_both_ends_may_look_the_same_way() -> None:
    bearings = np.linspace(0, 2 * np.pi, 361)
    scans = [Scan.from_ranges(seen(x, 0.0, 0.0, bearings)[::-1], bearings[::-1], range_max=30.0) for x in (0.0, 0.1)]
    assert scans[0].is_closed
    np.testing.assert_allclose(MODEL.match(*scans).motions[0], [0, -0.1, 0], atol=0.01)


@given(
    st.lists(st.tuples(st.sampled_from([np.nan, 1.0, 2.0, 3.5]), st.floats(-3.0, 3.0)), min_size=1, max_size=20),
    st.randoms(use_true_random=False),
)
def test_points_are_counter_clockwise_whatever_the_order(beams: list[tuple[float, float]], random: object) -> None:
    random.shuffle(beams)  # type: ignore[attr-defined]
    ranges, bearings = np.array(beams).T
    scan = Scan.from_ranges(ranges, bearings, time_increment=0.01)
    assert (np.diff(scan.bearings) >= 0).all()
    np.testing.assert_array_equal(scan.ranges, ranges[scan.beam])
    np.testing.assert_array_equal(scan.bearings, bearings[scan.beam])
    np.testing.assert_allclose(scan.times, 0.01 * scan.beam)
    assert sorted(scan.beam.tolist()) == np.flatnonzero(np.isfinite(ranges)).tolist()
    assert sorted(scan.rank.tolist()) == list(range(len(beams)))
    assert (np.diff(scan.rank[scan.beam]) > 0).all()


def test_rank_counts_every_beam_in_either_direction() -> None:
    ranges = np.array([1.0, np.nan, 2.0, 2.0, np.nan, 1.0, np.nan])
    bearings = np.linspace(-1, 1, 7)
    ahead, back = Scan.from_ranges(ranges, bearings), Scan.from_ranges(ranges[::-1], bearings[::-1])
    assert ahead.rank.tolist() == list(range(7))
    assert np.diff(ahead.rank[ahead.beam]).tolist() == np.diff(back.rank[back.beam]).tolist() == [2, 1, 2]
    np.testing.assert_allclose(back.beam_bearings[1:], bearings[::-1][1:])  # the first returned nothing: held at the end


# --- degrees, masks, times ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "how", [{"bearings": np.arange(-180, 180.0)}, {"angle_min": -np.pi, "angle_increment": 1.0}], ids=["bearings", "increment"]
)
def test_degrees_are_refused_with_a_hint(how: dict) -> None:
    with pytest.raises(ValueError, match=r"^bearings: expected radians of one turn, got a span of 359.0; are these degrees\?$"):
        Scan.from_ranges(np.ones(360), **how)


@pytest.mark.parametrize("bearings", [np.linspace(0, 2 * np.pi, 360), np.linspace(0, 2 * np.pi * 1.04, 25), -TURN, TURN + 7])
def test_a_whole_turn_is_taken(bearings: np.ndarray) -> None:
    assert len(Scan.from_ranges(np.ones(len(bearings)), bearings)) == len(bearings)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.uint16])
def test_a_masked_beam_is_no_return(dtype: type) -> None:
    ranges = np.ma.MaskedArray(np.array([1, 2, 3], dtype), mask=[False, True, False])
    assert Scan.from_ranges(ranges, [0.0, 0.1, 0.2]).beam.tolist() == [0, 2]
    assert Scan.from_ranges(np.ma.MaskedArray([1.0, 2.0]), [0.0, 0.1]).beam.tolist() == [0, 1]


@given(arrays.arrays(np.float64, 6, elements=st.floats(-4e5, 4e5)))
def test_times_count_from_the_first_beam_given(times: np.ndarray) -> None:
    scan = Scan.from_ranges([1.0, np.nan, 1.0, 1.0, 0.0, 1.0], [0.5, 0.4, 0.3, 0.2, 0.1, 0.0], times=times)
    assert scan.beam.tolist() == [5, 3, 2, 0]
    np.testing.assert_array_equal(scan.times, (times - times[0])[[5, 3, 2, 0]])
    np.testing.assert_array_equal(scan.only(scan.ranges > 0).times, scan.times)


def test_times_are_unknown_without_an_increment() -> None:
    assert Scan.from_ranges([1.0], [0.0]).times is None
    assert Scan.from_ranges([1.0], [0.0], time_increment=0.0).times is None  # what drivers write that do not know it


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"time_increment": np.nan}, r"time_increment: expected seconds within 1e\+06 of the first beam's, got nan"),
        ({"time_increment": 1e308}, r"time_increment: expected seconds within 1e\+06 of the first beam's, got 1e\+308"),
        ({"times": [0.0, np.inf]}, r"times: expected seconds within 1e\+06 of the first beam's, got inf"),
        ({"times": [-1e308, 1e308]}, r"times: expected seconds within 1e\+06 of the first beam's, got inf"),
        ({"times": [0.0]}, r"times: expected shape \(2,\), got \(1,\)"),
        ({"times": [0.0, 0.1], "time_increment": 0.1}, "times: expected either times or time_increment, got both"),
    ],
)
def test_wrong_times_are_named(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        Scan.from_ranges([1.0, 2.0], [0.0, 0.1], **wrong)


@pytest.mark.parametrize("dt", [0.0, -0.1, 5e-324, 1e-7, 1e10, np.nan, np.inf])
def test_scans_without_time_between_them_make_no_pair(dt: float) -> None:
    scan = Scan.from_ranges([1.0], [0.0])
    with pytest.raises(ValueError, match=rf"^dt: expected seconds between 1e-06 and 1e\+09, got {re.escape(str(dt))}$"):
        ScanPair(scan, scan, dt)
    with pytest.raises(ValueError, match=r"^dt: expected"):
        MODEL.match(scan, scan, dt=dt)
