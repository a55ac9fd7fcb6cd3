"""Layouts: an example's is what it fits, and nothing that differs in type, order or shape."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from torchcrf_scan.loops.layout import class_of, fits, layout_of, layouts_of


class Place(NamedTuple):
    """An example."""

    at: np.ndarray
    turn: float
    count: int


PLACE = Place(np.zeros((3, 2)), 1, 2)


def test_a_fraction_is_allowed_where_the_annotation_says_so() -> None:
    assert layout_of(PLACE) == [f"{__name__}:Place", "float64:2", "float", "int"]

    def kernel(turn: float, count: int, is_closed: bool) -> float:
        return turn * count * is_closed

    assert layouts_of(kernel, (1, 2, True)) == ["float", "int", "bool"]


VALUES = (1.5, 2, True, np.zeros(3), np.zeros((0, 2), np.int64), np.ones(2, bool), (1, np.zeros(1)), PLACE)


@pytest.mark.parametrize("value", VALUES)
def test_a_value_fits_its_own_layout(value: Any) -> None:
    assert fits(layout_of(value))(value)


@pytest.mark.parametrize(
    ("layout", "value"),
    [
        ("int", 1.5),
        ("float", "1.5"),
        ("float64:1", [1.0]),
        ("float64:2", np.zeros(4)),
        ("float64:2", np.zeros((2, 3), order="F")),
        ("float64:1", np.zeros(4, ">f8")),
        ("int64:1", np.zeros(4, np.int32)),
        (["", "int", "int"], (1, 2, 3)),
        (["", "int", "int"], [1, 2]),
        (layout_of(PLACE), tuple(PLACE)),
        (layout_of(PLACE), PLACE._replace(at=np.zeros((2, 3)).T)),
    ],
)
def test_other_values_do_not_fit(layout: Any, value: Any) -> None:
    assert not fits(layout)(value)


def test_what_kernels_do_not_take_has_no_layout() -> None:
    with pytest.raises(TypeError, match="got list"):
        layout_of([1.0])


def test_the_class_of_a_tuple_is_found_by_its_name() -> None:
    assert class_of(layout_of(PLACE)[0]) is Place
    assert class_of("") is tuple


def test_what_fitted_before_is_known_by_what_it_is_not_by_its_equal() -> None:
    check = fits(layout_of(PLACE))
    for _ in range(30):
        good, bad = PLACE._replace(count=3), PLACE._replace(count=3, at=np.zeros(3))
        assert check(good)
        assert check(good)
        assert not check(bad)
    assert not check(None)
