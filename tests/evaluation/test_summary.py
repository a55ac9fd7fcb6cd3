import dataclasses
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_pairs import PREDICTORS, all_outliers, make_pair, make_prediction, perfect, perturbed, random_labels

from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.evaluation.calibration import expected_calibration_error, rightness
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.scan import PairPrediction, ScanPair

SCORER = Path(__file__).resolve().parents[3] / "shared" / "tools" / "score.py"
ALWAYS_DEFINED = (
    "pairs",
    "accuracy",
    "within",
    "sed",
    "outliers",
    "recall",
    "precision",
    "iou",
    "movers",
    "objects",
    "success",
    "answered",
)


def run_scorer(pairs: Path, predictions: Path) -> dict[str, dict[str, float]]:
    command = [sys.executable, str(SCORER), str(pairs), str(predictions), "--json"]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def same_columns(summary: dict[str, float]) -> dict[str, object]:
    """The columns of the independent scorer (which computes points in the files' float32) from a summary."""
    return {
        "pairs": summary["pairs"],
        "assoc": summary["association_accuracy"],
        "assoc2": summary["association_within_2"],
        "clus": summary["cluster_accuracy"],
        "oP": summary["association_precision"],
        "oR": summary["association_recall"],
        "mvIoU": summary["iou_moving"],
        "ego_r": [1e3 * summary["ego_rotation_median"], 1e3 * summary["ego_rotation_p95"]],
        "ego_t": [summary["ego_translation_median"], summary["ego_translation_p95"]],
        "ok": summary["ego_success"],
        "det": summary["movers_found"],
        "obj_t": summary["found_mover_centroid_median"],
    }


def assert_agrees_with_scorer(folder: Path, predict: Callable[[ScanPair, np.random.Generator], PairPrediction]) -> None:
    if not SCORER.exists():
        pytest.skip(f"needs the independent scorer, which is not part of the repository: no {SCORER}")
    rng = np.random.default_rng(5)
    predictions = folder.parent / "predictions"
    predictions.mkdir()
    scores = []
    for path in sorted(folder.glob("*.npz")):
        pair = read_pair(path)
        prediction = predict(pair, rng)
        given = {key: value for key, value in dataclasses.asdict(prediction).items() if value is not None}
        np.savez(predictions / path.name, **given)  # also what write_prediction refuses
        scores.append(score_pair(pair, prediction))
    expected = run_scorer(folder, predictions)
    groups = {name: [score for score in scores if score.sequence == name] for name in {score.sequence for score in scores}}
    assert set(expected) == {"ALL", *groups}
    for name, group in (groups | {"ALL": scores}).items():
        figures = same_columns(summarise(group))
        assert figures.keys() == expected[name].keys()
        for column, value in figures.items():
            np.testing.assert_allclose(value, expected[name][column], rtol=1e-6, atol=1e-9, err_msg=f"{name}: {column}")


@pytest.mark.parametrize("predict", PREDICTORS)
def test_same_figures_as_the_independent_scorer_on_real_pairs(
    predict: Callable[[ScanPair, np.random.Generator], PairPrediction], real_pairs_dir: Path, tmp_path: Path
) -> None:
    (tmp_path / "pairs").mkdir()
    for path in sorted(real_pairs_dir.glob("*.npz"))[::8]:
        shutil.copy(path, tmp_path / "pairs")
    assert_agrees_with_scorer(tmp_path / "pairs", predict)


@pytest.mark.parametrize("predict", [perturbed, random_labels])
def test_same_figures_as_the_independent_scorer_with_lost_beams(
    predict: Callable[[ScanPair, np.random.Generator], PairPrediction], tmp_path: Path
) -> None:
    (tmp_path / "pairs").mkdir()
    rng = np.random.default_rng(1)
    for i in range(8):
        write_pair(tmp_path / "pairs" / f"{i}.npz", make_pair(90, 80, 3, rng, drop=0.2))
    assert_agrees_with_scorer(tmp_path / "pairs", predict)


