import pytest

from torchcrf_scan.evaluation.published import ASSOCIATION, DETECTION, ESTIMATION, PublishedTable


@pytest.mark.parametrize("table", [ASSOCIATION, DETECTION, ESTIMATION])
def test_rows_have_a_number_per_column(table: PublishedTable) -> None:
    assert all(len(row) == len(table.columns) for row in table.rows.values())
    assert all(number > 0 for row in table.rows.values() for number in row)


def test_rows_are_called_as_in_our_tables() -> None:
    assert tuple(ASSOCIATION.rows) == ("ICP, tuned", "CRF-Matching", "joint")
    assert tuple(DETECTION.rows) == tuple(ESTIMATION.rows) == ("K-Means (ICP)", "K-Means (CRF-Matching)", "CRF-Clustering", "joint")


def test_numbers_agree_with_each_other() -> None:
    """One truth has one share of outliers, K-Means inherits its outliers, and the claims of the text hold."""
    for table in (ASSOCIATION, DETECTION):
        assert {row[3] for row in table.rows.values()} == {11.07}
    for method, source in (("K-Means (ICP)", "ICP, tuned"), ("K-Means (CRF-Matching)", "CRF-Matching")):
        assert DETECTION.rows[method][2:] == ASSOCIATION.rows[source][2:]
    for table in (ASSOCIATION, DETECTION):
        assert max(table.rows, key=lambda method: table.rows[method][0]) == "joint"
        assert min(table.rows, key=lambda method: table.rows[method][1]) == "joint"
    assert min(ESTIMATION.rows, key=lambda method: ESTIMATION.rows[method][1]) == "joint"
