"""Tables of methods: the paper's I (association), II (motion detection), III (motion estimation) and an overview."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchcrf_scan.evaluation.metrics import PairScore, summarise

Cell = str | float
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


ASSOCIATION: tuple[Column, ...] = (
    *_label_columns("association"),
    ("within +-1 (%)", "association_within_1", 2),
    ("inliers only (%)", "association_inlier_accuracy", 2),
    ("target distance (m)", "target_distance", 3),
)
DETECTION: tuple[Column, ...] = _label_columns("cluster")
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


@dataclass(frozen=True, slots=True)
class Table:
    """A table of numbers with a heading per column.

    Attributes:
        title: what it shows.
        columns: C headings.
        rows: of C cells each, texts or numbers; NaN where there is nothing to tell.
        digits: digits after the point per column, for `to_markdown`; none given: 2.

    Raises:
        ValueError: a row or `digits` of another length than `columns`.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name, length in [*((f"row {i}", len(row)) for i, row in enumerate(self.rows)), ("digits", len(self.digits))]:
            if length != len(self.columns) and not (name == "digits" and length == 0):
                raise ValueError(f"{name}: expected {len(self.columns)} entries, one per column, got {length}")

    def to_markdown(self) -> str:
        """The title and a pipe table, numbers rounded and flush right, `-` for NaN."""
        digits = self.digits or (2,) * len(self.columns)
        is_text = [any(isinstance(row[i], str) for row in self.rows) for i in range(len(self.columns))]
        cells = [[_rounded(cell, n) for cell, n in zip(row, digits, strict=True)] for row in self.rows]
        lines = [[_escaped(column) for column in self.columns], ["---" if text else "---:" for text in is_text], *cells]
        return f"**{_escaped(self.title)}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def to_csv(self) -> str:
        """Headings and rows as comma-separated values with all digits, empty for NaN; the title is left out."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(["" if _is_nan(cell) else cell for cell in row] for row in self.rows)
        return out.getvalue()


def overview_table(scores: Mapping[str, Sequence[PairScore]]) -> Table:
    """One row per method with the figures one looks at first. Raises ValueError for a method without scores."""
    return _table("Overview", OVERVIEW, scores)


def association_table(scores: Mapping[str, Sequence[PairScore]]) -> Table:
    """The paper's Table I: data association. Raises ValueError for a method without scores."""
    return _table("Table I: data association", ASSOCIATION, scores)


def detection_table(scores: Mapping[str, Sequence[PairScore]]) -> Table:
    """The paper's Table II: motion detection. Raises ValueError for a method without scores."""
    return _table("Table II: motion detection", DETECTION, scores)


def estimation_table(scores: Mapping[str, Sequence[PairScore]]) -> Table:
    """The paper's Table III: motion estimation, correctly clustered objects only. Raises ValueError for a method without scores."""
    return _table("Table III: motion estimation", ESTIMATION, scores)


def report(scores: Mapping[str, Sequence[PairScore]]) -> list[Table]:
    """The overview and the Tables I, II, III of `{method: its scores}`, methods in the given order.

    Raises:
        ValueError: a method without scores.
    """
    return [overview_table(scores), association_table(scores), detection_table(scores), estimation_table(scores)]


def _table(title: str, columns: Sequence[Column], scores: Mapping[str, Sequence[PairScore]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for method, of_method in scores.items():
        if not of_method:
            raise ValueError(f"scores: expected at least one pair for method {method!r}, got none")
        summary = summarise(of_method)
        rows.append((method, *(summary[key] for _, key, _ in columns)))
    headings = ("method", *(heading for heading, _, _ in columns))
    return Table(title, headings, tuple(rows), (0, *(digits for _, _, digits in columns)))


def _is_nan(cell: Cell) -> bool:
    return not isinstance(cell, str) and math.isnan(cell)


def _rounded(cell: Cell, digits: int) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    return "-" if math.isnan(cell) else f"{cell:.{digits}f}"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")
