"""95 % intervals of a method's metrics, and of the difference of two methods on the same pairs, by a bootstrap over pairs.

A resample is a row of weights, how often each pair is drawn; two methods are averaged with the same weights. Pairs of
one recording are correlated, so they are drawn with their whole sequence, or in blocks of consecutive pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.measures import Count
from torchcrf_scan.evaluation.metrics import LabelScore, PairScore
from torchcrf_scan.evaluation.summary import EGO_ROTATION, EGO_TRANSLATION, correct_errors
from torchcrf_scan.scan import Floats, Ints

PERCENTILES = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Interval:
    """A metric over all pairs and its 95 % interval.

    Attributes:
        value: over all pairs. low, high: bounds; NaN if undetermined.
    """

    value: float
    low: float
    high: float


class Difference(Interval):
    """A difference of two methods and its 95 % interval."""

    __slots__ = ()

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero; False for unknown bounds."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True, slots=True)
class Ratio:
    """A metric of many pairs as the ratio of two sums.

    Attributes:
        count: numerator and denominator of a pair. scale: of the ratio, 100 for percent. empty: value of an empty denominator.
    """

    count: Callable[[PairScore], Count]
    scale: float = 100.0
    empty: float = 0.0


def by_sequence(sequences: Sequence[str], resamples: int = 10_000, seed: int = 0) -> Ints:
    """Draws as many whole sequences as there are, with replacement: the variation between recordings.

    With a single sequence all resamples are the same and `paired_intervals` gives NaN bounds.

    Args:
        sequences: P names, the sequence of each pair.
        resamples: R.
        seed: of the draws.

    Returns:
        (R, P) how often each pair is drawn.

    Raises:
        TorchCRFScanError: no pairs, or no resamples.
    """
    _check_positive(sequences=len(sequences), resamples=resamples)
    names, number = np.unique(np.asarray(sequences), return_inverse=True)
    drawn = np.random.default_rng(seed).integers(len(names), size=(resamples, len(names)))
    return _counts(drawn, len(names))[:, number]  # (R, S) -> (R, P)


def by_blocks(sequences: Sequence[str], block: int = 5, resamples: int = 10_000, seed: int = 0) -> Ints:
    """Draws moving blocks of consecutive pairs within each sequence, with replacement: the variation within recordings.

    Blocks are drawn up to the length of the sequence, and the last one is cut to it. A sequence of at most `block` pairs is one
    block and never varies.

    Args:
        sequences: P names, the sequence of each pair; the pairs of a sequence are in the order of time.
        block: pairs of a block.
        resamples: R.
        seed: of the draws.

    Returns:
        (R, P) how often each pair is drawn.

    Raises:
        TorchCRFScanError: no pairs, empty blocks, or no resamples.
    """
    _check_positive(sequences=len(sequences), block=block, resamples=resamples)
    generator = np.random.default_rng(seed)
    weights = np.zeros((resamples, len(sequences)), dtype=np.int64)
    for name in dict.fromkeys(sequences):
        members = np.flatnonzero(np.asarray(sequences) == name)
        weights[:, members] = _block_counts(len(members), block, resamples, generator)
    return weights


def intervals(scores: Sequence[PairScore], weights: Ints) -> dict[str, Interval]:
    """The `RATIOS` of a method with 95 % percentile intervals, by their key of `summary.summarise`. O(R P) time.

    If all resamples are the same the spread is undetermined, and the bounds are NaN.

    Args:
        scores: of P pairs. weights: (R, P) how often each pair is drawn, from `by_sequence` or `by_blocks`.

    Raises:
        TorchCRFScanError: weights of another shape.
    """
    once, resampled = _over_all(scores, weights)
    return {key: Interval(*numbers) for key, numbers in _spread(once, resampled, weights)}


def paired_intervals(ours: Sequence[PairScore], theirs: Sequence[PairScore], weights: Ints) -> dict[str, Difference]:
    """Differences of the `RATIOS` of two methods, ours minus theirs, with 95 % percentile intervals; else as `intervals`.

    Args:
        ours, theirs: scores of the same P pairs in the same order. weights: (R, P), as in `intervals`.

    Raises:
        TorchCRFScanError: no pairs, other pairs, or weights of another shape.
    """
    _check_same_pairs(ours, theirs)
    (our, our_resampled), (their, their_resampled) = _over_all(ours, weights), _over_all(theirs, weights)
    return {key: Difference(*numbers) for key, numbers in _spread(our - their, our_resampled - their_resampled, weights)}


def _over_all(scores: Sequence[PairScore], weights: Ints) -> tuple[Floats, Floats]:
    """(F,) the ratios over all pairs, and (R, F) over every resample."""
    if weights.ndim != 2 or weights.shape[1] != len(scores) or not len(weights):
        raise TorchCRFScanError(f"weights: expected shape (resamples, {len(scores)}), got {weights.shape}")
    return _figures(scores, np.ones((1, len(scores)), dtype=np.int64))[0], _figures(scores, weights)


def _spread(once: Floats, resampled: Floats, weights: Ints) -> Iterator[tuple[str, tuple[float, float, float]]]:
    """Key, value and bounds of every ratio. Resamples without the ratio are left out."""
    for key, value, column in zip(RATIOS, once.tolist(), resampled.T, strict=True):
        known = column[np.isfinite(column)]
        is_fixed = not len(known) or (weights == weights[0]).all()
        low, high = (math.nan, math.nan) if is_fixed else np.percentile(known, PERCENTILES).tolist()
        yield key, (value, low, high)


def _share(part: float, whole: float) -> Count:
    """Numerator and denominator of one pair in a mean of shares over pairs; an empty share counts as 0."""
    return (part / whole if whole else 0.0), 1.0


def _defined(part: float, whole: float) -> Count:
    """The same, but a pair with an empty share is left out."""
    return (part / whole, 1.0) if whole else (0.0, 0.0)


def _found_movers(score: PairScore) -> Count:
    counted = [thing for thing in score.objects if thing.is_counted]
    return sum(thing.is_found for thing in counted), len(counted)


def _good_ego(score: PairScore) -> Count:
    return score.has_ego_truth and score.has_ego_within(EGO_TRANSLATION, EGO_ROTATION), score.has_ego_truth


def _of_labels(prefix: str, label: Callable[[PairScore], LabelScore]) -> dict[str, Ratio]:
    """The columns of the paper's Tables I and II."""
    return {
        f"{prefix}_accuracy": Ratio(lambda score: _share(label(score).right, label(score).points)),
        f"{prefix}_sed2": Ratio(lambda score: (label(score).sed2, 1.0), scale=1.0),
        f"{prefix}_outliers_found": Ratio(lambda score: _share(label(score).outliers_predicted, label(score).points)),
        f"{prefix}_outliers_true": Ratio(lambda score: _share(label(score).outliers_true, label(score).points)),
        f"{prefix}_recall_skipped": Ratio(
            lambda score: _defined(label(score).outliers_both, label(score).outliers_true), empty=math.nan
        ),
    }


