"""95 % intervals for the difference of two methods on the same pairs, by a paired bootstrap.

A resample is a row of weights, how often each pair is drawn; both methods are averaged with the same weights. Pairs of
one recording are correlated, so they are drawn with their whole sequence, or in blocks of consecutive pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.evaluation.metrics import PairScore
from torchcrf_scan.evaluation.summary import EGO_ROTATION, EGO_TRANSLATION
from torchcrf_scan.scan import Floats, Ints

PERCENTILES = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Interval:
    """A difference and its 95 % interval.

    Attributes:
        difference: over all pairs, percentage points.
        low, high: bounds, percentage points; NaN if undetermined.
    """

    difference: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero; False for unknown bounds."""
        return self.low > 0 or self.high < 0


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
        ValueError: no pairs, or no resamples.
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
        ValueError: no pairs, empty blocks, or no resamples.
    """
    _check_positive(sequences=len(sequences), block=block, resamples=resamples)
    generator = np.random.default_rng(seed)
    weights = np.zeros((resamples, len(sequences)), dtype=np.int64)
    for name in dict.fromkeys(sequences):
        members = np.flatnonzero(np.asarray(sequences) == name)
        weights[:, members] = _block_counts(len(members), block, resamples, generator)
    return weights


def paired_intervals(ours: Sequence[PairScore], theirs: Sequence[PairScore], weights: Ints) -> dict[str, Interval]:
    """Differences of the metrics of two methods with 95 % percentile intervals.

    The metrics are those of `summary.summarise`, with 0 for an empty denominator, in the resamples too. If all resamples are the
    same the spread is undetermined, and the bounds are NaN. O(R P) time.

    Args:
        ours, theirs: scores of the same P pairs in the same order.
        weights: (R, P) how often each pair is drawn, from `by_sequence` or `by_blocks`.

    Returns:
        `association_within_2`, `association_accuracy`, `cluster_accuracy`, `iou_moving`, `movers_found` and `ego_success`: ours
        minus theirs.

    Raises:
        ValueError: no pairs, other pairs, or weights of another shape.
    """
    _check_same_pairs(ours, theirs)
    if weights.ndim != 2 or weights.shape[1] != len(ours) or not len(weights):
        raise ValueError(f"weights: expected shape (resamples, {len(ours)}), got {weights.shape}")
    once = np.ones((1, len(ours)), dtype=np.int64)
    difference = (_figures(ours, once) - _figures(theirs, once))[0]  # (F,)
    resampled = _figures(ours, weights) - _figures(theirs, weights)  # (R, F)
    low, high = np.percentile(resampled, PERCENTILES, axis=0)
    if (weights == weights[0]).all():
        low, high = np.full((2, len(difference)), np.nan)
    bounds = zip(difference.tolist(), low.tolist(), high.tolist(), strict=True)
    return {key: Interval(*numbers) for key, numbers in zip(_SHARES, bounds, strict=True)}


def _share(part: float, whole: float) -> tuple[float, float]:
    """Numerator and denominator of one pair in a mean of shares over pairs; an empty share counts as 0."""
    return (part / whole if whole else 0.0), 1.0


def _found_movers(score: PairScore) -> tuple[float, float]:
    counted = [thing for thing in score.objects if thing.is_counted]
    return sum(thing.is_found for thing in counted), len(counted)


def _good_ego(score: PairScore) -> tuple[float, float]:
    return score.has_ego_truth and score.has_ego_within(EGO_TRANSLATION, EGO_ROTATION), score.has_ego_truth


_SHARES: dict[str, Callable[[PairScore], tuple[float, float]]] = {  # a metric is 100 * sum of first / sum of second
    "association_within_2": lambda score: _share(score.within_2, score.association.points),
    "association_accuracy": lambda score: _share(score.association.right, score.association.points),
    "cluster_accuracy": lambda score: _share(score.cluster.right, score.cluster.points),
    "iou_moving": lambda score: (score.moving_both, score.moving_either),
    "movers_found": _found_movers,
    "ego_success": _good_ego,
}


def _figures(scores: Sequence[PairScore], weights: Ints) -> Floats:
    """(R, F) percentages over the weighted pairs, 0 for an empty denominator."""
    shares = np.array([[share(score) for share in _SHARES.values()] for score in scores], dtype=np.float64)  # (P, F, 2)
    parts, wholes = (weights.astype(np.float64) @ shares[..., i] for i in (0, 1))  # (R, P) @ (P, F) -> (R, F)
    return np.divide(100.0 * parts, wholes, out=np.zeros_like(parts), where=wholes > 0)


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
            raise ValueError(f"{name}: expected at least 1, got {number}")


def _check_same_pairs(ours: Sequence[PairScore], theirs: Sequence[PairScore]) -> None:
    if not ours:
        raise ValueError("ours: expected at least one pair, got none")
    if len(ours) != len(theirs):
        raise ValueError(f"theirs: expected the {len(ours)} pairs of `ours`, got {len(theirs)}")
    for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
        if (our.sequence, our.name) != (their.sequence, their.name):
            expected, got = f"{our.name!r} of {our.sequence!r}", f"{their.name!r} of {their.sequence!r}"
            raise ValueError(f"theirs: expected the pairs of `ours` in the same order, at {i} {expected}, got {got}")
