import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data import pair_file
from torchcrf_scan.data.pair_file import read_pair, read_prediction, write_pair, write_prediction
from torchcrf_scan.safe_names import UNPRINTABLE
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair

NO_RETURNS = (np.nan, np.inf, 0.0, -1.0, 0.05, 29.96, 30.0, 81.9)  # for range_min = 0.1, range_max = 30


def pair_arrays(n: int = 6, m: int = 5) -> dict[str, Any]:
    """A valid pair file with every key."""
    association = np.arange(n) % m
    association[-1] = -1
    cluster = np.where(association < 0, -1, np.arange(n) % 2)
    return {
        "source_ranges": np.linspace(2.0, 3.0, n),
        "source_bearings": np.linspace(-1.0, 1.0, n),
        "target_ranges": np.linspace(2.0, 4.0, m),
        "target_bearings": np.linspace(-1.0, 1.0, m),
        "dt": np.float64(0.2),
        "association": association,
        "cluster": cluster,
        "body": np.where(association < 0, 1, cluster),
        "motions": np.array([[0.1, 0.2, 0.3], [0.0, 1.0, 0.0]]),
        "ignore": np.arange(n) == 1,
        "range_min": np.float64(0.1),
        "range_max": np.float64(30.0),
        "range_noise": np.float64(0.01),
        "sequence": np.array("street"),
        "source": np.array("made up"),
    }


def prediction_arrays(n: int = 4) -> dict[str, Any]:
    return {
        "association": np.arange(n) - 1,
        "cluster": np.arange(n) % 2 - 1,
        "motions": np.zeros((1, 3)),
        "association_confidence": np.linspace(0, 1, n),
        "cluster_confidence": np.linspace(1, 0, n),
        "converged": np.array(True),
    }


def save(folder: Path, arrays: dict[str, Any]) -> Path:
    path = folder / "pair.npz"
    np.savez(path, **arrays)
    return path


def assert_same(one: Any, other: Any) -> None:
    """Equality of the package's dataclasses, field by field, NaN equal to NaN."""
    if dataclasses.is_dataclass(one):
        assert type(one) is type(other)
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    n = draw(st.integers(0, 12))
    valid = st.floats(0.2, 29.0)
    ranges = draw(st.lists(st.one_of(valid, valid, st.sampled_from(NO_RETURNS)), min_size=n, max_size=n))
    bearings = draw(st.lists(st.floats(-3.1, 3.1), min_size=n, max_size=n))
    return Scan.from_ranges(ranges, bearings, range_min=0.1, range_max=30.0, range_noise=None)


@st.composite
def pairs(draw: st.DrawFn) -> ScanPair:
    source, target = draw(scans()), draw(scans())
    annotation = draw(st.none() | annotations(source, target))
    text = st.text(st.characters(codec="utf-8", exclude_categories=tuple(UNPRINTABLE)), max_size=5)
    return ScanPair(source, target, draw(st.floats(0.01, 2.0)), annotation, draw(text), "pair", draw(text))


@st.composite
def annotations(draw: st.DrawFn, source: Scan, target: Scan) -> Annotation:
    n, clusters = source.n_beams, draw(st.integers(1, 3))
    states = st.sampled_from([-1, *target.beam.tolist()])
    is_return = source.to_beams(np.ones(len(source), bool), False)
    association = np.array([draw(states) if is_return[i] else -1 for i in range(n)], dtype=np.int64)
    labels = st.lists(st.integers(0, clusters - 1), min_size=n, max_size=n)
    cluster = np.where(association < 0, -1, np.array(draw(labels), dtype=np.int64))
    body = np.array(draw(labels), dtype=np.int64)
    motions = np.array(draw(st.lists(st.floats(-3.0, 3.0), min_size=3 * clusters, max_size=3 * clusters))).reshape(-1, 3)
    motions[draw(st.lists(st.booleans(), min_size=clusters, max_size=clusters))] = np.nan
    ignore = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)), dtype=bool) | ~is_return
    return Annotation(association, cluster, motions, body, ignore)


