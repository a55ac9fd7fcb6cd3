import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from torchcrf_scan.evaluation.bootstrap import Difference, Interval, by_blocks, intervals, paired_intervals
from torchcrf_scan.evaluation.metrics import PairScore, score_pair
from torchcrf_scan.evaluation.report import (
    PUBLISHED_HEADING,
    PUBLISHED_NOTE,
    SURENESS_NOTE,
    differences_table,
    overview_table,
    report,
    sequences_table,
    sureness_table,
)
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.evaluation.table import Table
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


@pytest.fixture
def sure_scores(scores: dict[str, list[PairScore]]) -> list[PairScore]:
    """Three pairs whose background motions have known errors."""
    score = scores["right"][0]
    return [replace(score, sureness=replace(score.sureness, nees=nees)) for nees in (1.0, 1.0, 100.0)]


def test_tables_have_one_row_per_method(scores: dict[str, list[PairScore]]) -> None:
    for table in report(scores):
        assert [row[0] for row in table.rows] == ["right", "nothing"]
        assert table.columns[0] == "method"
    papers = [f"Table {number}{more}" for number in ("I", "II", "III") for more in ("", ", more")]
    assert [table.title.split(":")[0] for table in report(scores)] == ["Overview", *papers, "How sure"]


def titled(title: str, scores: dict[str, list[PairScore]], **options: object) -> Table:
    """The table of a report with this title, up to the colon."""
    return next(table for table in report(scores, **options) if table.title.split(":")[0] == title)


def cell(table: Table, method: str, column: str) -> object:
    row = next(row for row in table.rows if row[0] == method)
    return row[table.columns.index(column)]


def test_tables_hold_the_figures_of_the_summary(scores: dict[str, list[PairScore]]) -> None:
    nothing = summarise(scores["nothing"])
    assert cell(overview_table(scores), "right", "ego within 5 cm and 1 deg (%)") == 100
    assert cell(overview_table(scores), "nothing", "outlier precision (%)") == nothing["association_precision"] == 12.5
    assert cell(titled("Table I", scores), "nothing", "SED2") == nothing["association_sed2"] == 14
    assert cell(titled("Table I", scores), "nothing", "outliers found (%)") == 100
    assert cell(titled("Table II", scores), "nothing", "accuracy (%)") == nothing["cluster_accuracy"] == 12.5
    assert cell(titled("Table III, more", scores), "right", "objects") == 4
    assert np.isnan(cell(titled("Table III", scores), "nothing", "translation (m)"))


def test_overview_has_the_columns_of_the_reference_table(scores: dict[str, list[PairScore]]) -> None:
    assert overview_table(scores).columns == (
        "method",
        "ego within 5 cm and 1 deg (%)",
        "association exact (%)",
        "association within +-2 (%)",
        "cluster accuracy (%)",
        "IoU of moving points (%)",
        "movers found (%)",
        "outlier precision (%)",
        "outlier recall (%)",
    )


def test_tables_have_the_columns_of_the_paper_and_more(scores: dict[str, list[PairScore]]) -> None:
    labels = ("method", "accuracy (%)", "SED2", "outliers found (%)", "outliers true (%)", "ratio (%)")
    assert titled("Table I", scores).columns == titled("Table II", scores).columns == labels
    assert titled("Table III", scores).columns == ("method", "rotation (rad)", "translation (m)")
    more = {"SED1", "precision (%)"}
    assert more | {"within +-1 (%)", "within +-2 (%)"} <= set(titled("Table I, more", scores).columns)
    assert more | {"IoU of moving points (%)", "movers found (%)"} <= set(titled("Table II, more", scores).columns)
    errors = {f"{kind} {of}" for kind in ("background", "mover") for of in ("rotation (rad)", "translation (m)")}
    assert errors <= set(titled("Table III, more", scores).columns)
    assert cell(titled("Table II, more", scores), "nothing", "movers found (%)") == 0
    assert cell(titled("Table I, more", scores), "right", "within +-2 (%)") == 100


def test_how_sure_has_the_figures_of_the_summary(scores: dict[str, list[PairScore]]) -> None:
    table = sureness_table(scores)
    assert table.columns == (
        "method",
        "associations, calibration error (%)",
        "clusters, calibration error (%)",
        "background NEES within 95 % (%)",
        "mean NEES",
        "low",
        "high",
    )
    assert cell(table, "right", "associations, calibration error (%)") == 0
    assert cell(table, "nothing", "clusters, calibration error (%)") == summarise(scores["nothing"])["cluster_ece"] == 87.5
    assert table.to_markdown().splitlines()[2] == SURENESS_NOTE
    assert table.to_markdown().splitlines()[-1] == "| nothing | 87.5 | 87.5 | - | - | - | - |"


