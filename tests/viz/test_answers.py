"""Whose mistakes are ringed, and which mover wears which number."""

from dataclasses import replace

import numpy as np
from figures import axes_titled, count_of, make_pair, make_prediction, words

from torchcrf_scan.scan import Scan
from torchcrf_scan.viz import answers, plots


def test_wrong_points_are_ringed_but_not_ignored_or_near_ones():
    pair = make_pair()
    association, cluster = pair.annotation.association.copy(), pair.annotation.cluster.copy()
    association[20] += answers.ASSOCIATION_TOLERANCE  # near enough
    association[30:34] = cluster[30:34] = -1
    ignore = np.zeros(60, dtype=bool)
    ignore[33] = True
    pair = replace(pair, annotation=replace(pair.annotation, ignore=ignore))
    figure = plots.plot_pair(pair, make_prediction(pair, association=association, cluster=cluster))
    for title in ("true associations", "true clusters"):
        assert count_of(axes_titled(figure, title), "predicted wrong") == 3
        assert "3 of 59 wrong" in words(axes_titled(figure, title))
    assert count_of(axes_titled(figure, "predicted associations"), "predicted wrong") == 0


def test_numbering_of_movers_does_not_matter():
    pair = make_pair(movers=3)
    renumbered = np.array([0, 2, 3, 1, -1])[pair.annotation.cluster]
    motions = pair.annotation.motions[[0, 3, 1, 2]]
    prediction = make_prediction(pair, cluster=renumbered, motions=motions)
    ax = axes_titled(plots.plot_clusters(pair, {"renumbered": prediction}), "renumbered")
    assert "0 of 60 wrong" in words(ax)


def test_false_mover_gets_a_new_number():
    pair = make_pair(movers=1)
    cluster = pair.annotation.cluster.copy()
    cluster[40:46] = 7
    ax = axes_titled(plots.plot_clusters(pair, {"method": make_prediction(pair, cluster=cluster)}), "method")
    assert "6 of 60 wrong" in words(ax)
    assert words(ax).count("m/s") == 1  # the motion of mover 7 is unknown


def test_invalid_beams_are_not_drawn():
    pair = make_pair()
    ranges = pair.source.ranges.copy()
    ranges[[7, 40]] = np.nan
    pair = replace(pair, source=Scan.from_ranges(ranges, pair.source.bearings))
    prediction = make_prediction(pair, association=np.full(60, -1), cluster=np.full(60, -1))
    figure = plots.plot_pair(pair, prediction)
    assert "58 outliers" in words(axes_titled(figure, "predicted associations"))
    assert "56 of 58 wrong" in words(axes_titled(figure, "true associations"))
