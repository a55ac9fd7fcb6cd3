"""Tables of methods: the paper's I (association), II (detection), III (motion estimation), overview, calibration, differences."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torchcrf_scan.evaluation import published as paper
from torchcrf_scan.evaluation.bootstrap import Interval, paired_intervals
from torchcrf_scan.evaluation.measures import MEASURES
from torchcrf_scan.evaluation.metrics import PairScore
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.scan import Ints

Cell = str | float | Interval
Column = tuple[str, str, int]  # heading, key of `summarise`, digits after the point

OVERVIEW: tuple[Column, ...] = (
    ("ego within 5 cm and 1 deg (%)", "ego_success", 1),
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
PUBLISHED_HEADING = "published, other data: "
PUBLISHED_NOTE = "The columns 'published, other data' are the paper's numbers for its own pairs, not for those of this table."
DIFFERENCES_NOTE = "Difference [95 % interval of a paired bootstrap], in percentage points; * where the interval excludes zero."


def _label_columns(prefix: str) -> tuple[Column, ...]:
    """The columns of Tables I and II; the paper's SED fits SED2 only, both are given (A-21)."""
    return (
        ("accuracy (%)", f"{prefix}_accuracy", 2),
        ("SED2", f"{prefix}_sed2", 2),
        ("SED1", f"{prefix}_sed1", 2),
        ("outliers found (%)", f"{prefix}_outliers_found", 2),
        ("outliers true (%)", f"{prefix}_outliers_true", 2),
        ("ratio (%)", f"{prefix}_recall", 2),
        ("ratio, undefined skipped (%)", f"{prefix}_recall_skipped", 2),
        ("precision (%)", f"{prefix}_precision", 2),
        ("precision, undefined skipped (%)", f"{prefix}_precision_skipped", 2),
    )


def _counted(table: str) -> tuple[Column, ...]:
    """The columns of a table from `MEASURES`."""
    return tuple((measure.heading, key, measure.digits) for key, measure in MEASURES[table].items())


