"""Where a figure looks, and the time that its arrows stand for."""

from dataclasses import replace

import numpy as np
import pytest
from figures import axes_titled, make_pair, make_prediction, words
from matplotlib.quiver import Quiver

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Scan
from torchcrf_scan.viz import plots


def test_velocity_is_relative_to_the_world_and_ego_motion_is_the_inverse():
    pair = make_pair()
    ax = axes_titled(plots.plot_clusters(pair, {"method": make_prediction(pair)}), "method")
    assert "1.00 m/s" in words(ax)
    assert "dx +0.20 m, dy +0.00 m" in words(ax)
    arrow = next(item for item in ax.collections if isinstance(item, Quiver))
    assert np.asarray(arrow.U) == pytest.approx(0.0, abs=1e-9)
    assert np.asarray(arrow.V).item() > 0.0


def test_velocity_under_rotation_is_in_the_source_frame():
    pair = make_pair()
    background, ahead = np.array([0.3, -0.2, 0.1]), np.array([0.0, 0.5, 0.0])  # T = background after 0.5 m ahead
    motions = np.stack([background, se2.compose(background, ahead)])
    ax = axes_titled(plots.plot_clusters(pair, {"method": make_prediction(pair, motions=motions)}), "method")
    arrow = next(item for item in ax.collections if isinstance(item, Quiver))
    assert "5.00 m/s" in words(ax)
    assert np.asarray(arrow.V) == pytest.approx(0.0, abs=1e-9)


def test_a_static_cluster_has_speed_zero():
    pair = make_pair()
    motions = np.tile(pair.annotation.motions[:1], (2, 1))
    figure = plots.plot_clusters(pair, {"still": make_prediction(pair, motions=motions)})
    assert "0.00 m/s" in words(axes_titled(figure, "still"))


def test_far_points_do_not_shrink_the_picture():
    pair = make_pair(annotated=False)
    ranges = pair.source.ranges.copy()
    ranges[30] = 500.0
    ax = plots.plot_pair(replace(pair, source=Scan.from_ranges(ranges, pair.source.bearings))).axes[0]
    assert ax.get_xlim()[1] < 20.0
    assert ax.get_aspect() == 1.0


def test_zoom_holds_the_largest_mover():
    pair = make_pair(movers=2)
    cluster = pair.annotation.cluster.copy()
    cluster[15:20] = 2
    figure = plots.plot_pair(replace(pair, annotation=replace(pair.annotation, cluster=cluster)))
    ax = axes_titled(figure, "magnified")
    x, y = pair.source.points[cluster == 2].T
    assert ax.get_xlim()[0] < x.min() < x.max() < ax.get_xlim()[1]
    assert ax.get_ylim()[0] < y.min() < y.max() < ax.get_ylim()[1]


def test_arrows_of_all_methods_stand_for_the_same_time():
    pair = make_pair()
    fast = make_prediction(pair, motions=np.array([[0.0, -0.2, 0.0], [0.0, 5.0, 0.0]]))
    figure = plots.plot_clusters(pair, {"fast": fast, "right": make_prediction(pair)})
    assert len({text.get_text() for ax in figure.axes for text in ax.texts if text.get_text().startswith("arrow")}) == 1
