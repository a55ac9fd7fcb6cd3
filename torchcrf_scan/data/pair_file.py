"""Pair files and prediction files: one `.npz` of plain arrays per scan pair, the interface to other programs.

A pair file holds `source_ranges`, `source_bearings` (N,), `target_ranges`, `target_bearings` (M,), `dt` and, optionally, the
annotation (`association`, `cluster`, `body`, `ignore` (N,), `motions` (K+1, 3)), the sensor (`range_min`, `range_max`,
`range_noise`) and the texts `sequence` and `source` (`ScanPair.origin`). A prediction file holds the fields of `PairPrediction`.
Both count beams: an index is an entry of the file's arrays, in their order, whatever it is, including invalid returns. Unknown
keys are ignored.

Writing is atomic and checked by the reader's own rules; the same content gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from torchcrf_scan.data.archive import read_arrays
from torchcrf_scan.data.options import AS_RECORDED, ReadOptions
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.safe_names import check_name
from torchcrf_scan.scan import OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction, Scan, ScanPair, check_sensor
from torchcrf_scan.whole_file import whole_file

_KINDS: dict[str, tuple[str, type]] = {
    "float": ("fiu", np.float64),
    "int": ("iu", np.int64),
    "bool": ("b", np.bool_),
    "str": ("U", np.str_),
}

_SENSOR_KEYS = ("range_min", "range_max", "range_noise")
_SCAN_KEYS = ("source_ranges", "source_bearings", "target_ranges", "target_bearings", "dt")
_ANNOTATION_KEYS = ("association", "cluster", "motions", "body", "ignore")
_TEXT_KEYS = ("sequence", "source")
_PAIR_KEYS = _SCAN_KEYS + _ANNOTATION_KEYS + _SENSOR_KEYS + _TEXT_KEYS
_CERTAINTY_KEYS = ("covariances", "unobserved_turn", "unobserved_shift")  # all of them or none
_PREDICTION_KEYS = ("association", "cluster", "motions", "association_confidence", "cluster_confidence", "converged")


@dataclass(frozen=True, slots=True)
class _Fields:
    """The arrays of one file with their checks: every error names file, key, expected and actual value."""

    path: Path
    arrays: dict[str, NDArray[Any]]

    def __contains__(self, key: str) -> bool:
        return key in self.arrays

    def fail(self, key: str, expected: str, got: object) -> NoReturn:
        raise TorchCRFScanError(f"{self.path}: {key}: expected {expected}, got {got}")

    def get(self, key: str, kind: str, *shape: int | str) -> NDArray[Any]:
        """The array `key` of a given kind of number and shape (a name fits any length), converted to the package's dtype."""
        if key not in self.arrays:
            self.fail(key, "this key", "a file without it")
        array = self.arrays[key]
        codes, dtype = _KINDS[kind]
        if array.dtype.kind not in codes:
            self.fail(key, f"dtype {kind}", array.dtype)
        fits = array.ndim == len(shape) and all(isinstance(n, str) or n == m for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            self.fail(key, f"shape ({', '.join(map(str, shape))})", array.shape)
        return array.astype(dtype, order="C")

    def require(self, key: str, values: NDArray[Any], is_right: NDArray[Any] | bool, expected: str) -> None:
        """Raises TorchCRFScanError for the first entry of `values` that is not right."""
        wrong = np.argwhere(~np.asarray(is_right))
        if len(wrong):
            where = tuple(int(i) for i in wrong[0])
            self.fail(key, expected, f"{values[where]}" + (f" at index {', '.join(map(str, where))}" if where else ""))

    def number(self, key: str) -> float:
        """A finite number of at least 0."""
        value = self.get(key, "float")
        self.require(key, value, np.isfinite(value) & (value >= 0), "a finite number of at least 0.0")
        return float(value)

    def motions(self) -> Floats:
        """(K+1, 3) rigid motions, each row finite or all NaN."""
        motions = self.get("motions", "float", "K+1", 3)
        if len(motions) == 0:
            self.fail("motions", "at least the background's row", motions.shape)
        is_right = np.isfinite(motions).all(axis=1) | np.isnan(motions).all(axis=1)
        self.require("motions", motions, np.broadcast_to(is_right[:, None], motions.shape), "rows that are finite or all NaN")
        return motions

    def labels(self, key: str, length: int | str, stop: int | None) -> Ints:
        """(length,) labels in [-1, stop), `stop` None for no upper limit."""
        values = self.get(key, "int", length)
        expected = "labels of at least -1" if stop is None else f"labels in [-1, {stop})"
        self.require(key, values, (values >= OUTLIER) & (stop is None or values < stop), expected)
        return values


def read_pair(path: str | Path) -> ScanPair:
    """Reads a pair file; the pair's name is the file's name without suffix.

    Missing keys: `body` is `cluster`, nothing is ignored, and `motions` are NaN for every cluster that occurs. Beams without a
    valid return count as ignored. Without `association` and `cluster` the pair has no annotation and the other keys of the
    annotation are not read.

    Raises:
        TorchCRFScanError: not an `.npz`, truncated, object arrays, a key that is missing or wrong (the message names it).
        OSError: the file cannot be opened.
    """
    return _parse_pair(_Fields(Path(path), read_arrays(Path(path), _PAIR_KEYS)))


def write_pair(path: str | Path, pair: ScanPair) -> None:
    """Writes a pair file: all beams, with NaN ranges for beams without return.

    `Scan` does not keep the bearings of such beams: they are interpolated between their neighbours (held at the ends). The
    pair's name is not written, it is the file's; nor are times of beams and an initial motion.

    Raises:
        TorchCRFScanError: a pair that `read_pair` would reject, or scans of different sensors. No file is written.
    """
    fields = _Fields(Path(path), _pair_arrays(Path(path), pair))
    _parse_pair(fields)
    _save(fields)


def read_pair_scans(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """Both scans of a pair file as a recording that begins at 0 s; raises the errors of `read_pair`.

    options: without meaning, as a pair file says everything.
    """
    pair = read_pair(path)
    yield Reading(pair.source, 0.0)
    yield Reading(pair.target, pair.dt)


def read_prediction(path: str | Path) -> PairPrediction:
    """Reads a prediction file.

    Raises:
        TorchCRFScanError: not an `.npz`, truncated, object arrays, a key that is missing or wrong (the message names it).
        OSError: the file cannot be opened.
    """
    return _parse_prediction(_Fields(Path(path), read_arrays(Path(path), (*_PREDICTION_KEYS, *_CERTAINTY_KEYS))))


def write_prediction(path: str | Path, prediction: PairPrediction) -> None:
    """Writes a prediction file.

    Raises:
        TorchCRFScanError: a prediction that `read_prediction` would reject. No file is written.
    """
    keys = [key for key in (*_PREDICTION_KEYS, *_CERTAINTY_KEYS) if getattr(prediction, key) is not None]
    fields = _Fields(Path(path), {key: np.asarray(getattr(prediction, key), order="C") for key in keys})
    parsed = _parse_prediction(fields)
    _save(_Fields(fields.path, {key: np.asarray(getattr(parsed, key)) for key in keys}))


def _parse_pair(fields: _Fields) -> ScanPair:
    sensor = _parse_sensor(fields)
    source, target = (_parse_scan(fields, side, sensor) for side in ("source", "target"))
    dt = fields.number("dt")
    sequence, origin = (str(fields.get(key, "str")) if key in fields else "" for key in _TEXT_KEYS)
    for key, text in (("file name", fields.path.stem), ("sequence", sequence), ("source", origin)):
        check_name(f"{fields.path}: {key}", text)
    annotation = _parse_annotation(fields, source, target)
    try:
        return ScanPair(source, target, dt, annotation, sequence, fields.path.stem, origin)
    except ValueError as error:
        raise TorchCRFScanError(f"{fields.path}: {error}") from error


def _parse_sensor(fields: _Fields) -> dict[str, float | None]:
    sensor = {key: fields.number(key) if key in fields else None for key in _SENSOR_KEYS}
    try:
        check_sensor(**sensor)
    except ValueError as error:
        raise TorchCRFScanError(f"{fields.path}: {error}") from error
    return sensor


def _parse_scan(fields: _Fields, side: str, sensor: dict[str, float | None]) -> Scan:
    ranges = fields.get(f"{side}_ranges", "float", "N" if side == "source" else "M")
    key = f"{side}_bearings"
    bearings = fields.get(key, "float", len(ranges))
    fields.require(key, bearings, np.isfinite(bearings), "finite bearings")
    try:
        return Scan.from_ranges(ranges, bearings, **sensor)
    except ValueError as error:
        raise TorchCRFScanError(f"{fields.path}: {side}_{error}") from error


def _parse_annotation(fields: _Fields, source: Scan, target: Scan) -> Annotation | None:
    if "association" not in fields and "cluster" not in fields:
        return None
    n = source.n_beams
    is_return, is_target_return = _is_return(source), _is_return(target)
    association = fields.labels("association", n, target.n_beams)
    fields.require("association", association, is_return | (association < 0), "-1 for a beam without a valid return")
    reaches = np.append(is_target_return, True)[association]  # (N,), the outlier's -1 indexes the appended True
    fields.require("association", association, reaches, "indices of valid returns of the target")

    stop = len(fields.motions()) if "motions" in fields else None
    cluster = fields.labels("cluster", n, stop)
    fields.require("cluster", cluster, (cluster < 0) == (association < 0), "-1 exactly where association is -1")
    body = fields.labels("body", n, stop) if "body" in fields else cluster.copy()
    motions = fields.motions() if "motions" in fields else _unknown_motions(cluster, body)
    ignore = fields.get("ignore", "bool", n) if "ignore" in fields else np.zeros(n, dtype=bool)
    return Annotation(association, cluster, motions, body, ignore | ~is_return)


def _unknown_motions(cluster: Ints, body: Ints) -> Floats:
    """(K+1, 3) NaN rows for the background and every cluster up to the highest that occurs."""
    return np.full((max(cluster.max(initial=0), body.max(initial=0)) + 1, 3), np.nan)


def _parse_prediction(fields: _Fields) -> PairPrediction:
    association = fields.labels("association", "N", None)
    motions = fields.motions()
    cluster = fields.labels("cluster", len(association), len(motions))
    converged = bool(fields.get("converged", "bool"))
    confidences = []
    for key in ("association_confidence", "cluster_confidence"):
        confidence = fields.get(key, "float", len(association))
        fields.require(key, confidence, (confidence >= 0) & (confidence <= 1), "confidences in [0, 1]")
        confidences.append(confidence)
    certainty = _parse_certainty(fields, len(motions)) if any(key in fields for key in _CERTAINTY_KEYS) else {}
    return PairPrediction(association, cluster, motions, confidences[0], confidences[1], converged, **certainty)


def _parse_certainty(fields: _Fields, clusters: int) -> dict[str, NDArray[Any]]:
    covariances = fields.get("covariances", "float", clusters, 3, 3)
    fields.require("covariances", covariances, np.isfinite(covariances), "finite covariances")
    shift = fields.get("unobserved_shift", "float", clusters, 2)
    fields.require("unobserved_shift", shift, np.isfinite(shift), "finite directions")
    return {
        "covariances": covariances,
        "unobserved_turn": fields.get("unobserved_turn", "bool", clusters),
        "unobserved_shift": shift,
    }


def _is_return(scan: Scan) -> Bools:
    """(n_beams,) whether the beam is a valid return."""
    return scan.to_beams(np.ones(len(scan), dtype=bool), False)


def _pair_arrays(path: Path, pair: ScanPair) -> dict[str, NDArray[Any]]:
    arrays: dict[str, Any] = {}
    for side, scan in (("source", pair.source), ("target", pair.target)):
        arrays[f"{side}_ranges"] = scan.to_beams(np.asarray(scan.ranges, np.float64), np.nan)
        arrays[f"{side}_bearings"] = scan.beam_bearings
    arrays["dt"] = np.float64(pair.dt)
    if pair.annotation is not None:
        arrays |= _annotation_arrays(pair.annotation, _is_return(pair.source))
    for key in _SENSOR_KEYS:
        value, other = getattr(pair.source, key), getattr(pair.target, key)
        if value != other:
            raise TorchCRFScanError(f"{path}: {key}: expected the same of both scans, got {value} and {other}")
        if value is not None:
            arrays[key] = np.float64(value)
    arrays |= {key: text for key, text in (("sequence", pair.sequence), ("source", pair.origin)) if text}
    return {key: np.asarray(value, order="C") for key, value in arrays.items()}


def _annotation_arrays(annotation: Annotation, is_return: Bools) -> dict[str, NDArray[Any]]:
    arrays = {key: np.asarray(getattr(annotation, key)) for key in _ANNOTATION_KEYS}
    if arrays["ignore"].shape == is_return.shape:  # otherwise the reader's check raises
        arrays["ignore"] = arrays["ignore"] | ~is_return
    return arrays


def _save(fields: _Fields) -> None:
    """Writes the archive atomically."""
    arrays: dict[str, Any] = fields.arrays
    with whole_file(fields.path) as file:
        np.savez(file, **arrays)
