"""Scene flow: numbers by hand, against plain loops, and what may not change them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_causes import BIKE, CAR, MOTIONS, WALL, Street, labelled
from made_pairs import PREDICTORS, make_pair, make_prediction, perfect

from torchcrf_scan import PairPrediction, ScanPair
from torchcrf_scan.evaluation.scene_flow import KINDS, FlowErrors, bucket_normalised, end_point_errors, moving_shares
from torchcrf_scan.scan import Annotation, Scan


def flow_of(street: Street, answer: PairPrediction | None = None) -> FlowErrors:
    return FlowErrors.of(street.pair, street.answer if answer is None else answer)


def measures(flow: FlowErrors) -> dict[str, float]:
    return {**end_point_errors(flow), **bucket_normalised(flow), **moving_shares(flow)}


def test_the_truth_has_no_error(street: Street) -> None:
    found = measures(flow_of(street))
    assert [found[f"points_{kind}"] for kind in KINDS] == [14, 0, 41]  # the five that are gone are of no known body
    assert [found[key] for key in ("epe", "epe_moving", "epe_background", "epe_threeway", "bucket_static", "bucket_dynamic")] == [
        0
    ] * 6
    assert math.isnan(found["epe_standing"])
    assert (found["epe_kinds"], found["buckets"]) == (2, 2)
    assert [found[key] for key in ("accuracy_strict", "accuracy_relaxed_moving", "speed_iou", "speed_f1")] == [100] * 4


def test_numbers_by_hand(street: Street) -> None:
    """The car is called background: it went 0.6 m in 0.11 s. The wall's motion is 6 cm off."""
    answer = labelled(street.answer, CAR, cluster=0)
    answer = replace(answer, motions=MOTIONS + np.eye(3, 1) @ [[0.0, 0.06, 0.0]])
    found = measures(flow_of(street, answer))
    assert found["epe_moving"] == pytest.approx(8 * 0.54 / 14)
    assert found["epe_background"] == pytest.approx(0.06)
    assert found["epe_threeway"] == pytest.approx((8 * 0.54 / 14 + 0.06) / 2)
    assert found["accuracy_strict"] == pytest.approx(100 * 6 / 55)
    assert found["accuracy_relaxed"] == pytest.approx(100 * 47 / 55)
    assert found["accuracy_relaxed_moving"] == pytest.approx(100 * 6 / 14)
    assert found["bucket_dynamic"] == pytest.approx((0.54 / 0.6 + 0.0) / 2)
    assert [found[f"speed_{of}"] for of in ("iou", "precision", "recall", "f1")] == pytest.approx(
        [100 * 6 / 14, 100, 100 * 6 / 14, 60]
    )


def test_relative_accuracy_goes_by_the_way_over_the_ground(street: Street) -> None:
    """The bike goes 0.7 m: 3.5 cm are five percent of it, less than five centimetres; of 7 m they would be 35 cm."""
    fast = street.pair.annotation
    assert fast is not None
    motions = MOTIONS * [[1, 1, 1], [1, 1, 1], [1, 10, 1]]
    pair = replace(street.pair, annotation=replace(fast, motions=motions))
    off = replace(street.answer, motions=motions + np.eye(3, 1, -2) @ [[0.0, 0.3, 0.0]])
    found = end_point_errors(FlowErrors.of(pair, off))
    assert found["accuracy_strict"] == 100  # 0.3 of 6.1 m
    still = end_point_errors(FlowErrors.of(street.pair, replace(off, motions=MOTIONS + np.eye(3, 1, -2) @ [[0.0, 0.3, 0.0]])))
    assert still["accuracy_relaxed"] == pytest.approx(100 * 49 / 55)


def test_an_object_below_half_a_metre_per_second_stands(street: Street) -> None:
    slow = replace(street.pair, dt=1.3)  # the car has 0.46 m/s, the bike 0.54
    flow = FlowErrors.of(slow, street.answer)
    assert [int((flow.kind == k).sum()) for k in range(3)] == [6, 8, 41]
    assert flow.is_found_moving.sum() == 6
    off = replace(street.answer, motions=MOTIONS + np.eye(3, 1, -1) @ [[0.0, 0.03, 0.0]])
    found = end_point_errors(FlowErrors.of(slow, off))
    assert found["epe_standing"] == pytest.approx(0.03)
    assert found["epe_threeway"] == pytest.approx(0.01)


