"""Figures of consecutive scans: which pairs belong together, colours that stay with their mover, panels."""

from dataclasses import replace

import numpy as np
import pytest
from figures import axes_titled, count_of, make_pair, make_prediction, render, words

from torchcrf_scan.scan import Scan
from torchcrf_scan.viz.marks import mover_look
from torchcrf_scan.viz.sequences import consecutive, plot_association_sequence, plot_cluster_sequence


def swapped(pair):
    """The pair with the numbers of its movers 1 and 2 exchanged in the annotation."""
    truth = pair.annotation
    numbers = np.array([0, 2, 1, -1])
    annotation = replace(truth, cluster=numbers[truth.cluster], motions=truth.motions[[0, 2, 1]])
    return replace(pair, annotation=annotation)


def test_pairs_belong_together_while_they_share_a_scan() -> None:
    pair = make_pair()
    other = replace(pair, source=Scan.from_ranges(np.full(60, 4.0), np.linspace(-3.0, 3.0, 60)))
    assert consecutive([pair] * 5, 0, 3) == [0, 1, 2]
    assert consecutive([pair] * 5, 3, 3) == [3, 4]
    assert consecutive([pair, other, pair], 0, 3) == [0]
    assert consecutive([pair, replace(pair, sequence="another"), pair], 0, 3) == [0]


def test_a_mover_keeps_its_colour_from_pair_to_pair() -> None:
    """The second pair numbers the same movers the other way round; both panels draw each of them in one colour."""
    pair = make_pair(movers=2)
    pairs = [pair, swapped(pair)]
    figure = plot_cluster_sequence(pairs, {"joint": [make_prediction(of) for of in pairs]})
    for title in ("joint", "truth"):
        ax = axes_titled(figure, title)
        for mover in (1, 2):
            drawn = [line.get_xydata() for line in ax.lines if line.get_label() == f"mover {mover}"]
            assert len(drawn) == 2
            np.testing.assert_array_equal(drawn[0], drawn[1])
            assert {line.get_color() for line in ax.lines if line.get_label() == f"mover {mover}"} == {mover_look(mover)[0]}


def test_panels_show_all_scans_and_mistakes(tmp_path) -> None:
    pair = make_pair()
    wrong = make_prediction(pair, association=np.full(60, -1))
    figure = plot_association_sequence([pair] * 3, {"poor": [wrong, make_prediction(pair), wrong]})
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == ["poor", "truth", "magnified", "magnified"]
    ax = axes_titled(figure, "poor")
    assert [count_of(ax, name) for name in ("scan 1", "scan 2", "scan 3", "scan 4, the newest")] == [60] * 4
    assert "116 wrong" in words(ax)  # of 58 inliers each
    assert "122 outliers in 3 pairs" in words(ax)
    assert "4 scans from here on" in figure.get_suptitle()
    render(figure, tmp_path)


def test_without_movers_nothing_is_magnified(tmp_path) -> None:
    pair = make_pair(movers=0)
    figure = plot_association_sequence([pair, pair], {"joint": [make_prediction(pair)] * 2})
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["joint", "truth"]
    render(figure, tmp_path)


def test_pairs_need_an_annotation() -> None:
    with pytest.raises(ValueError, match="pairs: expected annotated pairs, got ring without annotation"):
        plot_cluster_sequence([make_pair(), make_pair(annotated=False)], {})
