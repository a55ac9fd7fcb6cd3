import re
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import Scan, ScanPair

BEARINGS = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])


def test_points_are_polar_coordinates() -> None:
    scan = Scan.from_ranges([1.0, 2.0, 3.0], [0.0, np.pi / 2, np.pi])
    np.testing.assert_allclose(scan.points, [[1, 0], [0, 2], [-3, 0]], atol=1e-12)
    assert len(scan) == 3


def test_bearings_from_minimum_and_increment() -> None:
    scan = Scan.from_ranges([1, 1, 1], angle_min=-0.5, angle_increment=0.25)
    np.testing.assert_allclose(scan.bearings, [-0.5, -0.25, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -1.0])
def test_invalid_returns_are_dropped(bad: float) -> None:
    scan = Scan.from_ranges([1.0, bad, 3.0, bad, 5.0], BEARINGS)
    assert scan.ranges.tolist() == [1.0, 3.0, 5.0]
    assert scan.bearings.tolist() == [-0.2, 0.0, 0.2]
    assert scan.beam.tolist() == [0, 2, 4]
    assert scan.n_beams == 5


def test_range_limits() -> None:
    scan = Scan.from_ranges([0.1, 0.11, 9.94, 9.96, 10.0], BEARINGS, range_min=0.1, range_max=10.0, range_noise=0.02)
    assert scan.beam.tolist() == [1, 2]
    assert (scan.range_min, scan.range_max, scan.range_noise) == (0.1, 10.0, 0.02)
    assert len(Scan.from_ranges([0.1, 0.11, 9.94, 9.96, 10.0], BEARINGS)) == 5  # unknown limits drop nothing


def test_a_negative_minimum_lets_no_negative_range_in() -> None:
    assert len(Scan.from_ranges([-0.5, 0.5], [0.0, 0.1], range_min=-1.0)) == 1


