import dataclasses
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.evaluation.metrics import edit_distance, match_movers, relabel, score_pair, summarise
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair

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


def make_scan(n: int, rng: np.random.Generator, drop: float = 0.0) -> Scan:
    ranges = rng.uniform(2.0, 20.0, n)
    ranges[rng.random(n) < drop] = np.nan
    return Scan.from_ranges(ranges, np.linspace(-1.5, 1.5, n))


def make_pair(n: int, m: int, movers: int, rng: np.random.Generator, drop: float = 0.0) -> ScanPair:
    """A pair with runs of labels, outliers, ignored beams and, if `drop` > 0, beams without a return."""
    source, target = make_scan(n, rng, drop), make_scan(m, rng, drop)
    is_return = source.to_beams(np.ones(len(source), bool), False)
    body = np.repeat(rng.integers(0, movers + 1, n // 6 + 1), 6)[:n]
    is_outlier = (rng.random(n) < 0.2) | ~is_return | (len(target) == 0)
    nearest = target.beam[rng.integers(0, max(len(target), 1), n)] if len(target) else np.full(n, -1)
    motions = rng.normal(0.0, 0.3, (movers + 1, 3))
    cluster = np.where(is_outlier, -1, body)
    annotation = Annotation(np.where(is_outlier, -1, nearest), cluster, motions, body, rng.random(n) < 0.1)
    return ScanPair(source, target, annotation=annotation, sequence="made up", name="pair")


def make_prediction(association: np.ndarray, cluster: np.ndarray, motions: np.ndarray) -> PairPrediction:
    return PairPrediction(association, cluster, motions, np.ones(len(association)), np.ones(len(cluster)), True)


def truth_of(pair: ScanPair) -> Annotation:
    assert pair.annotation is not None
    return pair.annotation


def perfect(pair: ScanPair) -> PairPrediction:
    truth = truth_of(pair)
    return make_prediction(truth.association, truth.cluster, truth.motions)


def perturbed(pair: ScanPair, rng: np.random.Generator, flips: float = 0.2) -> PairPrediction:
    """The truth with shifted and lost associations, wrong clusters, other mover numbers and noise on the motions."""
    truth, n, m = truth_of(pair), pair.source.n_beams, pair.target.n_beams
    shifted = np.clip(truth.association + rng.integers(-3, 4, n) * (rng.random(n) < 0.5), -1, m - 1)
    association = np.where(truth.association < 0, -1, shifted)
    association = np.where(rng.random(n) < flips / 2, rng.integers(-1, m, n), association)
    cluster = np.where(rng.random(n) < flips, rng.integers(-1, 4, n), truth.cluster)
    order = np.append(0, 1 + rng.permutation(max(3, len(truth.motions) - 1)))
    motions = np.full((len(order), 3), np.nan)
    motions[order[: len(truth.motions)]] = truth.motions + rng.normal(0.0, 0.01, truth.motions.shape)
    return make_prediction(association, np.where(cluster < 0, -1, order[cluster]), motions)


def no_movers(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    truth = truth_of(pair)
    return make_prediction(truth.association, np.minimum(truth.cluster, 0), truth.motions[:1] + 0.02)


def motion_rows_missing(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    whole = perturbed(pair, rng, flips=0.05)
    return dataclasses.replace(whole, motions=whole.motions[:1])


def all_outliers(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    n = pair.source.n_beams
    return make_prediction(np.full(n, -1), np.full(n, -1), np.zeros((1, 3)))


def random_labels(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    n = pair.source.n_beams
    return make_prediction(rng.integers(-1, pair.target.n_beams, n), rng.integers(-1, 5, n), rng.normal(0, 0.1, (5, 3)))


PREDICTORS: tuple[Callable[[ScanPair, np.random.Generator], PairPrediction], ...] = (
    perturbed,
    no_movers,
    motion_rows_missing,
    all_outliers,
    random_labels,
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
        np.savez(predictions / path.name, **dataclasses.asdict(prediction))  # also what write_prediction refuses
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


@pytest.fixture
def small() -> ScanPair:
    """Twelve points: five of the background, five of a mover, two outliers; the last is ignored."""
    scan = Scan.from_ranges(np.full(12, 2.0), np.linspace(-1.0, 1.0, 12))
    association = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, -1, -1])
    cluster = np.array([0] * 5 + [1] * 5 + [-1] * 2)
    body = np.where(cluster < 0, 1, cluster)
    motions = np.array([[0.0, 0.1, 0.0], [0.0, 1.0, 0.0]])
    return ScanPair(scan, scan, annotation=Annotation(association, cluster, motions, body, np.arange(12) == 11))


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


def longest_common_subsequence(one: list[int], other: list[int]) -> int:
    row = [0] * (len(other) + 1)
    for a in one:
        above = row
        row = [0]
        for j, b in enumerate(other):
            row.append(above[j] + 1 if a == b else max(above[j + 1], row[j]))
    return row[-1]


@given(st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), max_size=30))
def test_edit_distances_follow_their_definition(labels: list[tuple[int, int]]) -> None:
    """T8: SED2 = 2 N - 2 LCS, SED1 <= Hamming, SED2 <= 2 Hamming."""
    one, other = [a for a, _ in labels], [b for _, b in labels]
    hamming = sum(a != b for a, b in labels)
    strings = np.array(one, dtype=np.int64), np.array(other, dtype=np.int64)
    sed1, sed2 = edit_distance(*strings, 1), edit_distance(*strings, 2)
    assert sed2 == 2 * len(labels) - 2 * longest_common_subsequence(one, other)
    assert sed1 <= hamming
    assert sed2 <= 2 * hamming
    assert sed1 <= sed2


@given(st.integers(0, 10_000), st.permutations([1, 2, 3, 4]))
def test_numbers_of_the_movers_do_not_matter(seed: int, order: list[int]) -> None:
    """T10: renumbering the predicted movers together with their motions changes nothing, ties included."""
    rng = np.random.default_rng(seed)
    pair = make_pair(int(rng.integers(1, 30)), 20, 3, rng, drop=0.1)
    prediction = random_labels(pair, rng)
    renumbered = np.array([0, *order])
    motions = np.empty_like(prediction.motions)
    motions[renumbered] = prediction.motions
    cluster = np.where(prediction.cluster < 0, -1, renumbered[prediction.cluster])
    other = dataclasses.replace(prediction, cluster=cluster, motions=motions)
    assert score_pair(pair, other) == score_pair(pair, prediction)


@given(st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 4)), max_size=25))
def test_no_other_matching_overlaps_more(labels: list[tuple[int, int]]) -> None:
    cluster, predicted = (np.array([pair[i] for pair in labels], dtype=np.int64) for i in (0, 1))
    matched = match_movers(cluster, predicted)
    assert len(set(matched.values())) == len(matched)
    best = max(
        sum(int(((cluster == k) & (predicted == j)).sum()) for k, j in zip((1, 2, 3), order, strict=False))
        for order in permutations((1, 2, 3, 4), 3)
    )
    overlap = sum(int(((cluster == k) & (predicted == j)).sum()) for k, j in matched.items())
    assert overlap == best
    right = int((relabel(predicted, cluster, matched) == cluster).sum())
    assert right == best + int(((cluster == predicted) & (cluster <= 0)).sum())


