"""The parser of all settings: every wrong value ends in one message and no file unfolds without bound."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonargparse import ArgumentError

from torchcrf_scan.data.bounded_yaml import DEEPEST, MOST_VALUES, check_size
from torchcrf_scan.experiment.parser import config_of, load_yaml, settings_parser
from torchcrf_scan.experiment.settings import RunConfig


def parse(*arguments: str) -> RunConfig:
    parser = settings_parser(exit_on_error=False)
    return config_of(parser.instantiate(parser.parse_args(list(arguments))))


def laughs(levels: int) -> str:
    """A text of a few lines whose aliases unfold to 9 to the power of levels."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join(9 * [f'*a{k - 1}'])}]" for k in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--learning.batch_size=0", r"learning\.batch_size: expected a whole number in \[1, 10000\], got 0"),
        ("--learning.batch_size=-3", r"learning\.batch_size: expected a whole number in \[1, 10000\], got -3"),
        ("--learning.negatives=-1", r"learning\.negatives: expected a whole number in \[1, 1000\], got -1"),
        ("--learning.prior=0", r"learning\.prior: expected a finite number above 0, got 0"),
        ("--model.features.stumps=0", r"stumps: expected a whole number in \[1, 10000\], got 0"),
        ("--model.features.stumps=-1", r"stumps: expected a whole number in \[1, 10000\], got -1"),
        ("--model.inference.clusters=100", r"clusters: expected a whole number in \[2, 32\], got 100"),
        ("--model.inference.candidates=10000", r"candidates: expected a whole number in \[0, 256\], got 10000"),
        ("--model.inference.temperature=1e999", "temperature: expected a finite number, 0 or more, got inf"),
        ("--data.pairs=0", r"data\.pairs: expected a whole number in \[1, 100000\], got 0"),
        ("--data.seed=-1", r"data\.seed: expected a whole number in \[0, 2147483647\], got -1"),
        ("--data.simulate_train=[moon]", r"data\.simulate_train: expected one of street, .*, got moon"),
        ("--unrolled.temperature=0", r"unrolled\.temperature: expected a finite number above 0, got 0"),
        ("--experiment.leave_out=[clustering.dist1]", r"experiment\.leave_out: expected one of .*, got clustering\.dist1"),
    ],
)
def test_a_value_out_of_bounds_is_named(argument: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(argument)


@pytest.mark.parametrize("argument", ["--data.pairs=2.5", "--gradient.clip=nan", "--learning.prior=inf", "--data.pairs=many"])
def test_a_value_of_another_type_is_named(argument: str) -> None:
    with pytest.raises(ArgumentError, match=argument.removeprefix("--").split("=")[0]):
        parse(argument)


def test_whole_numbers_are_taken_for_fractions() -> None:
    inference = parse("--model.inference.rotation_tolerance=0", "--model.inference.min_extent=1").model.inference
    assert (inference.rotation_tolerance, inference.min_extent) == (0.0, 1.0)
    assert {type(inference.rotation_tolerance), type(inference.min_extent)} == {float}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (laughs(10) + "\ndata: {train: *a9}\n", f"expected at most {MOST_VALUES} values"),
        ("data: {train: &a [*a]}", f"expected at most {MOST_VALUES} values"),
        ("data: {train: " + 100_000 * "[" + 100_000 * "]" + "}", f"{DEEPEST} levels deep"),
        ("- a\n", "Unexpected config"),
        ("data: [\n", "Problems parsing config"),
    ],
)
def test_a_file_that_is_no_settings_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file.yaml").write_text(text)
    with pytest.raises(ArgumentError, match=message):
        parse(f"--config={tmp_path / 'file.yaml'}")


def test_a_file_of_other_bytes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file.yaml").write_bytes(b"data: \xff\n")
    with pytest.raises(ArgumentError, match="expected a text, got 'utf-8' codec can't decode byte 0xff"):
        parse(f"--config={tmp_path / 'file.yaml'}")


def test_aliases_within_bounds_are_read() -> None:
    assert load_yaml("a: &a [1, 2]\nb: [*a, *a]") == {"a": [1, 2], "b": [[1, 2], [1, 2]]}
    check_size(laughs(4))
    with pytest.raises(yaml.YAMLError, match="aliases written out"):
        check_size(laughs(5))


def unfolded(value: object) -> int:
    """Values of a text, counted one by one."""
    parts = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    return 1 + sum(map(unfolded, parts))


values = st.recursive(
    st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
    max_leaves=30,
)


@given(values, st.integers(1, 300))
def test_a_text_is_refused_exactly_where_it_has_too_many_values(value: object, times: int) -> None:
    shared = [value] if isinstance(value, int | str) else value
    text = yaml.safe_dump(times * [shared])  # once written out, then by aliases
    if 1 + times * unfolded(shared) > MOST_VALUES:
        with pytest.raises(yaml.YAMLError, match="aliases written out"):
            check_size(text)
    else:
        check_size(text)
