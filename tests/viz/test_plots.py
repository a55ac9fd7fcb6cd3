"""Figures: what is drawn where, on tiny pairs made by hand; nothing breaks on empty or incomplete answers."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair
from torchcrf_scan.viz import plots


def make_pair(n=60, movers=1, annotated=True):
    """A ring of returns; the sensor drives 0.2 m ahead, mover k (five returns each) 0.1 m to the left in 0.1 s."""
    bearings = np.linspace(-3.0, 3.0, n)
    scan = Scan.from_ranges(np.full(n, 5.0), bearings)
    cluster = np.zeros(n, dtype=np.int64)
    for k in range(1, movers + 1):
        cluster[(5 * k) % max(n, 1) : (5 * k) % max(n, 1) + 5] = k
    association = np.arange(n)
    association[-2:] = cluster[-2:] = -1
    motions = np.tile([0.0, -0.2, 0.0], (movers + 1, 1))
    motions[1:, 2] += 0.1
    annotation = Annotation(association, cluster, motions, cluster.copy(), np.zeros(n, dtype=bool))
    return ScanPair(scan, scan, 0.1, annotation if annotated else None, name="ring")


def make_prediction(pair, **changes):
    truth = pair.annotation
    one = np.ones(pair.source.n_beams)
    return replace(PairPrediction(truth.association, truth.cluster, truth.motions, one, one, True), **changes)


def axes_titled(figure, title):
    return next(ax for ax in figure.axes if ax.get_title(loc="left") == title)


def words(ax):
    return " | ".join([*(text.get_text() for text in ax.texts), ax.get_title(loc="right")])


def count_of(ax, label):
    return sum(len(line.get_xdata()) for line in ax.lines if line.get_label() == label)


def render(figure, tmp_path):
    plots.save_figure(figure, tmp_path / "deep" / "figure.png", dpi=30)
    assert (tmp_path / "deep" / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_pair_has_a_row_for_prediction_and_truth(tmp_path):
    pair = make_pair()
    figure = plots.plot_pair(pair, make_prediction(pair))
    assert isinstance(figure, Figure)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == [
        *("both scans", "predicted associations", "predicted clusters", "magnified"),
        *("sensor's motion undone", "true associations", "true clusters", "magnified"),
    ]
    render(figure, tmp_path)


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
    motions = np.stack([background, plots.se2.compose(background, ahead)])
    ax = axes_titled(plots.plot_clusters(pair, {"method": make_prediction(pair, motions=motions)}), "method")
    arrow = next(item for item in ax.collections if isinstance(item, Quiver))
    assert "5.00 m/s" in words(ax)
    assert np.asarray(arrow.V) == pytest.approx(0.0, abs=1e-9)


def test_a_static_cluster_has_speed_zero():
    pair = make_pair()
    motions = np.tile(pair.annotation.motions[:1], (2, 1))
    figure = plots.plot_clusters(pair, {"still": make_prediction(pair, motions=motions)})
    assert "0.00 m/s" in words(axes_titled(figure, "still"))


def test_wrong_points_are_ringed_but_not_ignored_or_near_ones():
    pair = make_pair()
    association, cluster = pair.annotation.association.copy(), pair.annotation.cluster.copy()
    association[20] += plots.ASSOCIATION_TOLERANCE  # near enough
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


def test_association_lines_join_source_and_target():
    pair = make_pair(n=6, movers=0)
    target = Scan.from_ranges(np.full(6, 4.0), pair.target.bearings)
    figure = plots.plot_pair(replace(pair, target=target), make_prediction(pair))
    line = next(line for line in axes_titled(figure, "true associations").lines if line.get_label() == "association")
    path = np.asarray(line.get_xydata()).reshape(-1, 3, 2)
    np.testing.assert_allclose(path[:, 0], pair.source.points[:4])
    np.testing.assert_allclose(path[:, 1], target.points[:4])
    assert np.isnan(path[:, 2]).all()


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


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("annotated", [True, False])
def test_tiny_scans(n, annotated, tmp_path):
    pair = make_pair(n=n, movers=0)
    prediction = make_prediction(pair)
    pair = pair if annotated else replace(pair, annotation=None)
    figure = plots.plot_pair(pair, prediction)
    assert len(figure.axes) == (6 if annotated else 3)  # no mover, no magnified column
    render(figure, tmp_path)


@pytest.mark.parametrize("empty", ["source", "target"])
def test_one_empty_scan(empty, tmp_path):
    pair = replace(make_pair(annotated=False), **{empty: Scan.from_ranges([], [])})
    n = pair.source.n_beams
    none = np.full(n, -1)
    prediction = PairPrediction(none, none, np.full((1, 3), np.nan), np.ones(n), np.ones(n), False)
    figure = plots.plot_pair(pair, prediction)
    assert "unknown" in words(axes_titled(figure, "predicted clusters"))
    render(figure, tmp_path)


@pytest.mark.parametrize("motions", [np.full((2, 3), np.nan), np.zeros((0, 3)), np.array([[0.0, 0.1, 0.0], [np.nan] * 3])])
def test_unknown_motions_have_no_arrow(motions, tmp_path):
    pair = make_pair()
    pair = replace(pair, annotation=replace(pair.annotation, motions=motions))
    figure = plots.plot_clusters(pair, {})
    assert "m/s" not in words(axes_titled(figure, "truth"))
    render(figure, tmp_path)


@pytest.mark.parametrize("dt", [0.0, np.nan])
def test_unknown_time_has_no_speeds(dt, tmp_path):
    pair = replace(make_pair(), dt=dt)
    figure = plots.plot_clusters(pair, {})
    assert "m/s" not in words(axes_titled(figure, "truth"))
    render(figure, tmp_path)


def test_thirty_movers_look_different(tmp_path):
    pair = make_pair(n=200, movers=30)
    assert len({plots._look(k) for k in range(1, 31)}) == 30
    figure = plots.plot_pair(pair)
    assert words(axes_titled(figure, "true clusters")).count("m/s") == plots.MAX_SPEED_LABELS
    render(figure, tmp_path)


def test_invalid_beams_are_not_drawn():
    pair = make_pair()
    ranges = pair.source.ranges.copy()
    ranges[[7, 40]] = np.nan
    pair = replace(pair, source=Scan.from_ranges(ranges, pair.source.bearings))
    prediction = make_prediction(pair, association=np.full(60, -1), cluster=np.full(60, -1))
    figure = plots.plot_pair(pair, prediction)
    assert "58 outliers" in words(axes_titled(figure, "predicted associations"))
    assert "56 of 58 wrong" in words(axes_titled(figure, "true associations"))


def test_without_prediction_and_annotation_only_the_scans():
    assert [ax.get_title(loc="left") for ax in plots.plot_pair(make_pair(annotated=False)).axes] == ["both scans"]


def test_methods_side_by_side_with_the_truth_last(tmp_path):
    pair = make_pair()
    methods = {
        name: make_prediction(pair)
        for name in ("ICP", "$weird_{name", "joint", "a name that is longer than its panel is wide, by far")
    }
    associations, clusters = plots.plot_associations(pair, methods), plots.plot_clusters(pair, methods)
    drawn = [ax.get_title(loc="left") for ax in clusters.axes if ax.axison]
    assert drawn == [*methods, "truth"]
    assert [t for t in (ax.get_title(loc="left") for ax in associations.axes if ax.axison) if t != "magnified"] == drawn
    render(clusters, tmp_path)


def test_arrows_of_all_methods_stand_for_the_same_time():
    pair = make_pair()
    fast = make_prediction(pair, motions=np.array([[0.0, -0.2, 0.0], [0.0, 5.0, 0.0]]))
    figure = plots.plot_clusters(pair, {"fast": fast, "right": make_prediction(pair)})
    assert len({text.get_text() for ax in figure.axes for text in ax.texts if text.get_text().startswith("arrow")}) == 1


def test_errors_name_what_was_expected(tmp_path):
    pair = make_pair()
    with pytest.raises(ValueError, match=r"prediction.cluster: expected shape \(60,\), got \(3,\)"):
        plots.plot_pair(pair, make_prediction(pair, cluster=np.zeros(3, dtype=np.int64)))
    with pytest.raises(ValueError, match=r"icp.association: expected indices below 60, got 60"):
        plots.plot_clusters(pair, {"icp": make_prediction(pair, association=np.full(60, 60))})
    with pytest.raises(ValueError, match="at least one method"):
        plots.plot_associations(make_pair(annotated=False), {})
    with pytest.raises(ValueError, match=r"ending in \.png"):
        plots.save_figure(Figure(), tmp_path / "figure.pdf")


def test_save_leaves_the_old_file_when_drawing_fails(tmp_path):
    class Broken(Figure):
        def savefig(self, name, **_):
            Path(name).write_bytes(b"half")
            raise RuntimeError("disk full")

    path = tmp_path / "figure.png"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="disk full"):
        plots.save_figure(Broken(), path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_import_is_light_and_figures_never_touch_pyplot():
    code = (
        "import sys; from torchcrf_scan.viz import plots; assert 'matplotlib' not in sys.modules;"
        "from torchcrf_scan.scan import Scan, ScanPair; s = Scan.from_ranges([1.0], [0.0]); plots.plot_pair(ScanPair(s, s));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