def test_how_sure_tells_of_covariances(sure_scores: list[PairScore]) -> None:
    """Errors of one, one and ten standard deviations: two are within the quantile, the mean is too large by far."""
    table = sureness_table({"sure": sure_scores})
    assert cell(table, "sure", "background NEES within 95 % (%)") == pytest.approx(100 * 2 / 3)
    assert cell(table, "sure", "mean NEES") == pytest.approx(102 / 3)
    assert cell(table, "sure", "low") < 3 < cell(table, "sure", "high") < 102 / 3


def test_times_are_medians_in_milliseconds(scores: dict[str, list[PairScore]]) -> None:
    table = report(scores, seconds={"right": [0.1, 0.3, 5.0], "another": [1.0]})[0]
    assert table.columns == (*overview_table(scores).columns, "time (ms)")
    assert cell(table, "right", "time (ms)") == pytest.approx(300)
    assert math.isnan(cell(table, "nothing", "time (ms)"))
    assert "time (ms)" in overview_table(scores, seconds={"right": []}).columns
    assert all("time (ms)" not in other.columns for other in report(scores, seconds={"right": [0.1]})[1:])


def test_published_numbers_stand_beside_ours(scores: dict[str, list[PairScore]]) -> None:
    rows = dict.fromkeys(("ICP", "ICP, tuned", "K-Means (ICP)", "joint"), scores["right"])
    association, detection, estimation = (titled(f"Table {number}", rows, published=True) for number in ("I", "II", "III"))
    assert titled("Overview", rows, published=True) == overview_table(rows)
    assert cell(association, "ICP, tuned", f"{PUBLISHED_HEADING}accuracy (%)") == 69.19
    assert cell(association, "joint", f"{PUBLISHED_HEADING}SED") == 96.13
    assert math.isnan(cell(association, "ICP", f"{PUBLISHED_HEADING}ratio (%)"))
    assert cell(detection, "K-Means (ICP)", f"{PUBLISHED_HEADING}outliers found (%)") == 34.6
    assert math.isnan(cell(detection, "ICP, tuned", f"{PUBLISHED_HEADING}accuracy (%)"))
    assert cell(estimation, "joint", f"{PUBLISHED_HEADING}translation (m)") == 0.56
    for table, number in ((association, 5), (detection, 5), (estimation, 2)):
        assert len(table.columns) == 1 + 2 * number
        assert all(column.startswith(PUBLISHED_HEADING) for column in table.columns[2::2])
        ours = [column.split(" ")[0].rstrip("2") for column in table.columns[1::2]]  # SED2 beside SED
        assert [column.removeprefix(PUBLISHED_HEADING).split(" ")[0] for column in table.columns[2::2]] == ours
        assert f"\n\n{PUBLISHED_NOTE}\n\n| method |" in table.to_markdown()


def test_published_numbers_need_a_row_and_a_wish(scores: dict[str, list[PairScore]]) -> None:
    for asked, plain in zip(report(scores, published=True), report(scores), strict=True):
        assert asked.to_markdown() == plain.to_markdown()
    joint = {"joint": scores["right"]}
    assert all(not column.startswith(PUBLISHED_HEADING) for table in report(joint) for column in table.columns)
    assert PUBLISHED_NOTE not in titled("Table I", joint).to_markdown()


def test_the_papers_columns_have_intervals(drive: dict[str, list[PairScore]]) -> None:
    weights = by_blocks(["a"] * 8, 3, 200)
    for title, prefix in (("Table I", "association"), ("Table II", "cluster")):
        table = titled(title, drive, published=True, weights=weights)
        for method, of_method in drive.items():
            expected = intervals(of_method, weights)
            assert cell(table, method, "SED2") == expected[f"{prefix}_sed2"]
            assert cell(table, method, "ratio (%)") == expected[f"{prefix}_recall_skipped"]
    assert "| joint | 100.00 [100.00, 100.00] | 74.13 |" in titled("Table I", drive, published=True, weights=weights).to_markdown()
    found = cell(titled("Table I", drive, weights=weights), "sometimes", "accuracy (%)")
    assert found.low < found.value < found.high
    assert titled("Table III", drive, weights=weights).rows[1][2] != titled("Table III", drive).rows[1][2]  # no motion: no interval
    assert "| nothing | - | - |" in titled("Table III", drive, weights=weights).to_markdown()