@given(pair=pairs())
def test_written_pair_reads_back(pair: ScanPair, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "pair.npz"
    write_pair(path, pair)
    assert_same(read_pair(path), pair)


@given(pair=pairs())
@settings(max_examples=30)
def test_same_content_gives_same_bytes(pair: ScanPair, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "pair.npz"
    write_pair(path, pair)
    first = path.read_bytes()
    os.utime(path, (0, 0))
    write_pair(path, read_pair(path))
    assert path.read_bytes() == first


def test_bytes_hold_no_time_of_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = read_pair(save(tmp_path, pair_arrays()))
    write_pair(tmp_path / "now.npz", pair)
    monkeypatch.setattr("time.time", lambda: 1.0e9)
    write_pair(tmp_path / "then.npz", pair)
    assert (tmp_path / "now.npz").read_bytes() == (tmp_path / "then.npz").read_bytes()


def test_reads_every_key(tmp_path: Path) -> None:
    pair = read_pair(save(tmp_path, pair_arrays()))
    assert (pair.name, pair.sequence, pair.origin, pair.dt) == ("pair", "street", "made up", 0.2)
    assert (pair.source.range_min, pair.source.range_max, pair.target.range_noise) == (0.1, 30.0, 0.01)
    assert pair.annotation is not None
    np.testing.assert_array_equal(pair.annotation.association, [0, 1, 2, 3, 4, -1])
    np.testing.assert_array_equal(pair.annotation.body, [0, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(pair.annotation.ignore, [False, True, False, False, False, False])


def test_indices_stay_those_of_the_file_where_returns_are_invalid(tmp_path: Path) -> None:
    arrays = pair_arrays()
    arrays["source_ranges"][[0, 3]] = np.nan, 30.0
    arrays["target_ranges"][1] = np.inf
    arrays["association"] = np.array([-1, 2, 4, -1, 4, -1])
    arrays["cluster"] = np.array([-1, 0, 1, -1, 1, -1])
    pair = read_pair(save(tmp_path, arrays))
    np.testing.assert_array_equal(pair.source.beam, [1, 2, 4, 5])
    np.testing.assert_array_equal(pair.target.beam, [0, 2, 3, 4])
    assert pair.annotation is not None
    np.testing.assert_array_equal(pair.annotation.association, arrays["association"])
    np.testing.assert_array_equal(pair.annotation.ignore, [True, True, False, True, False, False])


def test_defaults_of_missing_keys(tmp_path: Path) -> None:
    arrays = pair_arrays()
    for key in ("body", "ignore", "motions", "range_min", "range_max", "range_noise", "sequence", "source"):
        del arrays[key]
    pair = read_pair(save(tmp_path, arrays))
    assert pair.annotation is not None
    np.testing.assert_array_equal(pair.annotation.body, arrays["cluster"])
    assert not pair.annotation.ignore.any()
    assert pair.annotation.motions.shape == (2, 3)
    assert np.isnan(pair.annotation.motions).all()
    assert (pair.source.range_min, pair.source.range_max, pair.source.range_noise) == (None, None, None)
    assert (pair.sequence, pair.origin) == ("", "")


def test_scans_alone_are_a_pair_without_annotation(tmp_path: Path) -> None:
    arrays = pair_arrays()
    del arrays["association"], arrays["cluster"]
    assert read_pair(save(tmp_path, arrays)).annotation is None


def test_unknown_keys_are_ignored(tmp_path: Path) -> None:
    with_more = pair_arrays() | {"camera": np.array([{"not": "plain"}], dtype=object)}
    assert read_pair(save(tmp_path, with_more)).annotation is not None


def test_other_widths_of_numbers_are_accepted(tmp_path: Path) -> None:
    arrays = pair_arrays()
    arrays["association"] = arrays["association"].astype(np.int16)
    arrays["source_ranges"] = arrays["source_ranges"].astype(">f4")
    pair = read_pair(save(tmp_path, arrays))
    assert pair.source.ranges.dtype == np.float64
    assert pair.annotation is not None
    assert pair.annotation.association.dtype == np.int64


WRONG: list[tuple[str, Any, str]] = [
    ("source_ranges", np.ones((6, 1)), r"shape \(N\), got \(6, 1\)"),
    ("source_ranges", np.ones(6, complex), "dtype float, got complex128"),
    ("source_bearings", np.ones(5), r"shape \(6\), got \(5,\)"),
    ("source_bearings", np.array([0, 1, 2, np.nan, 3, 4]), "finite bearings, got nan at index 3"),
    ("target_bearings", np.arange(-2.0, 3.0) * 90, r"radians of one turn, got a span of 360.0; are these degrees\?"),
    ("dt", np.float64(0.0), "seconds between 1e-06 and 1e\\+09, got 0.0"),
    ("dt", np.float64(np.inf), "got inf"),
    ("dt", np.ones(1), r"shape \(\), got \(1,\)"),
    ("association", np.ones(6), "dtype int, got float64"),
    ("association", np.array([0, 1, 2, 3, 5, -1]), r"labels in \[-1, 5\), got 5 at index 4"),
    ("association", np.array([0, 1, 2, 3, -2, -1]), "got -2 at index 4"),
    ("cluster", np.array([0, 1, 0, 1, 0, 0]), "-1 exactly where association is -1, got 0 at index 5"),
    ("cluster", np.array([0, 1, -1, 1, 0, -1]), "-1 exactly where association is -1, got -1 at index 2"),
    ("cluster", np.array([0, 1, 2, 1, 0, -1]), r"labels in \[-1, 2\), got 2 at index 2"),
    ("body", np.array([0, 1, 0, 1, 0, 2]), r"labels in \[-1, 2\), got 2 at index 5"),
    ("motions", np.zeros((2, 4)), r"shape \(K\+1, 3\), got \(2, 4\)"),
    ("motions", np.zeros((0, 3)), "at least the background's row"),
    ("motions", np.array([[0, 0, 0], [0, np.nan, 0]]), "finite or all NaN"),
    ("ignore", np.zeros(6, int), "dtype bool, got int64"),
    ("range_min", np.float64(-1.0), "at least 0.0, got -1.0"),
    ("range_max", np.float64(0.1), "more than range_min = 0.1, got 0.1"),
    ("range_max", np.float64(np.nan), "a finite number"),
    ("range_noise", np.float64(-0.1), "at least 0.0"),
    ("sequence", np.array(3), "dtype str, got int64"),
    ("source", np.array(["a", "b"]), r"shape \(\), got \(2,\)"),
]


@pytest.mark.parametrize(("key", "value", "message"), WRONG)
def test_error_names_file_key_expected_and_got(tmp_path: Path, key: str, value: Any, message: str) -> None:
    path = save(tmp_path, pair_arrays() | {key: value})
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected .*{message}"):
        read_pair(path)


@pytest.mark.parametrize(
    "key", ["source_ranges", "source_bearings", "target_ranges", "target_bearings", "dt", "association", "cluster"]
)
def test_missing_key_is_named(tmp_path: Path, key: str) -> None:
    arrays = pair_arrays()
    del arrays[key]
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected this key"):
        read_pair(save(tmp_path, arrays))


@pytest.mark.parametrize(
    ("key", "index", "message"), [("source_ranges", 2, "without a valid return"), ("target_ranges", 4, "valid returns")]
)
def test_association_needs_valid_returns(tmp_path: Path, key: str, index: int, message: str) -> None:
    arrays = pair_arrays()
    arrays[key][index] = np.nan
    with pytest.raises(ValueError, match=f"pair.npz: association: expected .*{message}"):
        read_pair(save(tmp_path, arrays))


def test_object_array_is_refused(tmp_path: Path) -> None:
    arrays = pair_arrays() | {"association": np.array([None] * 6, dtype=object)}
    with pytest.raises(ValueError, match=r"pair.npz: expected a complete .npz archive without object arrays"):
        read_pair(save(tmp_path, arrays))


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04", b"\x93NUMPY"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "pair.npz"
    path.write_bytes(content)
    for read in (read_pair, read_prediction):
        with pytest.raises(ValueError, match=r"pair.npz: expected a complete .npz archive"):
            read(path)


def test_single_array_file_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "pair.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"pair.npy: expected a complete .npz archive"):
        read_pair(tmp_path / "pair.npy")


@given(data=st.data())
@settings(max_examples=100)
def test_damage_is_a_value_error_or_harmless(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = save(tmp_path_factory.getbasetemp(), pair_arrays())
    content = bytearray(path.read_bytes())
    where = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:where]
    else:
        content[where] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        pair = read_pair(path)
    except ValueError as error:
        named = "pair.npz" in str(error)
    else:
        named = len(pair.source) == 6
    assert named


def test_missing_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_pair(tmp_path / "none.npz")


def test_refused_pair_leaves_nothing_behind(tmp_path: Path) -> None:
    pair = read_pair(save(tmp_path, pair_arrays()))
    assert pair.annotation is not None
    short = dataclasses.replace(pair.annotation, cluster=np.zeros(2, int))
    for wrong in ({"annotation": short}, {"target": dataclasses.replace(pair.target, range_max=20.0)}):
        with pytest.raises(ValueError, match=r"new\.npz"):
            write_pair(tmp_path / "new.npz", dataclasses.replace(pair, **wrong))
    assert [file.name for file in tmp_path.iterdir()] == ["pair.npz"]


def test_interrupted_writing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path, pair_arrays())
    before, pair = path.read_bytes(), read_pair(path)

    def fail(file: Any, **arrays: Any) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(pair_file.np, "savez", fail)
    with pytest.raises(KeyboardInterrupt):
        write_pair(path, pair)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["pair.npz"]


def test_beams_in_any_order(tmp_path: Path) -> None:
    """The annotation counts the beams of the file, as predictions do."""
    arrays = pair_arrays()
    right = read_pair(save(tmp_path, arrays))
    for side, order in (("source", np.array([3, 0, 5, 1, 4, 2])), ("target", np.arange(5)[::-1])):
        arrays |= {f"{side}_{key}": arrays[f"{side}_{key}"][order] for key in ("ranges", "bearings")}
    there = np.append(np.arange(5)[::-1], -1)  # where a target beam is now
    order = np.array([3, 0, 5, 1, 4, 2])
    arrays |= {key: arrays[key][order] for key in ("association", "cluster", "body", "ignore")}
    arrays["association"] = there[arrays["association"]]
    pair = read_pair(save(tmp_path, arrays))
    for side in ("source", "target"):
        np.testing.assert_array_equal(getattr(pair, side).points, getattr(right, side).points)
    assert pair.annotation is not None
    assert right.annotation is not None
    np.testing.assert_array_equal(pair.annotation.cluster[pair.source.beam], right.annotation.cluster)
    batches = [ScanPairBatch.collate([one]).truth for one in (pair, right)]
    assert torch.equal(batches[0].association, batches[1].association)
    write_pair(tmp_path / "again.npz", pair)
    with np.load(tmp_path / "again.npz") as file:
        for key in ("source_ranges", "source_bearings", "target_bearings", "association", "cluster"):
            np.testing.assert_array_equal(file[key], arrays[key])


def test_bearings_of_dropped_beams_are_interpolated(tmp_path: Path) -> None:
    scan = Scan.from_ranges([np.nan, 1.0, np.nan, 1.0, np.nan], [-2.0, -1.0, 0.5, 1.0, 2.0])
    write_pair(tmp_path / "pair.npz", ScanPair(scan, scan))
    with np.load(tmp_path / "pair.npz") as file:
        np.testing.assert_allclose(file["source_bearings"], [-1.0, -1.0, 0.0, 1.0, 1.0])
        np.testing.assert_array_equal(np.isnan(file["target_ranges"]), [True, False, True, False, True])


def test_written_prediction_reads_back(tmp_path: Path) -> None:
    arrays = prediction_arrays() | {"motions": np.array([[0.1, 1.0, 2.0], [np.nan] * 3]), "converged": False}
    prediction = PairPrediction(**arrays)
    write_prediction(tmp_path / "pair.npz", prediction)
    assert_same(read_prediction(tmp_path / "pair.npz"), prediction)
    first = (tmp_path / "pair.npz").read_bytes()
    write_prediction(tmp_path / "pair.npz", prediction)
    assert (tmp_path / "pair.npz").read_bytes() == first


@pytest.mark.parametrize("key", list(prediction_arrays()))
def test_missing_key_of_a_prediction_is_named(tmp_path: Path, key: str) -> None:
    arrays = prediction_arrays()
    del arrays[key]
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected this key"):
        read_prediction(save(tmp_path, arrays))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("association", np.array([-2, 0, 1, 2])),
        ("cluster", np.array([-1, 0, 1, 0])),
        ("cluster", np.array([-1, 0, 0])),
        ("motions", np.array([[0.0, np.inf, 0.0]])),
        ("association_confidence", np.array([0.0, 0.5, 1.5, 1.0])),
        ("cluster_confidence", np.array([0.0, 0.5, np.nan, 1.0])),
        ("converged", np.array(1)),
    ],
)
def test_wrong_prediction_is_refused_both_ways(tmp_path: Path, key: str, value: Any) -> None:
    arrays = prediction_arrays() | {key: value}
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected"):
        read_prediction(save(tmp_path, arrays))
    with pytest.raises(ValueError, match=f"new.npz: {key}: expected"):
        write_prediction(tmp_path / "new.npz", PairPrediction(**arrays))
    assert not (tmp_path / "new.npz").exists()


def certainty_arrays(clusters: int = 1) -> dict[str, Any]:
    return {
        "covariances": np.arange(9.0 * clusters).reshape(clusters, 3, 3),
        "unobserved_turn": np.arange(clusters) % 2 == 1,
        "unobserved_shift": np.linspace(-1, 1, 2 * clusters).reshape(clusters, 2),
    }


@pytest.mark.parametrize("clusters", [1, 3])
def test_written_certainty_reads_back(tmp_path: Path, clusters: int) -> None:
    arrays = prediction_arrays() | {"motions": np.zeros((clusters, 3)), "converged": False} | certainty_arrays(clusters)
    prediction = PairPrediction(**arrays)
    write_prediction(tmp_path / "pair.npz", prediction)
    assert_same(read_prediction(tmp_path / "pair.npz"), prediction)


def test_without_certainty_there_is_none_in_the_file(tmp_path: Path) -> None:
    write_prediction(tmp_path / "pair.npz", PairPrediction(**prediction_arrays() | {"converged": True}))
    with np.load(tmp_path / "pair.npz") as file:
        assert not set(certainty_arrays()) & set(file)
    found = read_prediction(tmp_path / "pair.npz")
    assert (found.covariances, found.unobserved_turn, found.unobserved_shift) == (None, None, None)


@pytest.mark.parametrize("key", list(certainty_arrays()))
def test_certainty_is_whole_or_not_at_all(tmp_path: Path, key: str) -> None:
    arrays = prediction_arrays() | certainty_arrays()
    del arrays[key]
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected this key"):
        read_prediction(save(tmp_path, arrays))
    with pytest.raises(ValueError, match=f"new.npz: {key}: expected this key"):
        write_prediction(tmp_path / "new.npz", PairPrediction(**arrays))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("covariances", np.zeros((2, 3, 3)), r"shape \(1, 3, 3\), got \(2, 3, 3\)"),
        ("covariances", np.zeros((1, 3)), r"shape \(1, 3, 3\), got \(1, 3\)"),
        ("covariances", np.full((1, 3, 3), np.inf), "finite covariances, got inf"),
        ("covariances", np.zeros((1, 3, 3), dtype=bool), "dtype float, got bool"),
        ("unobserved_turn", np.zeros(2, dtype=bool), r"shape \(1\), got \(2,\)"),
        ("unobserved_turn", np.zeros(1), "dtype bool, got float64"),
        ("unobserved_shift", np.zeros(2), r"shape \(1, 2\), got \(2,\)"),
        ("unobserved_shift", np.full((1, 2), np.nan), "finite directions, got nan"),
    ],
)
def test_wrong_certainty_is_refused_both_ways(tmp_path: Path, key: str, value: Any, message: str) -> None:
    arrays = prediction_arrays() | certainty_arrays() | {key: value}
    with pytest.raises(ValueError, match=f"pair.npz: {key}: expected {message}"):
        read_prediction(save(tmp_path, arrays))
    with pytest.raises(ValueError, match=f"new.npz: {key}: expected {message}"):
        write_prediction(tmp_path / "new.npz", PairPrediction(**arrays))
    assert not (tmp_path / "new.npz").exists()


def test_real_pairs_survive_reading_and_writing(real_pairs_dir: Path, tmp_path: Path) -> None:
    for path in sorted(real_pairs_dir.glob("*.npz")):
        pair = read_pair(path)
        assert pair.annotation is not None
        with np.load(path) as file:
            assert len(pair.source) == len(file["source_ranges"])
            np.testing.assert_array_equal(pair.annotation.cluster, file["cluster"])
        write_pair(tmp_path / path.name, pair)
        assert_same(read_pair(tmp_path / path.name), pair)