def test_an_answered_outlier_goes_with_its_neighbour(street: Street) -> None:
    rejected = labelled(street.answer, slice(43, 46), cluster=-1)
    assert measures(flow_of(street, rejected))["epe"] == 0
    rejected.association[:] = -1
    all_rejected = replace(rejected, cluster=np.full(60, -1))
    assert flow_of(street, all_rejected).is_found_moving.sum() == 0


@pytest.mark.parametrize("motions", [np.zeros((0, 3)), np.full((1, 3), np.nan), np.array([[0.0, 0.1, 0.0], [np.nan] * 3])])
def test_missing_motions_stand_in_for_themselves(street: Street, motions: np.ndarray) -> None:
    flow = flow_of(street, replace(street.answer, motions=motions))
    assert np.isfinite(flow.error).all()
    assert not flow.is_found_moving.any()


def test_points_of_unknown_flow_are_left_out(street: Street) -> None:
    truth = street.pair.annotation
    assert truth is not None
    unknown = replace(truth, motions=np.where(np.arange(3)[:, None] == 1, np.nan, MOTIONS))
    assert len(flow_of(replace(street, pair=replace(street.pair, annotation=unknown))).error) == 47
    lost = replace(truth, motions=np.where(np.arange(3)[:, None] == 0, np.nan, MOTIONS))
    assert len(flow_of(replace(street, pair=replace(street.pair, annotation=lost))).error) == 0
    ignored = replace(truth, ignore=np.arange(60) < 41)
    assert (flow_of(replace(street, pair=replace(street.pair, annotation=ignored))).kind == 0).all()


def naive(pair: ScanPair, answer: PairPrediction) -> list[tuple[float, str, float, float]]:
    """(error, kind, way, found speed) of every point of known flow, in complex numbers; answers without outliers."""
    truth = pair.annotation
    assert truth is not None
    rows = []
    for i, beam in enumerate(pair.source.beam):
        body = truth.cluster[beam] if truth.cluster[beam] >= 0 else truth.body[beam]
        if truth.ignore[beam] or body < 0:
            continue
        point = pair.source.ranges[i] * np.exp(1j * pair.source.bearings[i])
        ends = [point * np.exp(1j * of[0]) + complex(of[1], of[2]) for of in (truth.motions[body], truth.motions[0])]
        founds = [
            point * np.exp(1j * of[0]) + complex(of[1], of[2]) for of in (answer.motions[answer.cluster[beam]], answer.motions[0])
        ]
        way = abs(ends[0] - ends[1])
        kind = "background" if body == 0 else "moving" if way / pair.dt >= 0.5 else "standing"
        rows.append((abs(ends[0] - founds[0]), kind, way, abs(founds[0] - founds[1]) / pair.dt))
    return rows


