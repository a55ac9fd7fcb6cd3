"""The picture of a recording has its map, its path, its objects and its doubts."""

from dataclasses import replace

import numpy as np
from results import lost, true_results

from torchcrf_scan.viz.history import Tally
from torchcrf_scan.viz.summary import Summary


def test_a_summary_shows_path_map_tracks_and_doubts() -> None:
    summary, results = Summary(), true_results(40)
    for k, result in enumerate(results):
        summary.add(lost(result, "dark") if 10 <= k < 14 else result)
    figure = summary.plot("drive_1")
    plane, speed, objects = figure.axes
    lines = [line.get_xydata() for line in plane.lines]
    sensor = np.concatenate([line for line in lines if len(line) > 1])
    assert all(np.isclose(sensor, result.pose[1:]).all(axis=1).any() for result in results)
    assert len(lines[0]) > 50
    assert figure.texts[0].get_text() == "drive_1"
    assert "lost 10.0 %" in figure.texts[1].get_text()
    seen = {one.number for result in results for one in result.objects if one.points}
    assert len(objects.collections) == len(seen)
    assert len(speed.patches) == 1
    labels = [text.get_text() for text in plane.get_legend().get_texts()]
    assert labels[0] == "static points"
    assert "its pose lost" in labels
    assert "its pose degenerate" not in labels
    figure.canvas.draw()


def test_a_single_scan_in_which_nothing_moves_has_a_summary() -> None:
    summary, (result, _) = Summary(), true_results(2)
    summary.add(replace(result, objects=()))
    figure = summary.plot("one")
    assert figure.axes[2].texts[0].get_text() == "nothing moving was seen"
    figure.canvas.draw()
    assert isinstance(summary.tally, Tally)
