"""Tables of scene flow, moving points and ranges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_causes import MOTIONS, labelled, make_street

from torchcrf_scan import JointScanCRF
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.evaluation.neighbours import RANGES, NeighbourScore, errors_by_range, neighbour_tables, summarise_neighbours


def scores() -> list[NeighbourScore]:
    """The truth, and an answer with two wrong associations at the wall's end and a background that is 20 cm off."""
    street = make_street()
    off = labelled(street.answer, slice(39, 41), association=-5)
    off = replace(off, motions=MOTIONS + np.eye(3, 1) @ [[0.0, 0.2, 0.0]])
    return [NeighbourScore.of(street.pair, answer) for answer in (street.answer, off)]


def test_ranges_hold_all_points_once() -> None:
    found = errors_by_range(scores())
    assert list(found) == ["0 to 5 m", "5 to 10 m", "10 to 20 m", "20 to 40 m", "from 40 m"]
    assert len(found) == len(RANGES) - 1
    assert sum(row["points"] for row in found.values()) == 120
    wall = found["10 to 20 m"]
    assert wall["points"] == 82
    assert wall["association_wrong"] == pytest.approx(100 * 2 / 82)
    assert (wall["cluster_wrong"], wall["epe_cm"]) == (0, pytest.approx(10))
    assert np.isnan([wall["epe_moving_cm"], wall["moving_found"], found["from 40 m"]["epe_cm"]]).all()
    assert found["5 to 10 m"]["moving_found"] == 100


def test_tables_have_the_summary_in_centimetres_and_dashes() -> None:
    some = scores()
    flow, moving, ranges = neighbour_tables({"first": some[:1], "all": some})
    summary = summarise_neighbours(some)
    assert [row[0] for row in flow.rows] == [row[0] for row in moving.rows] == ["first", "all"]
    assert (
        flow.rows[1][flow.columns.index("background (cm)")] == pytest.approx(100 * summary["epe_background"]) == pytest.approx(10)
    )
    assert moving.rows[1][moving.columns.index("panoptic quality (%)")] == summary["pq"] == 100
    assert "| - |" in flow.to_markdown()  # no standing objects
    assert "nan" not in "".join(table.to_markdown() for table in (flow, moving, ranges))
    assert len(ranges.rows) == 5


def test_no_pairs_print_dashes() -> None:
    text = "".join(table.to_markdown() for table in neighbour_tables({"none": []}))
    assert "nan" not in text
    assert neighbour_tables({}) != []


def test_real_pairs_agree_with_the_older_measures(real_pairs_dir: Path) -> None:
    pairs = [PairFiles(real_pairs_dir)[k] for k in (0, 40)]
    for pair, answer in zip(pairs, JointScanCRF.from_pretrained().match_pairs(pairs), strict=True):
        score, beside = score_pair(pair, answer), NeighbourScore.of(pair, answer)
        assert len(beside.range) == score.association.points
        assert beside.wrong_association.sum() == score.association.points - score.within_2
        assert beside.wrong_cluster.sum() == score.cluster.points - score.cluster.right
        found = [thing for thing in score.objects if thing.is_counted and thing.is_found]
        assert beside.panoptic.matched >= len(found)
        background = next(thing.error for thing in score.objects if not thing.is_mover)
        assert background is not None
        assert beside.flow.error[beside.flow.kind == 2].mean() < 0.05 + 2 * background.centroid
