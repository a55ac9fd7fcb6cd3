"""Fields are converted and checked where settings are made, and every error tells name, expected and got."""

import math
from dataclasses import asdict, dataclass, field, fields
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.checks import Amount, AtMost, OneOf, Positive, Share, Within, check_fields, from_values


@dataclass(frozen=True)
class Inner:
    depth: Annotated[int, Within(1, 9)] = 1


@dataclass(frozen=True)
class Outer:
    count: Annotated[int, Within(2, 100)] = 2
    share: Share = 0.5
    amount: Amount = 1.0
    width: Positive = 1.0
    part: Annotated[float, Within(0, 1, below=True)] = 0.0
    free: float = 0.0
    is_on: bool = False
    kind: Annotated[str, OneOf("one", "other")] = "one"
    names: tuple[Annotated[str, OneOf("a", "b")], ...] = ()
    sizes: Annotated[tuple[Annotated[int, Within(1)], ...], AtMost(3)] = (1,)
    files: tuple[str, ...] | str = ()
    maybe: float | None = None
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        check_fields(self, "outer.")


def refusal(**values: Any) -> str:
    with pytest.raises(ValueError, match=r"^outer\.") as caught:
        Outer(**values)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("count", 1, "a whole number in [2, 100], got 1"),
        ("count", 101, "a whole number in [2, 100], got 101"),
        ("count", 2.5, "a whole number in [2, 100], got 2.5"),
        ("count", 3.0, "a whole number in [2, 100], got 3.0"),
        ("count", True, "a whole number in [2, 100], got True"),
        ("count", "3", "a whole number in [2, 100], got 3"),
        ("count", None, "a whole number in [2, 100], got None"),
        ("share", 1.5, "a finite number in [0, 1], got 1.5"),
        ("share", math.nan, "a finite number in [0, 1], got nan"),
        ("share", True, "a finite number in [0, 1], got True"),
        ("share", 1j, "a finite number in [0, 1], got 1j"),
        ("amount", -1, "a finite number, 0 or more, got -1"),
        ("amount", math.inf, "a finite number, 0 or more, got inf"),
        ("width", 0, "a finite number above 0, got 0"),
        ("part", 1, "a finite number in [0, 1), got 1"),
        ("free", -math.inf, "a finite number, got -inf"),
        ("free", [1.0], "a finite number, got [1.0]"),
        ("is_on", 1, "true or false, got 1"),
        ("is_on", "yes", "true or false, got yes"),
        ("kind", "third", "one of one, other, got third"),
        ("kind", 3, "one of one, other, got 3"),
        ("kind", ["one"], "one of one, other, got ['one']"),
        ("names", "a", "a list, got a"),
        ("names", ["a", "c"], "one of a, b, got c"),
        ("names", None, "a list, got None"),
        ("sizes", [1, 0], "a whole number, 1 or more, got 0"),
        ("sizes", [1, 1, 1, 1], "a list of at most 3, got [1, 1, 1, 1]"),
        ("sizes", 1, "a list of at most 3, got 1"),
        ("files", 3, "a list or a text, got 3"),
        ("files", ["a", 3], "a text, got 3"),
        ("maybe", "x", "a finite number or nothing, got x"),
        ("inner", {"depth": 1}, "settings (Inner), got {'depth': 1}"),
    ],
)
def test_a_wrong_value_is_told_in_full(name: str, value: object, message: str) -> None:
    assert refusal(**{name: value}) == f"outer.{name}: expected {message}"


def test_a_long_value_is_told_in_short() -> None:
    assert len(refusal(free="x" * 10_000)) < 200
    assert "a finite number, got 1000" in refusal(free=10**400)  # no float holds it


@pytest.mark.parametrize("number", [1, np.int32(1), np.float32(1.0), np.float64(1.0), Fraction(1), 1.0])
def test_numbers_become_those_of_python(number: Any) -> None:
    found = Outer(share=number, amount=number)
    assert (type(found.share), type(found.amount)) == (float, float)
    assert found == Outer(share=1.0, amount=1.0)


def test_whole_numbers_flags_and_lists_become_those_of_python() -> None:
    found = Outer(count=np.int64(3), is_on=np.bool_(True), names=["a", "b"], sizes=[np.int8(4)], files=["x"])  # type: ignore[arg-type]
    assert found == Outer(count=3, is_on=True, names=("a", "b"), sizes=(4,), files=("x",))
    assert (type(found.count), type(found.is_on), type(found.sizes[0])) == (int, bool, int)
    assert Outer(files="x").files == "x"


def test_a_number_that_no_computation_is_made_with_is_refused() -> None:
    assert "a finite number" in refusal(free=Decimal(1))  # not a Real


@given(st.floats())
def test_a_float_is_kept_exactly_where_it_is_allowed(value: float) -> None:
    allowed = {
        "free": math.isfinite(value),
        "amount": 0 <= value < math.inf,
        "width": 0 < value < math.inf,
        "share": 0 <= value <= 1,
        "part": 0 <= value < 1,
    }
    for name, is_allowed in allowed.items():
        if is_allowed:
            assert getattr(Outer(**{name: value}), name) == value  # type: ignore[arg-type]
        else:
            assert refusal(**{name: value}).endswith(f"got {value!r}")


@given(st.integers())
def test_a_whole_number_is_kept_exactly_where_it_is_allowed(value: int) -> None:
    if 2 <= value <= 100:
        assert Outer(count=value).count == value
    else:
        assert "outer.count: expected a whole number in [2, 100]" in refusal(count=value)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(st.sampled_from([of.name for of in fields(Outer)]), anything)
def test_whatever_a_file_holds_is_settings_or_a_value_error(name: str, value: object) -> None:
    try:
        made = from_values(Outer, {name: value}, "file")
    except ValueError as error:
        assert ": expected " in str(error)  # noqa: PT017
    else:
        assert from_values(Outer, asdict(made), "file") == made


def test_settings_come_back_from_their_dictionary() -> None:
    settings = Outer(count=7, names=("b",), inner=Inner(4))
    assert from_values(Outer, {**asdict(settings), "names": ["b"]}, "file") == settings
    assert from_values(Outer, {}, "file") == Outer()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], r"file: expected settings by name, got \[\]"),
        ({"speed": 3}, "file: expected settings among count, .*, inner, got speed"),
        ({"inner": {"speed": 3}}, "inner: expected settings among depth, got speed"),
        ({"inner": []}, r"inner: expected settings by name, got \[\]"),
        ({"inner": None}, "inner: expected settings by name, got None"),
    ],
)
def test_a_dictionary_of_something_else_is_refused(values: object, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        from_values(Outer, values, "file")