def test_sequences_stand_apart(scores: dict[str, list[PairScore]]) -> None:
    """Every sequence has its own rows, one a method, in the order of the sequences; numbers are those of its pairs alone."""
    right, nothing = scores["right"][0], scores["nothing"][0]
    mixed = [replace(right, sequence="b"), replace(nothing, sequence="b"), replace(right, sequence="a")]
    table = sequences_table({"mixed": mixed, "right": [replace(right, sequence=like.sequence) for like in mixed]})
    assert [row[:3] for row in table.rows] == [("b", "mixed", 2), ("b", "right", 2), ("a", "mixed", 1), ("a", "right", 1)]
    exact = table.columns.index("association exact (%)")
    assert [row[exact] for row in table.rows] == [(100 + 12.5) / 2, 100, 100, 100]


@pytest.fixture
def drive(scores: dict[str, list[PairScore]]) -> dict[str, list[PairScore]]:
    """Eight pairs of a drive: joint always right, one that calls all outliers, and one that is right in every other pair."""
    right, nothing = scores["right"][0], scores["nothing"][0]
    return {"joint": [right] * 8, "nothing": [nothing] * 8, "sometimes": [right, nothing] * 4, "same": [right] * 8}


def test_differences_are_the_paired_intervals(drive: dict[str, list[PairScore]]) -> None:
    weights = by_blocks(["a"] * 8, 3, 200)
    table = differences_table("joint", drive, weights)
    assert table.title == "joint minus each row"
    assert [row[0] for row in table.rows] == ["nothing", "sometimes", "same"]
    assert table.columns == ("method", "association within +-2", "cluster accuracy", "IoU of moving points", "movers found")
    for method in ("nothing", "sometimes", "same"):
        expected = paired_intervals(drive["joint"], drive[method], weights)
        assert cell(table, method, "cluster accuracy") == expected["cluster_accuracy"]
        assert cell(table, method, "association within +-2") == expected["association_within_2"]
        assert cell(table, method, "movers found") == expected["movers_found"]
        assert cell(table, method, "IoU of moving points") == expected["iou_moving"]


def test_differences_read_well_in_markdown(drive: dict[str, list[PairScore]]) -> None:
    lines = differences_table("joint", drive, by_blocks(["a"] * 8, 3, 200)).to_markdown().splitlines()
    assert lines[2].startswith("Difference [95 % interval")
    assert lines[5] == "| --- | ---: | ---: | ---: | ---: |"
    assert lines[6].startswith("| nothing | +87.5 [87.5, 87.5] * | +87.5 [87.5, 87.5] * | +100.0 [100.0, 100.0] * |")
    assert lines[8] == "| same |" + " +0.0 [0.0, 0.0] |" * 4


def test_differences_have_columns_of_their_own_in_csv() -> None:
    table = Table(
        "t", ("method", "found"), (("a", Difference(1.5, -0.25, 3.0)), ("b", Difference(2.0, math.nan, math.nan)), ("c", 4.0))
    )
    rows = list(csv.reader(io.StringIO(table.to_csv())))
    assert rows == [
        ["method", "found", "found, low", "found, high"],
        ["a", "1.5", "-0.25", "3.0"],
        ["b", "2.0", "", ""],
        ["c", "4.0", "", ""],
    ]


def test_differences_in_markdown_have_signs_and_marks() -> None:
    cells = (Difference(-2.04, -3.0, -1.0), Difference(-0.001, -1.0, 0.0), Difference(3.0, math.nan, math.nan))
    table = Table("t", ("x",), tuple((cell,) for cell in cells), (1,))
    assert table.to_markdown().splitlines()[4:] == ["| -2.0 [-3.0, -1.0] * |", "| +0.0 [-1.0, 0.0] |", "| +3.0 [-, -] |"]
    levels = Table("t", ("x",), ((Interval(2.04, 1.0, 3.0),), (Interval(math.nan, math.nan, math.nan),)), (1,))
    assert levels.to_markdown().splitlines()[4:] == ["| 2.0 [1.0, 3.0] |", "| - |"]


def test_differences_need_the_reference_and_the_same_pairs(drive: dict[str, list[PairScore]]) -> None:
    weights = by_blocks(["a"] * 8, 3, 10)
    with pytest.raises(ValueError, match="reference: expected one of 'joint', 'nothing', 'sometimes', 'same', got 'crf'"):
        differences_table("crf", drive, weights)
    with pytest.raises(ValueError, match="expected the 8 pairs of `ours`, got 7"):
        differences_table("joint", drive | {"short": drive["same"][:7]}, weights)
    assert differences_table("joint", {"joint": drive["joint"]}, weights).rows == ()


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
