"""Whatever is given, there is an answer of finite numbers or a `TorchCRFScanError`: a few seconds of it."""

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutants import Target, assert_finite, log_targets, model, mutated, other_targets, pair_targets, use_log
from small_files import PAIR, bags, carmen, csv, pair_bytes

from torchcrf_scan import InferenceConfig, Scan, TorchCRFScanError
from torchcrf_scan.checks import from_values
from torchcrf_scan.config import ModelConfig

CONFIGS = Path(__file__).parents[1] / "configs"
TRIES = 4  # of every kind of file

number = st.floats() | st.sampled_from([0.0, -1.0, 1.0, 5.0, 1e6, 1e20, 1e38, 1e39, 1e300, 5e-324])
ranges = st.lists(st.floats(0.05, 60) | number, max_size=40)
options = st.fixed_dictionaries(
    {}, optional=dict.fromkeys(("range_min", "range_max", "range_noise", "time_increment", "angle_increment"), number)
)


def made(values: list[float], more: dict[str, float]) -> Scan | None:
    geometry = {"angle_min": -1.5, "angle_increment": 3.0 / max(len(values), 1)} | more
    try:
        return Scan.from_ranges(values, **geometry)  # type: ignore[arg-type]
    except TorchCRFScanError:
        return None


@given(ranges, options)
def test_numbers_make_a_scan_or_are_refused(values: list[float], more: dict[str, float]) -> None:
    scan = made(values, more)
    if scan is not None:
        assert np.isfinite(scan.points).all()
        assert scan.times is None or np.isfinite(scan.times).all()


@settings(max_examples=30)
@given(ranges, ranges, options, number | st.just(0.1), st.none() | st.lists(number, min_size=3, max_size=3))
def test_any_two_scans_have_a_finite_answer(
    source: list[float], target: list[float], more: dict[str, float], dt: float, guess: list[float] | None
) -> None:
    scans = [scan for scan in (made(source, more), made(target, {})) if scan is not None]
    if len(scans) == 2:
        try:
            assert_finite(model().match(*scans, dt, initial_motion=guess))
        except TorchCRFScanError as error:
            assert str(error).startswith(("dt: ", "initial_motion: "))  # noqa: PT017


@pytest.mark.parametrize("ranges", [[1.0], [1.0, 1.0, 1.0], [3.0, 2.0, 1.0], [1e-30, 1e-30, 1.0]])
def test_returns_in_one_direction_have_a_finite_answer(ranges: list[float]) -> None:
    scan = Scan.from_ranges(ranges, np.full(len(ranges), 0.5))
    for other in (scan, Scan.from_ranges([1.0, 2.0, 2.0], [0.0, 0.1, 0.2])):
        assert_finite(model().match(scan, other))
        assert_finite(model().match(other, scan))


@settings(max_examples=20)
@given(st.lists(st.floats(-1e30, 1e30) | number, min_size=3, max_size=20))
def test_a_scan_made_by_hand_is_checked_too(values: list[float]) -> None:
    points = np.array(values)
    try:
        scan = Scan(points, np.linspace(-1, 1, len(points)), np.arange(len(points)), len(points))
        assert_finite(model().match(scan, scan))
    except TorchCRFScanError as error:
        assert "within 1e+06" in str(error) or str(error).startswith("ranges: expected finite numbers")  # noqa: PT017


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(st.sampled_from([*ModelConfig.__dataclass_fields__]), anything, max_size=3))
def test_anything_makes_a_config_or_is_refused(values: dict[str, Any]) -> None:
    try:
        assert isinstance(from_values(ModelConfig, values, "model"), ModelConfig)
    except TorchCRFScanError as error:
        assert ": expected " in str(error)  # noqa: PT017


@settings(max_examples=15)
@given(
    st.fixed_dictionaries(
        {},
        optional={"clusters": st.integers(2, 9), "candidates": st.integers(0, 20), "iterations": st.integers(0, 4)}
        | {name: st.floats(0) for name in ("min_extent", "rotation_tolerance", "translation_tolerance", "outlier_distance")},
    )
)
def test_settings_that_are_taken_give_finite_answers(values: dict[str, Any]) -> None:
    try:
        config = model().config
        limit = InferenceConfig(**{"clusters": config.inference.clusters} | values)
    except TorchCRFScanError:
        return
    changed = type(model()).from_pretrained(**{name: getattr(limit, name) for name in values if name != "clusters"})
    assert_finite(changed.match(PAIR.source, PAIR.target))


def targets(kind: str, folder: Path) -> list[Target]:
    if kind == "pair":
        return list(pair_targets("pair.npz", pair_bytes(folder)))
    if kind == "log":
        return [*log_targets("a.log", carmen()), *log_targets("a.csv", csv())]
    if kind == "bag":
        pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")
        return [Target(name, data, use_log, mutated) for name, data in bags(folder)]
    return list(other_targets(PAIR, CONFIGS))


@pytest.mark.parametrize("kind", ["pair", "log", "bag", "other"])
def test_a_mutated_file_is_answered_or_refused(kind: str, tmp_path: Path) -> None:
    random, outcomes = Random(0), []
    folder = tmp_path / "mutants"
    folder.mkdir()
    for target in targets(kind, tmp_path):
        outcomes += [target.attempt(folder, random) for _ in range(TRIES)]
    assert set(outcomes) == {"answered", "refused"}


def test_what_is_not_mutated_is_answered(tmp_path: Path) -> None:
    for kind in ("pair", "log", "other"):
        for target in targets(kind, tmp_path):
            target.mutate = lambda data, random: data
            assert target.attempt(tmp_path, Random(0)) == "answered", target.name
