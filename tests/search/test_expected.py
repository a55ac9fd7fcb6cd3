"""Movers expected from before, among the hypotheses of the search."""

import numpy as np
import pytest
import torch
from surveyed import SIMULATED

from torchcrf_scan import JointScanCRF, ScanPair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.loops.pair import Pair, pair_of_scans
from torchcrf_scan.search.expected import Expected
from torchcrf_scan.search.groups import MIN_POINTS
from torchcrf_scan.search.hypotheses import members_of
from torchcrf_scan.search.pairs import find_start
from torchcrf_scan.search.pool import alone
from torchcrf_scan.search.survey import Survey, survey_at


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


@pytest.fixture(scope="module")
def scans() -> ScanPair:
    """A pair with a mover."""
    pairs = simulate_pairs(SIMULATED["street"], 6, 1, 2)
    return max(pairs, key=lambda pair: np.count_nonzero(pair.annotation.cluster > 0) if pair.annotation else 0)


def truth_of(scans: ScanPair, *, log_moving: float = 0.0) -> Expected:
    """The first annotated mover as it truly moves."""
    assert scans.annotation is not None
    cluster = scans.annotation.cluster[scans.source.beam]
    k = int(np.argmax([np.count_nonzero(cluster == k) for k in range(1, len(scans.annotation.motions))])) + 1
    return Expected(scans.annotation.motions[k][None], (cluster == k)[None], np.full(len(cluster), log_moving))


def surveyed(scans: ScanPair, expected: Expected | None) -> tuple[Pair, Survey]:
    pair = pair_of_scans(scans, torch.float32)
    return pair, survey_at(*find_start(pair, alone), pair.dt, expected)


def test_an_expected_mover_is_two_more_hypotheses_of_its_points(scans: ScanPair) -> None:
    expected = truth_of(scans)
    pair, with_it = surveyed(scans, expected)
    without = surveyed(scans, None)[1]
    H = len(without.hypotheses.motions)
    assert len(with_it.hypotheses.motions) == H + 2
    assert with_it.features.shape == (H + 2, without.features.shape[1])
    np.testing.assert_array_equal(with_it.hypotheses.motions[:H], without.hypotheses.motions)
    np.testing.assert_array_equal(with_it.hypotheses.motions[H], expected.motions[0])
    assert np.abs(with_it.hypotheses.motions[H + 1] - expected.motions[0]).max() < 0.5
    members = members_of(with_it.hypotheses, np.array([H, H + 1]), len(pair.source))
    np.testing.assert_array_equal(members, np.repeat(expected.members, 2, axis=0))


def test_too_few_points_are_no_hypothesis(scans: ScanPair) -> None:
    expected = truth_of(scans)
    few = np.zeros_like(expected.members)
    few[0, : MIN_POINTS - 1] = True
    H = len(surveyed(scans, None)[1].hypotheses.motions)
    assert len(surveyed(scans, expected._replace(members=few))[1].hypotheses.motions) == H


def test_nothing_expected_changes_nothing(model: JointScanCRF, scans: ScanPair) -> None:
    N = len(scans.source)
    nothing = Expected(np.empty((0, 3)), np.empty((0, N), np.bool_), np.zeros(N))
    plain, hinted = (model.match(scans.source, scans.target, scans.dt, expected=of) for of in (None, nothing))
    np.testing.assert_array_equal(plain.cluster, hinted.cluster)
    np.testing.assert_array_equal(plain.motions, hinted.motions)


def test_log_moving_decides_where_it_is_large(model: JointScanCRF, scans: ScanPair) -> None:
    expected = truth_of(scans, log_moving=-50.0)
    assert not (model.match(scans.source, scans.target, scans.dt, expected=expected).cluster > 0).any()
    found = model.match(scans.source, scans.target, scans.dt, expected=truth_of(scans)).cluster[scans.source.beam]
    assert (found[expected.members[0]] > 0).mean() > 0.5


def test_a_wrong_expectation_is_not_believed(model: JointScanCRF, scans: ScanPair) -> None:
    """Background that is expected to jump aside."""
    assert scans.annotation is not None
    cluster = scans.annotation.cluster[scans.source.beam]
    static = np.flatnonzero(cluster == 0)[10:30]
    members = np.zeros((1, len(cluster)), np.bool_)
    members[0, static] = True
    expected = Expected(np.array([[0.0, 3.0, 3.0]]), members, np.zeros(len(cluster)))
    found = model.match(scans.source, scans.target, scans.dt, expected=expected).cluster[scans.source.beam]
    assert (found[static] > 0).mean() < 0.1