def test_figures_computed_by_hand(small: ScanPair) -> None:
    association = np.array([0, 2, 4, 6, -1, 5, 6, 7, 8, -1, -1, 3])
    cluster = np.array([0, 0, 0, 0, 2, 2, 2, 2, 2, -1, -1, 5])
    motions = np.array([[0.01, 0.13, 0.04], [np.nan] * 3, [0.0, 1.0, 0.5]])
    score = score_pair(small, make_prediction(association, cluster, motions))
    summary = summarise([score])
    assert score.association.points == 11
    assert summary["association_accuracy"] == pytest.approx(100 * 6 / 11)
    assert summary["association_within_1"] == pytest.approx(100 * 7 / 11)
    assert summary["association_within_2"] == pytest.approx(100 * 8 / 11)
    assert summary["association_inlier_accuracy"] == pytest.approx(100 * 5 / 10)
    assert summary["association_outliers_found"] == pytest.approx(100 * 3 / 11)
    assert summary["association_outliers_true"] == pytest.approx(100 / 11)
    assert summary["association_recall"] == 100
    assert summary["association_precision"] == pytest.approx(100 / 3)
    assert summary["cluster_accuracy"] == pytest.approx(100 * 9 / 11)
    assert summary["cluster_precision"] == 50
    assert summary["iou_moving"] == pytest.approx(100 * 4 / 7)
    assert (summary["movers_found"], summary["movers"]) == (100, 1)
    chords = 2 * 2.0 * np.sin(np.array([1, 2, 3]) / 11)
    assert summary["target_distance"] == pytest.approx(chords.sum() / 8)
    assert (summary["ego_rotation_median"], summary["ego_translation_median"]) == pytest.approx((0.01, 0.05))
    assert (summary["ego_success"], summary["ego_success_loose"]) == (0, 0)
    assert (summary["motion_objects"], summary["mover_motion_objects"]) == (2, 1)
    assert summary["mover_motion_translation"] == pytest.approx(0.5)
    assert summary["found_mover_centroid_median"] == pytest.approx(0.5)
    assert summary["motion_translation"] == pytest.approx((0.05 + 0.5) / 2)
    assert summary["motion_rotation"] == pytest.approx(0.005)


def test_perfect_prediction_has_perfect_figures(small: ScanPair) -> None:
    summary = summarise([score_pair(small, perfect(small))])
    assert summary["iou_moving"] == pytest.approx(100 * 5 / 6)  # an outlier of a moving body is moving, but cannot be called so
    for key, value in summary.items():
        if key.endswith(("accuracy", "recall", "precision", "skipped", "success", "movers_found")):
            assert value == 100, key
        if "sed" in key or key.endswith(("rotation", "translation", "centroid", "median", "p95", "distance")):
            assert value == pytest.approx(0.0, abs=1e-12), key


@given(st.integers(0, 10_000), st.sampled_from(PREDICTORS), st.integers(0, 3))
def test_figures_are_always_defined(seed: int, predict: Callable[..., PairPrediction], movers: int) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(int(rng.integers(0, 25)), int(rng.integers(1, 20)), movers, rng, drop=0.3)
    summary = summarise([score_pair(pair, predict(pair, rng))])
    for key, value in summary.items():
        assert not math.isinf(value), key
        if any(part in key for part in ALWAYS_DEFINED) and not key.endswith("_skipped"):
            assert not math.isnan(value), key
        if any(part in key for part in ("accuracy", "recall", "precision", "success", "iou", "movers_found")):
            assert math.isnan(value) or 0 <= value <= 100, key


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0)])
def test_empty_scans_have_figures(n: int, m: int) -> None:
    rng = np.random.default_rng(0)
    pair = make_pair(n, m, 1, rng)
    score = score_pair(pair, all_outliers(pair, rng))
    summary = summarise([score])
    assert score.association.points <= n
    assert summary["association_accuracy"] == (100 if n else 0)
    assert summary["cluster_sed2"] == 0
    assert math.isnan(summary["target_distance"])
    assert math.isnan(summary["association_inlier_accuracy_skipped"])
    assert math.isnan(summary["cluster_ece"]) == (score.cluster.points == 0)


def test_undefined_precision_is_zero_or_skipped(small: ScanPair) -> None:
    truth = annotation_of(small)
    without = make_prediction(np.maximum(truth.association, 0), np.maximum(truth.cluster, 0), truth.motions)
    summary = summarise([score_pair(small, perfect(small)), score_pair(small, without)])
    assert summary["association_precision"] == 50
    assert summary["association_precision_skipped"] == 100
    assert summary["cluster_recall"] == summary["cluster_recall_skipped"] == 50


def test_unknown_true_motions_are_skipped(small: ScanPair) -> None:
    truth = dataclasses.replace(annotation_of(small), motions=np.full((2, 3), np.nan))
    unknown = dataclasses.replace(small, annotation=truth)
    prediction = perfect(small)
    summary = summarise([score_pair(unknown, prediction), score_pair(small, prediction)])
    assert (summary["ego_success"], summary["ego_answered"], summary["motion_objects"]) == (100, 100, 2)
    assert summary["movers_found"] == 100


def test_an_ego_motion_without_answer_is_no_success(small: ScanPair) -> None:
    silent = dataclasses.replace(perfect(small), motions=np.full((2, 3), np.nan))
    summary = summarise([score_pair(small, silent), score_pair(small, perfect(small))])
    assert (summary["ego_success"], summary["ego_answered"], summary["ego_translation_median"]) == (50, 50, 0)


