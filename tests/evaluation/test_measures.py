"""Metrics by the register: counted, averaged and shown without another line."""

from dataclasses import replace

import numpy as np
import pytest
from made_pairs import make_pair, perturbed

from torchcrf_scan.evaluation.measures import EVERY, MEASURES, Labelled, inliers_right, target_distance
from torchcrf_scan.evaluation.metrics import PairScore, score_pair
from torchcrf_scan.evaluation.report import report
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.scan import ScanPair


def a_pair() -> ScanPair:
    return make_pair(40, 50, 2, np.random.default_rng(1))


def a_score() -> PairScore:
    pair = a_pair()
    return score_pair(pair, perturbed(pair, np.random.default_rng(2)))


def labelled() -> Labelled:
    """Four beams: right, one target off, a lost counterpart, an outlier that is called one."""
    pair = a_pair()
    association, predicted = np.array([0, 1, 2, -1]), np.array([0, 2, -1, -1])
    return Labelled(pair, association, np.zeros(4, np.int64), np.zeros(4, np.int64), predicted, np.zeros(4, np.int64))


def test_exact_associations_of_points_with_a_counterpart() -> None:
    assert inliers_right(labelled()) == (1.0, 3.0)


def test_distance_between_the_true_and_the_predicted_return() -> None:
    labels = labelled()
    points = labels.pair.target.to_beams(labels.pair.target.points, np.nan)
    total, count = target_distance(labels)
    assert count == 2
    assert total == pytest.approx(np.linalg.norm(points[1] - points[2]))


def test_every_measure_has_its_figure_and_its_column() -> None:
    scores = {"method": [a_score()]}
    figures = summarise(scores["method"])
    columns = {column for table in report(scores) for column in table.columns}
    for table in MEASURES:
        for key, measure in MEASURES[table].items():
            assert measure.heading in columns
            part, whole = scores["method"][0].counts[key]
            assert figures[key] == pytest.approx(part / whole if measure.is_pooled else 100 * part / whole)


def test_a_mean_over_pairs_is_not_a_pooled_share(monkeypatch: pytest.MonkeyPatch) -> None:
    score, key = a_score(), "association_inlier_accuracy"
    scores = [replace(score, counts={**score.counts, key: count}) for count in ((1.0, 1.0), (0.0, 9.0))]
    assert summarise(scores)[key] == pytest.approx(50.0)
    monkeypatch.setitem(EVERY, key, replace(EVERY[key], is_pooled=True))
    assert summarise(scores)[key] == pytest.approx(0.1)
