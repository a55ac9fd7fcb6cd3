"""What tells a mover's motion from a wrong one: what features say of plain scenes, and that they are those of the oracle."""

import math

import numpy as np
import oracles_movers as oracles
import pytest
from surveyed import SCENES, Surveyed, grids, seen, survey

from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.search.feature_points import AT
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.hypotheses import Hypotheses
from torchcrf_scan.search.hypothesis_features import hypothesis_features, share_in_common
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.score import FEATURES
from torchcrf_scan.search.surface import Surface

STEP = math.radians(0.5)
BEARING = np.arange(-120, 121) * STEP
CANCELLING = ("linearity",)  # of points on a line: the root of a difference of squares
MOST = 12  # hypotheses of a recorded pair


def scan(post: float, bearing: Array = BEARING) -> Surface:
    """A round wall 8 m away and a post's front, 0.4 m wide, 4 m away at the bearing `post`."""
    ranges = np.where(np.abs(bearing - post) < 0.05, 4.0, 8.0)
    return seen(np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing)], axis=-1))


def hypotheses_of(motions: Array, sets: list[list[int]]) -> Hypotheses:
    """A motion (3,) for every set of points; equal sets must follow each other."""
    kinds = list(dict.fromkeys(map(tuple, sets)))
    group = np.array([kinds.index(tuple(of)) for of in sets], np.int64)
    start = np.cumsum([0, *map(len, kinds)])
    return Hypotheses(np.asarray(motions, np.float64), group, Groups(start, np.concatenate(kinds).astype(np.int64)))


def features(source: Surface, target: Surface, turn: float, members: Booleans) -> dict[str, float]:
    leftover = leftover_of(*grids(source, target), np.zeros(3))
    motion = np.array([[turn, 0.0, 0.0]])
    row = hypothesis_features(leftover, hypotheses_of(motion, [np.flatnonzero(members).tolist()]))[0]
    return dict(zip(FEATURES, row.tolist(), strict=True))


def test_a_post_that_moved_stands_out_and_has_no_excuse() -> None:
    source = scan(-0.2)
    found = features(source, scan(0.1), 0.3, source.ranges < 5)
    for name in ("stands_out", "landing_stands_out", "unexcused", "landing_unexcused", "unexcused_both", "share_of_piece"):
        assert found[name] > 0.8, name
    assert found["landing_occluded_before"] == 0
    assert found["fair_gain"] > math.log1p(10)


def test_the_wall_beside_a_post_does_not_stand_out() -> None:
    source = scan(0.0)
    beside = (source.bearings > source.bearings.mean() + 0.05) & (source.bearings < source.bearings.mean() + 0.2)
    found = features(source, source, 0.3, beside)
    assert found["stands_out"] < -0.4
    assert found["share_of_piece"] < 0.5
    assert found["fair_gain"] == 0


def test_what_the_other_scan_does_not_look_at_needs_no_mover() -> None:
    """The post leaves the view: its points are open, and that is all there is to say."""
    source = scan(-0.9)
    target = scan(9.0, BEARING[BEARING > -0.7])
    found = features(source, target, 0.6, source.ranges < 5)
    assert found["open_before"] == 1
    assert found["unexcused"] == found["unexcused_both"] == 0


def test_what_was_hidden_before_is_no_proof_of_a_mover() -> None:
    """The wall that the post hid in the source is new in the target."""
    source, target = scan(0.0), scan(9.0)
    members = np.abs(source.bearings - source.bearings.mean() + 0.2) < 0.04
    found = features(source, target, 0.2, members)
    assert found["landing_occluded_before"] > 0.9
    assert found["landing_unexcused"] == 0


# --- against loops that know nothing of the package ---------------------------------------------------------------------------


def test_columns_are_those_of_the_score() -> None:
    assert AT._fields == FEATURES
    assert list(AT) == list(range(len(FEATURES)))


def assert_same_features(found: Array, expected: list[dict[str, float]]) -> None:
    assert found.shape == (len(expected), len(FEATURES))
    for name in FEATURES:
        tolerance = 1e-6 if name in CANCELLING else 1e-9
        values = [row[name] for row in expected]
        np.testing.assert_allclose(found[:, getattr(AT, name)], values, rtol=tolerance, atol=tolerance, err_msg=name)


def oracle_features(at: Surveyed, motions: Array, sets: list[list[int]]) -> list[dict[str, float]]:
    return oracles.hypothesis_features(at.scene, motions.tolist(), sets)


@pytest.mark.parametrize("name", SCENES)
def test_features_are_those_of_the_oracle(name: str) -> None:
    at = survey(name)
    some = slice(None, None, -(-len(at.found.motions) // MOST) if name.endswith(".npz") else 1)
    motions, sets = at.found.motions[some], at.members[some]
    found = hypothesis_features(at.leftover, hypotheses_of(motions, sets)) if len(motions) else at.features
    assert_same_features(found, oracle_features(at, motions, sets))


@pytest.mark.parametrize("name", ["street", "closed", "collinear", "duplicates", "one spot", "three"])
def test_features_of_any_sets_and_motions(name: str) -> None:
    """Far from the target, with holes, round the seam, of one point and of all."""
    at = survey(name)
    random = np.random.default_rng(1)
    P = len(at.source.points)
    sets = [[*range(P)], [0, 1, P - 1], [2], sorted(random.choice(P, P // 2 + 1, replace=False).tolist())]
    nearly_still = [0.003, 0.0, 0.0]  # a point on a beam is on the side that rounding takes it to
    motions = np.concatenate([random.normal(0, [0.5, 2, 2], (8, 3)), [[3.1, 400.0, -400.0], nearly_still]])
    every = [sets[s] for s in (0, 0, 1, 1, 1, 2, 2, 3, 3, 3)]
    assert_same_features(hypothesis_features(at.leftover, hypotheses_of(motions, every)), oracle_features(at, motions, every))


def test_share_in_common() -> None:
    sets = [np.array(points) for points in ([0, 2, 4, 6], [4, 5, 6], [7, 9], [0, 9])]
    found = [[share_in_common(one, other) for other in sets] for one in sets]
    expected = [[oracles.share_in_common(one.tolist(), other.tolist()) for other in sets] for one in sets]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert share_in_common(sets[0][:0], sets[1]) == 0