@given(st.integers(0, 10**6), st.integers(0, 3), st.sampled_from([0.05, 0.5, 2.0]))
def test_against_plain_loops(seed: int, movers: int, dt: float) -> None:
    rng = np.random.default_rng(seed)
    pair = replace(make_pair(30, 30, movers, rng, 0.2), dt=dt)
    answer = make_prediction(np.zeros(30, np.int64), rng.integers(0, 3, 30), rng.normal(0, 0.2, (3, 3)))
    rows, flow = naive(pair, answer), FlowErrors.of(pair, answer)
    found = measures(flow)
    assert flow.error == pytest.approx([row[0] for row in rows])
    means = {kind: [error for error, of, *_ in rows if of == kind] for kind in KINDS}
    for kind, errors in means.items():
        assert found[f"epe_{kind}"] == pytest.approx(np.mean(errors) if errors else np.nan, nan_ok=True)
    some = [np.mean(errors) for errors in means.values() if errors]
    assert found["epe_threeway"] == pytest.approx(np.mean(some) if some else np.nan, nan_ok=True)
    within = [error < 0.05 or (way > 0 and error / way < 0.05) for error, _, way, _ in rows]
    assert found["accuracy_strict"] == pytest.approx(100 * np.mean(within) if rows else np.nan, nan_ok=True)
    both = sum(kind == "moving" and speed >= 0.5 for _, kind, _, speed in rows)
    either = sum(kind == "moving" or speed >= 0.5 for _, kind, _, speed in rows)
    assert found["speed_iou"] == pytest.approx(100 * both / either if either else np.nan, nan_ok=True)
    buckets: dict[int, list[tuple[float, float]]] = {}
    for error, kind, way, _ in rows:
        if kind != "background" and way / dt >= 0.4:
            buckets.setdefault(min(int(way / dt // 0.4), 50), []).append((error, way))
    shares = [sum(e for e, _ in of) / sum(w for _, w in of) for of in buckets.values()]
    assert found["bucket_dynamic"] == pytest.approx(np.mean(shares) if shares else np.nan, nan_ok=True)


@given(st.integers(0, 10**6), st.sampled_from(PREDICTORS))
def test_the_numbers_of_clusters_do_not_matter(seed: int, predictor) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 40, 3, rng)
    answer = predictor(pair, rng)
    K = max(len(answer.motions), int(answer.cluster.max()) + 1)
    motions = np.full((K, 3), np.nan)
    motions[: len(answer.motions)] = answer.motions
    order = np.append(0, 1 + rng.permutation(K - 1))
    renamed = replace(answer, cluster=np.where(answer.cluster < 0, -1, np.argsort(order)[answer.cluster]), motions=motions[order])
    one, other = FlowErrors.of(pair, answer), FlowErrors.of(pair, renamed)
    assert measures(one) == pytest.approx(measures(other), nan_ok=True)


@given(st.integers(0, 10**6), st.sampled_from([*PREDICTORS, lambda pair, rng: perfect(pair)]), st.sampled_from([0.0, 0.5, 1.0]))
def test_nothing_but_a_missing_kind_is_missing(seed: int, predictor, drop: float) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(20, 20, 2, rng, drop)
    flow = FlowErrors.of(pair, predictor(pair, rng))
    assert np.isfinite(flow.error).all()
    assert np.isfinite(flow.found_speed).all()
    found = measures(flow)
    for kind in KINDS:
        assert math.isnan(found[f"epe_{kind}"]) == (found[f"points_{kind}"] == 0)
    for share in ("accuracy_strict", "accuracy_relaxed", "speed_iou", "speed_precision", "speed_recall", "speed_f1"):
        assert math.isnan(found[share]) or 0 <= found[share] <= 100
    assert math.isnan(found["epe"]) == (len(flow.error) == 0)


def test_pairs_are_pooled_by_points(street: Street) -> None:
    off = replace(street.answer, motions=MOTIONS + np.eye(3, 1) @ [[0.0, 0.2, 0.0]])
    together = FlowErrors.pool([flow_of(street), flow_of(street, off), FlowErrors.pool([])])
    assert len(together.error) == 110
    assert end_point_errors(together)["epe_background"] == pytest.approx(0.1)
    assert all(
        math.isnan(value)
        for key, value in measures(FlowErrors.pool([])).items()
        if not key.startswith(("points", "epe_k", "buckets"))
    )


def test_an_empty_scan_and_a_pair_without_annotation() -> None:
    empty, nothing = Scan.from_ranges([], []), np.zeros(0, np.int64)
    truth = Annotation(nothing, nothing, np.zeros((1, 3)), nothing, nothing.astype(bool))
    answer = make_prediction(nothing, nothing, np.zeros((1, 3)))
    assert len(FlowErrors.of(ScanPair(empty, empty, annotation=truth), answer).error) == 0
    with pytest.raises(ValueError, match="expected an annotation"):
        FlowErrors.of(ScanPair(empty, empty), answer)


def test_the_street_is_as_its_slices_say(street: Street) -> None:
    flow = flow_of(street)
    by_beam = np.full(60, -1)
    by_beam[street.pair.source.beam[: len(flow.kind)]] = flow.kind  # those without a known body come last by bearing
    assert (by_beam[WALL] == 2).all()
    assert (by_beam[CAR] == 0).all()
    assert (by_beam[BIKE] == 0).all()
