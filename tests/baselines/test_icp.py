"""The paper's ICP: known motions, one-to-one associations, and the gate that calls 34.6 % outliers."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from checks import check, same
from rooms import AWKWARD, ONE, room_pair

from torchcrf_scan.baselines.icp import FOUND, GATES, choose_gate, found_shares, loose_gate, match_background, match_icp
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Annotation, ScanPair

MOTION = np.array([0.03, 0.1, -0.08])


@pytest.fixture(scope="module")
def streets() -> list[ScanPair]:
    return simulate_pairs(WORLDS["street"], 3, 1, 0)


def test_a_small_motion_is_recovered() -> None:
    found = match_icp(room_pair(MOTION))
    turn, shift = se2.distance(found.motions[0], MOTION)
    assert turn < 0.005
    assert shift < 0.03
    assert found.motions.shape == (1, 3)


def test_a_scan_and_itself_stay_where_they_are_in_one_round() -> None:
    pair = room_pair(np.zeros(3))
    found = match_icp(pair)
    assert found.converged
    assert found.association.tolist() == list(range(pair.source.n_beams))
    assert np.allclose(found.motions, 0.0, atol=1e-9)


def test_a_guess_reaches_what_the_identity_does_not() -> None:
    motion = np.array([0.6, 1.5, 1.0])
    pair = room_pair(motion)
    assert se2.distance(match_icp(pair).motions[0], motion)[1] > 0.3
    assert se2.distance(match_icp(pair, initial_motion=motion).motions[0], motion)[1] < 0.05


def test_associations_are_one_to_one_within_the_gate_and_reciprocal(streets: list[ScanPair]) -> None:
    for pair, gate in itertools.product(streets, (None, 0.1, math.inf)):
        found = match_icp(pair, gate=gate)
        check(pair, found)
        kept = np.flatnonzero(found.association >= 0)
        assert len(np.unique(found.association[kept])) == len(kept)
        moved = se2.apply(found.motions[0], pair.source.points)
        apart = np.linalg.norm(moved[:, None] - pair.target.points, axis=-1)  # simulated files hold valid returns only
        assert (apart[kept].argmin(1) == found.association[kept]).all()
        assert (apart[:, found.association[kept]].argmin(0) == kept).all()
        if gate is not None:
            assert apart[kept, found.association[kept]].max(initial=0.0) <= gate


def test_the_untuned_gate_is_half_a_metre_or_wider_where_distances_spread() -> None:
    assert loose_gate(np.array([0.1, 0.1, 0.2])) == 0.5
    assert loose_gate(np.array([0.0, 1.0, 2.0])) == 2.5
    assert loose_gate(np.zeros(0)) == 0.5


def test_the_tuned_gate_finds_the_printed_share_of_outliers() -> None:
    pairs = [room_pair(motion, noise=0.03) for motion in (MOTION, -MOTION)]
    shares = np.array([found_shares(pair) for pair in pairs])
    assert shares.shape == (2, len(GATES))
    assert shares[:, 0].mean() > FOUND > shares[:, -1].mean()  # it can be reached
    gate = choose_gate(shares)
    found = np.mean([np.mean(match_icp(pair, gate=gate).association < 0) for pair in pairs])
    assert found == pytest.approx(shares.mean(0)[GATES.index(gate)])
    assert abs(found - FOUND) < 0.06


def test_shares_leave_out_what_nobody_annotated() -> None:
    pair = room_pair(MOTION)
    n = pair.source.n_beams
    nothing = np.full(n, -1)
    ignore = match_icp(pair, gate=0.05).association >= 0
    annotation = Annotation(nothing, nothing, np.zeros((1, 3)), nothing, ignore)
    assert 0.0 < found_shares(pair, [0.05])[0] < 1.0
    assert found_shares(replace(pair, annotation=annotation), [0.05]).tolist() == [1.0]
    assert np.isnan(found_shares(ScanPair(AWKWARD["empty"], ONE), [0.05])).all()


def test_choosing_a_gate() -> None:
    assert choose_gate([[0.9, 0.3, 0.1], [0.7, 0.4, 0.1], [math.nan] * 3], [1.0, 2.0, 3.0]) == 2.0
    assert GATES[-1] == math.inf
    assert list(GATES) == sorted(set(GATES))
    with pytest.raises(ValueError, match="shape"):
        choose_gate(np.zeros((2, 2)), [1.0])
    with pytest.raises(ValueError, match="at least one pair"):
        choose_gate([[math.nan]], [1.0])


def test_all_background_knows_no_outliers(streets: list[ScanPair]) -> None:
    found = match_background(streets[0])
    check(streets[0], found)
    assert (found.cluster == 0).all()


@pytest.mark.parametrize("names", list(itertools.product(AWKWARD, AWKWARD)))
def test_awkward_scans_get_a_defined_answer(names: tuple[str, str]) -> None:
    pair = ScanPair(*(AWKWARD[name] for name in names))
    for found in (match_icp(pair), match_icp(pair, gate=0.1), match_background(pair)):
        check(pair, found)
    if "empty" in names:
        assert (match_background(pair).association == -1).all()


def test_the_same_answer_every_time(streets: list[ScanPair]) -> None:
    assert same(match_icp(streets[0]), match_icp(streets[0]))
