"""Tables of numbers with a heading a column, as Markdown for people and as CSV for programs."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.bootstrap import Difference, Interval

Cell = str | float | Interval


@dataclass(frozen=True, slots=True)
class Table:
    """A table of numbers with a heading per column.

    Attributes:
        title: of the table.
        columns: C headings.
        rows: of C cells each, texts, numbers, or numbers with their intervals; NaN for missing values.
        digits: digits after the point per column, for `to_markdown`; none given: 2.
        note: explanation printed below the title.

    Raises:
        TorchCRFScanError: a row or `digits` of another length than `columns`.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: tuple[int, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        for name, length in [*((f"row {i}", len(row)) for i, row in enumerate(self.rows)), ("digits", len(self.digits))]:
            if length != len(self.columns) and not (name == "digits" and length == 0):
                raise TorchCRFScanError(f"{name}: expected {len(self.columns)} entries, one per column, got {length}")

    def to_markdown(self) -> str:
        """Title, note and a pipe table: numbers rounded and flush right, `-` for NaN, `*` at differences that exclude zero."""
        digits = self.digits or (2,) * len(self.columns)
        cells = [[_rounded(cell, n) for cell, n in zip(row, digits, strict=True)] for row in self.rows]
        rule = ["---" if is_text else "---:" for is_text in self._columns_with(str)]
        lines = [[_escaped(column) for column in self.columns], rule, *cells]
        above = "".join(f"{text}\n\n" for text in (f"**{_escaped(self.title)}**", self.note) if text)
        return above + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def to_csv(self) -> str:
        """Headings and rows as comma-separated values with all digits, empty for NaN; title and note are left out.

        A column with intervals becomes three: itself, `<heading>, low` and `<heading>, high`.
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


def _fields(cell: Cell, is_wide: bool) -> tuple[str | float, ...]:
    """The CSV fields of a cell, three in a column with intervals."""
    if isinstance(cell, Interval):
        numbers: tuple[str | float, ...] = (cell.value, cell.low, cell.high)
    else:
        numbers = (cell, "", "") if is_wide else (cell,)
    return tuple("" if not isinstance(number, str) and math.isnan(number) else number for number in numbers)


def _rounded(cell: Cell, digits: int) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    if not isinstance(cell, Interval):
        return "-" if math.isnan(cell) else f"{cell:.{digits}f}"
    if math.isnan(cell.value):
        return "-"
    low, high = (_rounded(_signless_zero(bound, digits), digits) for bound in (cell.low, cell.high))
    value = _signless_zero(cell.value, digits)
    if not isinstance(cell, Difference):
        return f"{value:.{digits}f} [{low}, {high}]"
    return f"{value:+.{digits}f} [{low}, {high}]{' *' if cell.excludes_zero else ''}"


def _signless_zero(number: float, digits: int) -> float:
    """The rounded number; a rounded zero has no minus sign, which would suggest a loss."""
    return round(number, digits) + 0.0


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")