ASSOCIATION: tuple[Column, ...] = (
    *_label_columns("association"),
    ("within +-1 (%)", "association_within_1", 2),
    ("within +-2 (%)", "association_within_2", 2),
    *_counted("association"),
)
DETECTION: tuple[Column, ...] = (
    *_label_columns("cluster"),
    ("IoU of moving points (%)", "iou_moving", 2),
    ("movers found (%)", "movers_found", 2),
    *_counted("detection"),
)
ESTIMATION: tuple[Column, ...] = (
    ("rotation (rad)", "motion_rotation", 4),
    ("translation (m)", "motion_translation", 3),
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


@dataclass(frozen=True, slots=True)
class Table:
    """A table of numbers with a heading per column.

    Attributes:
        title: of the table.
        columns: C headings.
        rows: of C cells each, texts, numbers or differences with their intervals; NaN for missing values.
        digits: digits after the point per column, for `to_markdown`; none given: 2.
        note: explanation printed below the title.

    Raises:
        ValueError: a row or `digits` of another length than `columns`.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: tuple[int, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        for name, length in [*((f"row {i}", len(row)) for i, row in enumerate(self.rows)), ("digits", len(self.digits))]:
            if length != len(self.columns) and not (name == "digits" and length == 0):
                raise ValueError(f"{name}: expected {len(self.columns)} entries, one per column, got {length}")

    def to_markdown(self) -> str:
        """Title, note and a pipe table: numbers rounded and flush right, `-` for NaN, `*` at intervals that exclude zero."""
        digits = self.digits or (2,) * len(self.columns)
        cells = [[_rounded(cell, n) for cell, n in zip(row, digits, strict=True)] for row in self.rows]
        rule = ["---" if is_text else "---:" for is_text in self._columns_with(str)]
        lines = [[_escaped(column) for column in self.columns], rule, *cells]
        above = "".join(f"{text}\n\n" for text in (f"**{_escaped(self.title)}**", self.note) if text)
        return above + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def to_csv(self) -> str:
        """Headings and rows as comma-separated values with all digits, empty for NaN; title and note are left out.

        A column of differences becomes three: itself, `<heading>, low` and `<heading>, high`.
        """
        wide = self._columns_with(Interval)
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        headings = (((name, f"{name}, low", f"{name}, high") if w else (name,)) for name, w in zip(self.columns, wide, strict=True))
        writer.writerow([heading for group in headings for heading in group])
        writer.writerows([field for cell, w in zip(row, wide, strict=True) for field in _fields(cell, w)] for row in self.rows)
        return out.getvalue()

    def _columns_with(self, kind: type) -> list[bool]:
        """Whether each column has a cell of this kind."""
        return [any(isinstance(row[i], kind) for row in self.rows) for i in range(len(self.columns))]


Scores = Mapping[str, Sequence[PairScore]]


def overview_table(scores: Scores, *, seconds: Mapping[str, Sequence[float]] | None = None) -> Table:
    """One row per method with the main metrics, and the median of its `seconds`, the times of its pairs, if given.

    Raises:
        ValueError: a method without scores.
    """
    table = _table("Overview", OVERVIEW, scores)
    if seconds is None:
        return table
    times = {method: (1e3 * statistics.median(of_method),) for method, of_method in seconds.items() if len(of_method)}
    return _widened(table, (("time (ms)", 0),), times)


def association_table(scores: Scores, *, published: bool = False) -> Table:
    """The paper's Table I: data association. published: adds the paper's numbers.

    Raises:
        ValueError: a method without scores.
    """
    table = _table("Table I: data association", ASSOCIATION, scores)
    return _with_published(table, paper.ASSOCIATION) if published else table


def detection_table(scores: Scores, *, published: bool = False) -> Table:
    """The paper's Table II: motion detection. published: adds the paper's numbers.

    Raises:
        ValueError: a method without scores.
    """
    table = _table("Table II: motion detection", DETECTION, scores)
    return _with_published(table, paper.DETECTION) if published else table


def estimation_table(scores: Scores, *, published: bool = False) -> Table:
    """The paper's Table III: motion estimation, correctly clustered objects only. published: adds the paper's numbers.

    Raises:
        ValueError: a method without scores.
    """
    table = _table("Table III: motion estimation", ESTIMATION, scores)
    return _with_published(table, paper.ESTIMATION) if published else table


def sureness_table(scores: Scores) -> Table:
    """Calibration of confidences and consistency of covariances.

    Raises:
        ValueError: a method without scores.
    """
    return replace(_table("How sure", SURENESS, scores), note=SURENESS_NOTE)


def report(scores: Scores, *, seconds: Mapping[str, Sequence[float]] | None = None, published: bool = False) -> list[Table]:
    """The overview, the Tables I, II, III and calibration, of `{method: its scores}`, methods in the given order.

    Args:
        scores: of the pairs, by method.
        seconds: the time of every pair, by method, for the overview; `-` for a method that is missing.
        published: adds the paper's numbers at the right of Tables I to III for rows that have some.

    Raises:
        ValueError: a method without scores.
    """
    tables = (association_table, detection_table, estimation_table)
    paper_tables = (table(scores, published=published) for table in tables)
    return [overview_table(scores, seconds=seconds), *paper_tables, sureness_table(scores)]


def differences_table(reference: str, scores: Scores, weights: Ints) -> Table:
    """Differences of one method to each other one on the same pairs, with 95 % intervals; percentage points.

    Args:
        reference: the method whose advantage is shown.
        scores: of the same P pairs in the same order, by method.
        weights: (R, P) resamples of the pairs, from `bootstrap.by_sequence` or `bootstrap.by_blocks`.

    Raises:
        ValueError: an unknown `reference`, scores of other pairs, or weights of another shape.
    """
    if reference not in scores:
        raise ValueError(f"reference: expected one of {', '.join(map(repr, scores))}, got {reference!r}")
    rows: list[tuple[Cell, ...]] = []
    for method, of_method in scores.items():
        if method != reference:
            intervals = paired_intervals(scores[reference], of_method, weights)
            rows.append((method, *(intervals[key] for _, key in DIFFERENCES)))
    headings = ("method", *(heading for heading, _ in DIFFERENCES))
    return Table(f"{reference} minus each row", headings, tuple(rows), (0, *[1] * len(DIFFERENCES)), DIFFERENCES_NOTE)


def _table(title: str, columns: Sequence[Column], scores: Scores) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for method, of_method in scores.items():
        if not of_method:
            raise ValueError(f"scores: expected at least one pair for method {method!r}, got none")
        summary = summarise(of_method)
        rows.append((method, *(summary[key] for _, key, _ in columns)))
    headings = ("method", *(heading for heading, _, _ in columns))
    return Table(title, headings, tuple(rows), (0, *(digits for _, _, digits in columns)))


def _with_published(table: Table, published: paper.PublishedTable) -> Table:
    """The table with the paper's columns at the right, unchanged when no row has published numbers."""
    if not any(row[0] in published.rows for row in table.rows):
        return table
    columns = [(PUBLISHED_HEADING + heading, digits) for heading, digits in published.columns]
    return replace(_widened(table, columns, published.rows), note=PUBLISHED_NOTE)


def _widened(table: Table, columns: Sequence[tuple[str, int]], cells: Mapping[str, tuple[float, ...]]) -> Table:
    """The table with more columns (heading, digits) at the right: the cells of each row's method, NaN for missing ones."""
    nothing = (math.nan,) * len(columns)
    return replace(
        table,
        columns=(*table.columns, *(heading for heading, _ in columns)),
        rows=tuple((*row, *cells.get(str(row[0]), nothing)) for row in table.rows),
        digits=(*table.digits, *(digits for _, digits in columns)),
    )


def _fields(cell: Cell, is_wide: bool) -> tuple[str | float, ...]:
    """The CSV fields of a cell, three in a column of differences."""
    if isinstance(cell, Interval):
        numbers: tuple[str | float, ...] = (cell.difference, cell.low, cell.high)
    else:
        numbers = (cell, "", "") if is_wide else (cell,)
    return tuple("" if not isinstance(number, str) and math.isnan(number) else number for number in numbers)


def _rounded(cell: Cell, digits: int) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    if isinstance(cell, Interval):
        low, high = _rounded(_signless_zero(cell.low, digits), digits), _rounded(_signless_zero(cell.high, digits), digits)
        mark = " *" if cell.excludes_zero else ""
        return f"{_signless_zero(cell.difference, digits):+.{digits}f} [{low}, {high}]{mark}"
    return "-" if math.isnan(cell) else f"{cell:.{digits}f}"


def _signless_zero(number: float, digits: int) -> float:
    """The rounded number; a rounded zero has no minus sign, which would suggest a loss."""
    return round(number, digits) + 0.0


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")
