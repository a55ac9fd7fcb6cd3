"""Tables of causes: their sums are those of the points, by sequence too."""

import math
from dataclasses import replace

import numpy as np
from made_causes import CAR, GONE, labelled, make_street

from torchcrf_scan.evaluation.causes.blame import CAUSES, KEPT, LABEL, Blame, blame
from torchcrf_scan.evaluation.causes.movers import FOUND, MISLABELLED
from torchcrf_scan.evaluation.causes.outliers import OutlierCase
from torchcrf_scan.evaluation.causes.tables import (
    causes_table,
    fates_table,
    figures,
    gates_of,
    gates_table,
    oracles_table,
    worst_of,
    worst_table,
)
from torchcrf_scan.evaluation.metrics import score_pair


def two_blames() -> list[Blame]:
    """One pair with five kept outliers in one sequence, one with a mislabelled car in another."""
    street = make_street()
    kept, lost = labelled(street.answer, GONE, cluster=0), labelled(street.answer, CAR, cluster=0)
    lost.cluster[48] = 1
    first, second = (blame(street.pair, answer, street.trace, score_pair(street.pair, answer)) for answer in (kept, lost))
    return [replace(first, name="a", sequence="one"), replace(second, name="b", sequence="two")]


def cells(table) -> dict[str, tuple]:
    return {str(row[0]): row[1:] for row in table.rows}


def test_causes_by_sequence() -> None:
    table = causes_table(two_blames())
    rows = cells(table)
    assert table.columns[4:] == ("one (%)", "two (%)")
    assert rows[KEPT] == (5.0, 100 * 5 / 12, 1.0, 100.0, 0.0)
    assert rows[LABEL] == (7.0, 100 * 7 / 12, 1.0, 0.0, 100.0)
    assert rows["all wrong points"][:3] == (12.0, 100.0, 2.0)
    assert rows["share of all points (%)"] == (120.0, 10.0, 2.0, 100 * 5 / 60, 100 * 7 / 60)
    assert sum(rows[name][0] for name in CAUSES) == 12


def test_fates_and_false_movers() -> None:
    rows = cells(fates_table(two_blames()))
    assert (rows[FOUND], rows[MISLABELLED], rows["all movers"]) == ((3.0, 75.0), (1.0, 25.0), (4.0, 100.0))


def test_no_pairs_and_no_mistakes_print_dashes() -> None:
    assert math.isnan(cells(causes_table([]))["all wrong points"][1])
    assert "nan" not in causes_table([]).to_markdown() + fates_table([]).to_markdown() + worst_table([], 3).to_markdown()
    street = make_street()
    right = blame(street.pair, street.answer, street.trace, score_pair(street.pair, street.answer))
    assert worst_of([right], 3) == []
    assert "nan" not in causes_table([right]).to_markdown()


def test_oracles_and_gates() -> None:
    assert cells(oracles_table(12, {"all": 3}))["all"] == (3.0, 75.0)
    case = OutlierCase(np.array([0.1, 0.2, 0.9]), np.array([False, False, True]), np.array([True, True, False]))
    gates = gates_of({"one": [case]})
    assert cells(gates_table(gates))["one"] == (0.2, 3.0, 0.0, 3.0, 100.0)
    assert figures(two_blames(), {"all": 3}, gates)["gates"] == {"one": {"metres": 0.2, "errors": 0, "answered": 3}}


def test_the_worst_pairs_come_first() -> None:
    table = worst_table(two_blames(), 5)
    assert [row[0] for row in table.rows] == ["b", "a"]
    assert table.rows[0] == ("b", 7.0, 100 * 7 / 60, LABEL, 7.0)
    assert worst_of(two_blames(), 1) == [1]


def test_figures_hold_every_pair() -> None:
    found = figures(two_blames(), {}, {})
    assert found["all"]["wrong"] == sum(of["wrong"] for of in found["pairs"].values()) == 12
    assert {name: of["wrong"] for name, of in found["sequences"].items()} == {"one": 5, "two": 7}
