import csv
import io

import numpy as np
import pytest

from torchcrf_scan.evaluation.metrics import PairScore, score_pair, summarise
from torchcrf_scan.evaluation.report import Table, association_table, detection_table, estimation_table, overview_table, report
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair


@pytest.fixture
def scores() -> dict[str, list[PairScore]]:
    """A method that is always right and one that calls everything an outlier."""
    scan = Scan.from_ranges(np.full(8, 3.0), np.linspace(-1.0, 1.0, 8))
    association = np.array([0, 1, 2, 3, 4, 5, 6, -1])
    cluster = np.array([0, 0, 1, 1, 1, 1, 1, -1])
    motions = np.array([[0.0, 0.1, 0.0], [0.1, 1.0, 0.0]])
    pair = ScanPair(scan, scan, annotation=Annotation(association, cluster, motions, cluster, np.zeros(8, bool)))
    right = PairPrediction(association, cluster, motions, np.ones(8), np.ones(8), True)
    nothing = PairPrediction(np.full(8, -1), np.full(8, -1), np.ones((1, 3)), np.ones(8), np.ones(8), True)
    return {"right": [score_pair(pair, right)] * 2, "nothing": [score_pair(pair, nothing)]}


def test_tables_have_one_row_per_method(scores: dict[str, list[PairScore]]) -> None:
    for table in report(scores):
        assert [row[0] for row in table.rows] == ["right", "nothing"]
        assert table.columns[0] == "method"
    assert [table.title.split(":")[0] for table in report(scores)] == ["Overview", "Table I", "Table II", "Table III"]


def cell(table: Table, method: str, column: str) -> object:
    row = next(row for row in table.rows if row[0] == method)
    return row[table.columns.index(column)]


def test_tables_hold_the_figures_of_the_summary(scores: dict[str, list[PairScore]]) -> None:
    nothing = summarise(scores["nothing"])
    assert cell(overview_table(scores), "right", "ego within 5 cm and 1 deg (%)") == 100
    assert cell(overview_table(scores), "nothing", "outlier precision (%)") == nothing["association_precision"] == 12.5
    assert cell(association_table(scores), "nothing", "SED2") == nothing["association_sed2"] == 14
    assert cell(association_table(scores), "nothing", "outliers found (%)") == 100
    assert cell(detection_table(scores), "nothing", "accuracy (%)") == nothing["cluster_accuracy"] == 12.5
    assert cell(estimation_table(scores), "right", "objects") == 4
    assert np.isnan(cell(estimation_table(scores), "nothing", "translation (m)"))


def test_overview_has_the_columns_of_the_reference_table(scores: dict[str, list[PairScore]]) -> None:
    assert overview_table(scores).columns == (
        "method",
        "ego within 5 cm and 1 deg (%)",
        "association within +-2 (%)",
        "cluster accuracy (%)",
        "IoU of moving points (%)",
        "movers found (%)",
        "outlier precision (%)",
        "outlier recall (%)",
    )


def test_markdown() -> None:
    table = Table("Times", ("method", "ms", "pairs"), (("a|b", 1.256, 3.0), ("c", float("nan"), 4.0)), (0, 1, 0))
    assert (
        table.to_markdown() == "**Times**\n\n| method | ms | pairs |\n| --- | ---: | ---: |\n| a\\|b | 1.3 | 3 |\n| c | - | 4 |\n"
    )


def test_csv_keeps_all_digits() -> None:
    table = Table("Times", ("method", "ms"), (("a, b", 1.2567891234), ("c", float("nan"))))
    rows = list(csv.reader(io.StringIO(table.to_csv())))
    assert rows == [["method", "ms"], ["a, b", "1.2567891234"], ["c", ""]]


def test_csv_of_numpy_numbers_is_plain() -> None:
    assert Table("t", ("x",), ((np.float64(1.5),),)).to_csv() == "x\n1.5\n"


def test_rows_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="row 1: expected 2 entries, one per column, got 1"):
        Table("t", ("a", "b"), ((1.0, 2.0), (1.0,)))
    with pytest.raises(ValueError, match="digits: expected 1 entries"):
        Table("t", ("a",), (), (1, 2))


def test_method_without_scores_is_named() -> None:
    with pytest.raises(ValueError, match="'icp'"):
        report({"icp": []})


def test_no_methods_give_empty_tables() -> None:
    assert all(table.rows == () for table in report({}))
    assert overview_table({}).to_markdown().startswith("**Overview**")