@pytest.mark.parametrize("ranges", [[], [np.nan, np.inf]])
def test_an_empty_scan_is_a_scan(ranges: list[float]) -> None:
    scan = Scan.from_ranges(ranges, np.arange(len(ranges)))
    assert len(scan) == 0
    assert scan.points.shape == (0, 2)
    assert not scan.is_closed
    assert scan.to_beams(np.zeros(0), 7.0).tolist() == [7.0] * len(ranges)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ranges": [[1.0]], "bearings": [0.0]}, r"ranges: expected shape \(N,\), got \(1, 1\)"),
        ({"ranges": [1.0, 2.0], "bearings": [0.0]}, r"bearings: expected shape \(2,\), got \(1,\)"),
        ({"ranges": [1.0, 2.0], "bearings": [[0.0, 1.0]]}, r"bearings: expected shape \(2,\), got \(1, 2\)"),
        ({"ranges": [1.0]}, "bearings: expected either bearings or both"),
        ({"ranges": [1.0], "angle_min": 0.0}, "bearings: expected either bearings or both"),
        ({"ranges": [1.0], "angle_increment": 0.1}, "bearings: expected either bearings or both"),
        ({"ranges": [1.0], "bearings": [0.0], "angle_min": 0.0, "angle_increment": 0.1}, "bearings: expected either"),
        ({"ranges": [1.0, 1.0], "bearings": [0.0, np.nan]}, "bearings: expected finite numbers, got 1 that are not"),
        ({"ranges": [1.0], "angle_min": "a", "angle_increment": 0.1}, "angle_min: expected a number of radians, got 'a'"),
        ({"ranges": [1.0], "bearings": [0.0], "range_min": "a"}, "range_min: expected a number of metres, got 'a'"),
        ({"ranges": [1.0], "bearings": [0.0], "range_max": [2.0]}, r"range_max: expected a number of metres, got \[2.0\]"),
        ({"ranges": [1.0], "bearings": [0.0], "time_increment": "a"}, "time_increment: expected a number of seconds, got 'a'"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scan.from_ranges(**arguments)


def test_equal_bearings_are_in_order() -> None:
    assert len(Scan.from_ranges([1.0, 2.0], [0.5, 0.5])) == 2


@pytest.mark.parametrize(("degrees", "is_closed"), [(180, False), (314, False), (316, True), (360, True)])
def test_a_scan_of_the_whole_circle_is_closed(degrees: float, is_closed: bool) -> None:
    scan = Scan.from_ranges(np.ones(91), np.radians(np.linspace(0, degrees, 91)))
    assert scan.is_closed is is_closed


def test_closed_counts_the_returns_not_the_beams() -> None:
    ranges = np.where(np.arange(360) < 180, 1.0, np.nan)
    assert not Scan.from_ranges(ranges, np.radians(np.arange(360))).is_closed


@given(st.lists(st.sampled_from([1.0, 2.5, np.nan, np.inf, 0.0]), max_size=12))
def test_values_of_points_go_back_to_their_beams(ranges: list[float]) -> None:
    scan = Scan.from_ranges(ranges, np.linspace(-1, 1, len(ranges)))
    back = scan.to_beams(scan.ranges, np.nan)
    assert back.shape == (len(ranges),)
    for given_range, kept in zip(ranges, back, strict=True):
        assert kept == given_range if given_range in (1.0, 2.5) else np.isnan(kept)


def test_to_beams_keeps_dtype_and_further_axes() -> None:
    scan = Scan.from_ranges([1.0, np.nan, 1.0], [0.0, 0.1, 0.2])
    assert scan.to_beams(np.array([[1, 2], [3, 4]]), -1).tolist() == [[1, 2], [-1, -1], [3, 4]]
    assert scan.to_beams(np.array([True, True]), False).tolist() == [True, False, True]


def test_a_scan_does_not_change() -> None:
    scan = Scan.from_ranges([1.0], [0.0])
    with pytest.raises(FrozenInstanceError):
        scan.n_beams = 2


# --- numbers that no sensor gives ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-200, 1e-9, 1e6, 1e12, 1e20, 1e38, 1e39, 1e300, np.inf])
def test_what_is_too_near_or_too_far_for_a_sensor_is_no_return(value: float) -> None:
    assert Scan.from_ranges([1.0, value, 2.0], [0.0, 0.1, 0.2]).beam.tolist() == [0, 2]
    assert len(Scan.from_ranges([value], [0.0])) == 0


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("range_noise", (np.nan, np.inf, -0.01, 1e39)),
        ("range_max", (np.nan, 0.0, -1.0)),
        ("range_min", (np.nan, np.inf, -np.inf)),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(name: str, values: tuple[float, ...]) -> None:
    for value in values:
        with pytest.raises(ValueError, match=rf"^{name}: expected .*, got {re.escape(str(value))}$"):
            Scan.from_ranges([1.0, 2.0], [0.0, 0.1], **{name: value})  # type: ignore[arg-type]


def test_limits_that_leave_nothing_between_them_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^range_max: expected more than range_min = 5.0, got 5.0$"):
        Scan.from_ranges([1.0, 2.0], [0.0, 0.1], range_min=5.0, range_max=5.0)
    assert len(Scan.from_ranges([1.0, 2.0], [0.0, 0.1], range_max=np.inf)) == 2  # no limit


def test_beams_that_all_go_one_way_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^angle_increment: expected radians from beam to beam, got 0$"):
        Scan.from_ranges([1.0, 2.0], angle_min=0.0, angle_increment=0.0)
    assert len(Scan.from_ranges([1.0], angle_min=0.0, angle_increment=0.0)) == 1


SCAN = Scan.from_ranges([1.0, np.nan, 3.0], [0.0, 0.1, 0.2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ranges": "a"}, "ranges: expected numbers"),
        ({"ranges": np.array([1.0, np.nan])}, "ranges: expected finite numbers, got nan"),
        ({"bearings": np.zeros(3)}, r"bearings: expected shape \(2,\), got \(3,\)"),
        ({"bearings": np.array([0.2, 0.0])}, "bearings: expected radians in rising order"),
        ({"beam": np.array([0, 3])}, "beam: expected distinct indices below n_beams = 3"),
        ({"beam": np.array([-1, 2])}, "beam: expected distinct indices"),
        ({"beam": np.array([2, 2])}, "beam: expected distinct indices"),
        ({"n_beams": 3.5}, "n_beams: expected a number from 0 to 20000, got 3.5"),
        ({"range_min": "a"}, "range_min: expected a number of metres, got 'a'"),
        ({"times": np.array([0.0, np.inf])}, "times: expected finite numbers, got inf"),
    ],
)
def test_a_scan_put_together_by_hand_is_checked(changes: dict, message: str) -> None:
    with pytest.raises(TorchCRFScanError, match=f"^{message}"):
        replace(SCAN, **changes)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"source": np.ones(3)}, "source: expected Scan, got ndarray"),
        ({"target": None}, "target: expected Scan, got NoneType"),
        ({"annotation": 3}, "annotation: expected Annotation or None, got int"),
        ({"name": Path("pair")}, "name: expected str, got PosixPath"),
        ({"dt": "0.1"}, "dt: expected a number of seconds, got '0.1'"),
        ({"dt": 0.0}, "dt: expected seconds between 1e-06 and 1e\\+09, got 0.0"),
        ({"initial_motion": "odometry"}, "initial_motion: expected numbers"),
        ({"initial_motion": [0.0, 1.0]}, r"initial_motion: expected shape \(3,\), got \(2,\)"),
        ({"initial_motion": [0.0, np.nan, 0.0]}, "initial_motion: expected finite numbers"),
        ({"initial_motion": [0.0, 1e7, 0.0]}, "initial_motion: expected finite numbers .* within 1e\\+06, got"),
    ],
)
def test_a_pair_is_checked(fields: dict, message: str) -> None:
    with pytest.raises(TorchCRFScanError, match=f"^{message}"):
        ScanPair(**{"source": SCAN, "target": SCAN} | fields)