def test_unmatched_movers_get_numbers_of_their_own() -> None:
    cluster, predicted = np.array([1, 1, 2, 0, 0]), np.array([5, 5, 0, 1, 2])
    matched = match_movers(cluster, predicted)
    assert matched == {1: 5}
    np.testing.assert_array_equal(relabel(predicted, cluster, matched), [1, 1, 0, 3, 4])


def test_background_is_not_matched_to_a_mover() -> None:
    assert match_movers(np.zeros(4, dtype=np.int64), np.ones(4, dtype=np.int64)) == {}


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


def test_undefined_precision_is_zero_or_skipped(small: ScanPair) -> None:
    truth = truth_of(small)
    without = make_prediction(np.maximum(truth.association, 0), np.maximum(truth.cluster, 0), truth.motions)
    summary = summarise([score_pair(small, perfect(small)), score_pair(small, without)])
    assert summary["association_precision"] == 50
    assert summary["association_precision_skipped"] == 100
    assert summary["cluster_recall"] == summary["cluster_recall_skipped"] == 50


def test_unknown_true_motions_are_skipped(small: ScanPair) -> None:
    truth = dataclasses.replace(truth_of(small), motions=np.full((2, 3), np.nan))
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
    prediction = dataclasses.replace(perfect(small), motions=truth_of(small).motions + error)
    summary = summarise([score_pair(small, prediction)])
    assert (summary["ego_success"], summary["ego_success_loose"]) == (strict, loose)


def test_ignored_and_lost_beams_change_nothing() -> None:
    rng = np.random.default_rng(2)
    pair = make_pair(60, 50, 2, rng, drop=0.2)
    prediction = perturbed(pair, rng)
    unseen = truth_of(pair).ignore | ~pair.source.to_beams(np.ones(len(pair.source), bool), False)
    other = dataclasses.replace(
        prediction, association=np.where(unseen, 0, prediction.association), cluster=np.where(unseen, 3, prediction.cluster)
    )
    assert score_pair(pair, other) == score_pair(pair, prediction)


def test_errors_name_what_is_wrong(small: ScanPair) -> None:
    with pytest.raises(ValueError, match="expected an annotation"):
        score_pair(dataclasses.replace(small, annotation=None), perfect(small))
    short = make_prediction(np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"all \(12,\) source beams"):
        score_pair(small, short)
    beyond = dataclasses.replace(perfect(small), association=np.full(12, 12))
    with pytest.raises(ValueError, match="association below 12, got 12"):
        score_pair(small, beyond)
    with pytest.raises(ValueError, match="at least one pair"):
        summarise([])
