"""Tables of the alternation's course, against courses worked out by hand."""

import math

import numpy as np
import pytest

from torchcrf_scan.evaluation.convergence import Course, convergence_figures, convergence_tables
from torchcrf_scan.evaluation.report import Table


def course(name: str, objective: list[list[float]], *, settled: bool = True, damped: int = 0, gain: float = 0.0) -> Course:
    """Half of the objective is of either chain."""
    scores = np.repeat(np.array(objective)[..., None] / 2, 2, axis=-1)
    return Course(name, scores, np.full((len(objective), 2), 1e-5), settled, damped, 0.0, gain, 2 * gain)


COURSES = [
    course("a", [[-math.inf, 10.0, 9.0, 12.0, 12.0], [11.0, 11.0, 11.0, 11.0, 11.0]], gain=1.5),
    course("b", [[4.0, 6.0, 6.0, 3.0, 2.0]], settled=False, damped=2, gain=-0.5),
]


def rows(title: str) -> dict[str, dict[str, object]]:
    """Row's first cell -> its cells by heading, of one of the tables."""
    table: Table = next(table for table in convergence_tables(COURSES) if table.title.startswith(title))
    return {str(row[0]): dict(zip(table.columns, row, strict=True)) for row in table.rows}


def test_every_round_of_every_pair_has_a_row() -> None:
    table = convergence_tables(COURSES)[0]
    assert [row[:2] for row in table.rows] == [("a", 1.0), ("a", 2.0), ("b", 1.0)]
    assert table.rows[2][2:] == (4.0, 6.0, 6.0, 3.0, 2.0)
    assert "| a | 1 | -inf | 10.000 |" in table.to_markdown()


def test_steps_count_rises_and_falls_of_possible_labels() -> None:
    steps = rows("The joint objective by step")
    clusters, associations = steps["clusters"], steps["associations"]
    assert [clusters[key] for key in ("times", "from impossible", "rises", "falls", "its own falls")] == [3.0, 1.0, 1.0, 0.0, 0.0]
    assert clusters["mean change"] == pytest.approx(1.0)  # +2 and 0
    assert [associations[key] for key in ("rises", "falls", "mean fall", "its own falls")] == [1.0, 1.0, 3.0, 1.0]
    assert associations["falls (%)"] == pytest.approx(100 / 3)
    assert steps["motions"]["largest fall"] == 1.0
    assert math.isnan(float(str(steps["motions"]["its own falls"])))
    assert [steps["candidates of the next round"][key] for key in ("times", "falls", "mean change")] == [1.0, 1.0, -1.0]
    assert [steps["a whole round"][key] for key in ("times", "from impossible", "falls")] == [3.0, 1.0, 1.0]


def test_rounds_bounds_and_gains() -> None:
    (rounds,) = rows("Rounds").values()
    assert [rounds[key] for key in ("pairs", "rounds, mean", "pairs damped", "rounds damped", "limit used up")] == [2, 1.5, 1, 2, 1]
    assert rounds["objective lower at the end"] == 1  # 2 after 6; the other ends at 11 after 10
    assert rows("Bound minus score")["association chain"]["last round"] == 1e-5
    best = rows("The alternation against the lattice")["the objective"]
    assert [best["lattice better (% of pairs)"], best["worse (%)"], best["largest gain"]] == [50.0, 50.0, 1.5]


def test_figures_have_null_for_what_is_impossible() -> None:
    found = convergence_figures(COURSES)["a"]
    assert found["clustering"][0] == [None, 5.0, 4.5, 6.0, 6.0]
    assert found["settled"] is True