def _of_errors(name: str) -> Ratio:
    """A column of the paper's Table III: the mean error of the correctly clustered objects."""

    def count(score: PairScore) -> Count:
        errors = correct_errors(score.objects)
        return sum(getattr(error, name) for error in errors), len(errors)

    return Ratio(count, scale=1.0, empty=math.nan)


RATIOS: Mapping[str, Ratio] = {  # by key of `summary.summarise`
    "association_within_2": Ratio(lambda score: _share(score.within_2, score.association.points)),
    **_of_labels("association", lambda score: score.association),
    **_of_labels("cluster", lambda score: score.cluster),
    "iou_moving": Ratio(lambda score: (score.moving_both, score.moving_either)),
    "movers_found": Ratio(_found_movers),
    "ego_success": Ratio(_good_ego),
    "motion_rotation": _of_errors("rotation"),
    "motion_translation": _of_errors("translation"),
}


def _figures(scores: Sequence[PairScore], weights: Ints) -> Floats:
    """(R, F) ratios over the weighted pairs."""
    counts = np.array([[ratio.count(score) for ratio in RATIOS.values()] for score in scores], dtype=np.float64)  # (P, F, 2)
    parts, wholes = (weights.astype(np.float64) @ counts[..., i] for i in (0, 1))  # (R, P) @ (P, F) -> (R, F)
    parts = parts * [ratio.scale for ratio in RATIOS.values()]
    empty = np.broadcast_to([ratio.empty for ratio in RATIOS.values()], parts.shape)
    return np.divide(parts, wholes, out=empty.copy(), where=wholes > 0)


def _block_counts(length: int, block: int, resamples: int, generator: np.random.Generator) -> Ints:
    """(R, length) draws of the pairs of one sequence."""
    block = min(block, length)
    starts = generator.integers(length - block + 1, size=(resamples, -(-length // block)))  # (R, blocks)
    drawn = (starts[..., None] + np.arange(block)).reshape(resamples, -1)  # (R, blocks * block)
    return _counts(drawn[:, :length], length)


def _counts(drawn: Ints, number: int) -> Ints:
    """(R, number) how often each index occurs in each row of (R, D) `drawn`."""
    cells = drawn + number * np.arange(len(drawn))[:, None]
    return np.bincount(cells.ravel(), minlength=number * len(drawn)).reshape(len(drawn), number)


def _check_positive(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise TorchCRFScanError(f"{name}: expected at least 1, got {number}")


def _check_same_pairs(ours: Sequence[PairScore], theirs: Sequence[PairScore]) -> None:
    if not ours:
        raise TorchCRFScanError("ours: expected at least one pair, got none")
    if len(ours) != len(theirs):
        raise TorchCRFScanError(f"theirs: expected the {len(ours)} pairs of `ours`, got {len(theirs)}")
    for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
        if (our.sequence, our.name) != (their.sequence, their.name):
            expected, got = f"{our.name!r} of {our.sequence!r}", f"{their.name!r} of {their.sequence!r}"
            raise TorchCRFScanError(f"theirs: expected the pairs of `ours` in the same order, at {i} {expected}, got {got}")