@pytest.mark.parametrize(
    ("error", "strict", "loose"),
    [((0.017, 0.0, 0.0), 100, 0), ((0.008, 0.1, 0.1), 0, 100), ((2 * np.pi, 0.01, 0.01), 100, 100), ((0.0, 0.2, 0.0), 0, 0)],
)
def test_both_bounds_of_a_good_ego_motion(small: ScanPair, error: tuple[float, float, float], strict: float, loose: float) -> None:
    prediction = dataclasses.replace(perfect(small), motions=annotation_of(small).motions + error)
    summary = summarise([score_pair(small, prediction)])
    assert (summary["ego_success"], summary["ego_success_loose"]) == (strict, loose)


def test_no_scores_are_refused() -> None:
    with pytest.raises(ValueError, match="scores: expected at least one pair"):
        summarise([])


def sure(pair: ScanPair, seed: int) -> PairPrediction:
    """A prediction that tells how sure it is of everything."""
    rng = np.random.default_rng(seed)
    prediction, n = perturbed(pair, rng), pair.source.n_beams
    covariances = np.tile(0.01**2 * np.eye(3), (len(prediction.motions), 1, 1))
    return dataclasses.replace(
        prediction, association_confidence=rng.random(n), cluster_confidence=rng.random(n), covariances=covariances
    )


def test_calibration_errors_are_of_all_annotated_returns() -> None:
    pairs = [make_pair(60, 50, 2, np.random.default_rng(seed), drop=0.1) for seed in range(3)]
    answers = [sure(pair, seed) for seed, pair in enumerate(pairs)]
    summary = summarise([score_pair(pair, answer) for pair, answer in zip(pairs, answers, strict=True)])
    confidences, right = [], []
    for pair, answer in zip(pairs, answers, strict=True):
        found = rightness(pair, answer)
        confidences.append(answer.association_confidence[pair.source.beam][found.known])
        right.append(found.within[found.known])
    expected = expected_calibration_error(np.concatenate(confidences), np.concatenate(right))
    assert summary["association_ece"] == pytest.approx(100 * expected)
    assert 0 < summary["cluster_ece"] < 100


def test_a_sure_answer_errs_by_its_mistakes(small: ScanPair) -> None:
    """Where everything is told with confidence 1, the calibration error is the share of what is wrong."""
    association = np.array([0, 2, 4, 6, -1, 5, 6, 7, 8, -1, -1, 3])
    cluster = np.array([0, 0, 0, 0, 2, 2, 2, 2, 2, -1, -1, 5])
    summary = summarise([score_pair(small, make_prediction(association, cluster, np.zeros((6, 3))))])
    assert summary["association_ece"] == pytest.approx(100 - summary["association_within_2"])
    assert summary["cluster_ece"] == pytest.approx(100 - summary["cluster_accuracy"])


def test_normalised_errors_by_hand(small: ScanPair) -> None:
    """Errors (0.01, 0.02, 0) under deviations of 0.01; then none, and no covariance."""
    motions = annotation_of(small).motions + np.array([0.01, 0.02, 0.0])
    off = dataclasses.replace(perfect(small), motions=motions, covariances=np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    right = dataclasses.replace(off, motions=annotation_of(small).motions)
    summary = summarise([score_pair(small, answer) for answer in (off, right, right, perfect(small))])
    assert summary["nees_pairs"] == 3
    assert summary["nees_mean"] == pytest.approx(5 / 3)
    assert summary["nees_covered"] == 100
    assert summary["nees_low"] == pytest.approx(2.70 / 3, abs=1e-3)  # chi2(9), tables
    assert summary["nees_high"] == pytest.approx(19.02 / 3, abs=1e-2)
    far = dataclasses.replace(off, motions=annotation_of(small).motions + 0.1)
    assert summarise([score_pair(small, far), score_pair(small, right)])["nees_covered"] == 50


def test_nothing_is_said_of_covariances_that_are_none(small: ScanPair) -> None:
    given = dataclasses.replace(perfect(small), covariances=np.tile(np.eye(3), (2, 1, 1)))
    assert score_pair(small, given).sureness.nees == 0
    unknown = dataclasses.replace(small, annotation=dataclasses.replace(annotation_of(small), motions=np.full((2, 3), np.nan)))
    silent = dataclasses.replace(given, motions=np.full((2, 3), np.nan))
    flat = dataclasses.replace(given, covariances=np.zeros((2, 3, 3)))
    for pair, answer in ((small, perfect(small)), (unknown, given), (small, silent), (small, flat)):
        summary = summarise([score_pair(pair, answer)])
        assert summary["nees_pairs"] == 0
        assert all(math.isnan(summary[key]) for key in ("nees_covered", "nees_mean", "nees_low", "nees_high"))
