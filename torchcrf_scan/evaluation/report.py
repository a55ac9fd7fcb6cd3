"""Tables of methods: the paper's I (association), II (detection), III (motion estimation), overview, calibration, differences."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation import published as paper
from torchcrf_scan.evaluation.bootstrap import intervals, paired_intervals
from torchcrf_scan.evaluation.measures import MEASURES
from torchcrf_scan.evaluation.metrics import PairScore
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.evaluation.table import Cell, Table
from torchcrf_scan.scan import Ints

Column = tuple[str, str, int]  # heading, key of `summarise`, digits after the point

OVERVIEW: tuple[Column, ...] = (
    ("ego within 5 cm and 1 deg (%)", "ego_success", 1),
    ("association exact (%)", "association_accuracy", 1),
    ("association within +-2 (%)", "association_within_2", 1),
    ("cluster accuracy (%)", "cluster_accuracy", 1),
    ("IoU of moving points (%)", "iou_moving", 1),
    ("movers found (%)", "movers_found", 1),
    ("outlier precision (%)", "association_precision", 1),
    ("outlier recall (%)", "association_recall", 1),
)
DIFFERENCES: tuple[tuple[str, str], ...] = (  # heading, key of `paired_intervals`
    ("association within +-2", "association_within_2"),
    ("cluster accuracy", "cluster_accuracy"),
    ("IoU of moving points", "iou_moving"),
    ("movers found", "movers_found"),
)
PUBLISHED_HEADING = "published: "
PUBLISHED_NOTE = (
    "'published' is the paper's number, for its own pairs, not for those of this table; its 'ICP' stands beside 'ICP, tuned', "
    "whose gate finds the same share of outliers. In brackets 95 % intervals of a bootstrap."
)
DIFFERENCES_NOTE = "Difference [95 % interval of a paired bootstrap], in percentage points; * where the interval excludes zero."


def _paper_columns(prefix: str) -> tuple[Column, ...]:
    """The paper's columns of Tables I and II; its SED fits SED2 only (A-21), and it has no undefined ratio."""
    return (
        ("accuracy (%)", f"{prefix}_accuracy", 2),
        ("SED2", f"{prefix}_sed2", 2),
        ("outliers found (%)", f"{prefix}_outliers_found", 2),
        ("outliers true (%)", f"{prefix}_outliers_true", 2),
        ("ratio (%)", f"{prefix}_recall_skipped", 2),
    )


def _more_columns(prefix: str) -> tuple[Column, ...]:
    """What the paper does not print of the same labels."""
    return (
        ("SED1", f"{prefix}_sed1", 2),
        ("ratio, undefined 0 (%)", f"{prefix}_recall", 2),
        ("precision (%)", f"{prefix}_precision", 2),
        ("precision, undefined skipped (%)", f"{prefix}_precision_skipped", 2),
    )


def _counted(table: str) -> tuple[Column, ...]:
    """The columns of a table from `MEASURES`."""
    return tuple((measure.heading, key, measure.digits) for key, measure in MEASURES[table].items())


ASSOCIATION = _paper_columns("association")
ASSOCIATION_MORE: tuple[Column, ...] = (
    ("within +-1 (%)", "association_within_1", 2),
    ("within +-2 (%)", "association_within_2", 2),
    *_counted("association"),
    *_more_columns("association"),
)
DETECTION = _paper_columns("cluster")
DETECTION_MORE: tuple[Column, ...] = (
    ("IoU of moving points (%)", "iou_moving", 2),
    ("movers found (%)", "movers_found", 2),
    *_counted("detection"),
    *_more_columns("cluster"),
)
ESTIMATION: tuple[Column, ...] = (
    ("rotation (rad)", "motion_rotation", 4),
    ("translation (m)", "motion_translation", 3),
)
ESTIMATION_MORE: tuple[Column, ...] = (
    ("at centroid (m)", "motion_centroid", 3),
    ("objects", "motion_objects", 0),
    ("background rotation (rad)", "background_motion_rotation", 4),
    ("background translation (m)", "background_motion_translation", 3),
    ("background at centroid (m)", "background_motion_centroid", 3),
    ("backgrounds", "background_motion_objects", 0),
    ("mover rotation (rad)", "mover_motion_rotation", 4),
    ("mover translation (m)", "mover_motion_translation", 3),
    ("mover at centroid (m)", "mover_motion_centroid", 3),
    ("movers", "mover_motion_objects", 0),
)
SURENESS: tuple[Column, ...] = (
    ("associations, calibration error (%)", "association_ece", 1),
    ("clusters, calibration error (%)", "cluster_ece", 1),
    ("background NEES within 95 % (%)", "nees_covered", 1),
    ("mean NEES", "nees_mean", 2),
    ("low", "nees_low", 2),
    ("high", "nees_high", 2),
)
SURENESS_NOTE = (
    "Calibration errors are expected ones, over all returns; an association is right within +-2. NEES: squared error of the "
    "background's motion over its covariance; 95 % should be within the quantile, the mean between low and high."
)


Scores = Mapping[str, Sequence[PairScore]]


def overview_table(scores: Scores, *, seconds: Mapping[str, Sequence[float]] | None = None) -> Table:
    """One row per method with the main metrics, and the median of its `seconds`, the times of its pairs, if given.

    Raises:
        TorchCRFScanError: a method without scores.
    """
    table = _table("Overview", OVERVIEW, scores)
    if seconds is None:
        return table
    times = {method: 1e3 * statistics.median(of_method) for method, of_method in seconds.items() if len(of_method)}
    rows = tuple((*row, times.get(str(row[0]), math.nan)) for row in table.rows)
    return replace(table, columns=(*table.columns, "time (ms)"), rows=rows, digits=(*table.digits, 0))


def paper_table(title: str, columns: Sequence[Column], scores: Scores, beside: paper.PublishedTable, weights: Ints | None) -> Table:
    """One of the paper's tables, with 95 % intervals where there are resamples, each column beside the published one.

    The published columns are left out if they have none of the rows.

    Args:
        columns: the paper's. beside: its numbers, in the same columns. weights: (R, P) of `bootstrap.by_sequence` or `by_blocks`.

    Raises:
        TorchCRFScanError: a method without scores.
    """
    table = _table(title, columns, scores, weights)
    if not any(method in beside.rows for method in scores):
        return table
    nothing: tuple[Cell, ...] = (math.nan,) * len(columns)
    rows = [(row[0], *_alternating(row[1:], beside.rows.get(str(row[0]), nothing))) for row in table.rows]
    published = [PUBLISHED_HEADING + heading for heading, _ in beside.columns]
    headings = ("method", *_alternating(table.columns[1:], published))
    digits = (0, *_alternating(table.digits[1:], [digits for _, digits in beside.columns]))
    return Table(title, headings, tuple(rows), digits, PUBLISHED_NOTE)


def _alternating(ours: Sequence[Any], theirs: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(one for both in zip(ours, theirs, strict=True) for one in both)


def sequences_table(scores: Scores) -> Table:
    """The overview of every sequence apart.

    Raises:
        TorchCRFScanError: a method without scores.
    """
    rows: list[tuple[Cell, ...]] = []
    for sequence in dict.fromkeys(one.sequence for of_method in scores.values() for one in of_method):
        parts = {method: [one for one in of_method if one.sequence == sequence] for method, of_method in scores.items()}
        for method, *cells in _table("", OVERVIEW, parts).rows:
            rows.append((sequence, method, float(len(parts[str(method)])), *cells))
    headings = ("sequence", "method", "pairs", *(heading for heading, _, _ in OVERVIEW))
    return Table("By sequence", headings, tuple(rows), (0, 0, 0, *(digits for _, _, digits in OVERVIEW)))


def sureness_table(scores: Scores) -> Table:
    """Calibration of confidences and consistency of covariances.

    Raises:
        TorchCRFScanError: a method without scores.
    """
    return replace(_table("How sure", SURENESS, scores), note=SURENESS_NOTE)


def report(
    scores: Scores, *, seconds: Mapping[str, Sequence[float]] | None = None, published: bool = False, weights: Ints | None = None
) -> list[Table]:
    """The overview, the paper's Tables I, II, III, each with a table of more, and calibration, methods in the given order.

    Args:
        scores: of the pairs, by method.
        seconds: the time of every pair, by method, for the overview; `-` for a method that is missing.
        published: adds the paper's numbers.
        weights: (R, P) resamples of the pairs, for intervals in the Tables I to III; None: none.

    Raises:
        TorchCRFScanError: a method without scores.
    """
    tables = [overview_table(scores, seconds=seconds)]
    for name, columns, more, numbers in (
        ("Table I: data association", ASSOCIATION, ASSOCIATION_MORE, paper.ASSOCIATION),
        ("Table II: motion detection", DETECTION, DETECTION_MORE, paper.DETECTION),
        ("Table III: motion estimation", ESTIMATION, ESTIMATION_MORE, paper.ESTIMATION),
    ):
        beside = numbers if published else replace(numbers, rows={})
        tables += [paper_table(name, columns, scores, beside, weights), _table(name.replace(":", ", more:"), more, scores)]
    return [*tables, sureness_table(scores)]


def differences_table(reference: str, scores: Scores, weights: Ints) -> Table:
    """Differences of one method to each other one on the same pairs, with 95 % intervals; percentage points.

    Args:
        reference: the method whose advantage is shown.
        scores: of the same P pairs in the same order, by method.
        weights: (R, P) resamples of the pairs, from `bootstrap.by_sequence` or `bootstrap.by_blocks`.

    Raises:
        TorchCRFScanError: an unknown `reference`, scores of other pairs, or weights of another shape.
    """
    if reference not in scores:
        raise TorchCRFScanError(f"reference: expected one of {', '.join(map(repr, scores))}, got {reference!r}")
    rows: list[tuple[Cell, ...]] = []
    for method, of_method in scores.items():
        if method != reference:
            differences = paired_intervals(scores[reference], of_method, weights)
            rows.append((method, *(differences[key] for _, key in DIFFERENCES)))
    headings = ("method", *(heading for heading, _ in DIFFERENCES))
    return Table(f"{reference} minus each row", headings, tuple(rows), (0, *[1] * len(DIFFERENCES)), DIFFERENCES_NOTE)


def _table(title: str, columns: Sequence[Column], scores: Scores, weights: Ints | None = None) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for method, of_method in scores.items():
        if not of_method:
            raise TorchCRFScanError(f"scores: expected at least one pair for method {method!r}, got none")
        summary: Mapping[str, Cell] = summarise(of_method) if weights is None else intervals(of_method, weights)
        rows.append((method, *(summary[key] for _, key, _ in columns)))
    headings = ("method", *(heading for heading, _, _ in columns))
    return Table(title, headings, tuple(rows), (0, *(digits for _, _, digits in columns)))
