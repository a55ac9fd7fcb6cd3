import numpy as np
import pytest
import torch

pytest.importorskip("numba")

from surveyed import SCENES, survey
from torchcrf_scan.inference.hypotheses import Hypotheses as EagerHypotheses

from torchcrf_scan.inference import hypothesis_features as eager
from torchcrf_scan.search.feature_points import AT
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.hypotheses import Hypotheses
from torchcrf_scan.search.hypothesis_features import hypothesis_features, share_in_common

SINGLE = ("distinct", "target_cover", "share_of_piece", "landing_piece_cover")  # ratios of counts, which torch takes in float32
CANCELLING = ("linearity",)  # of points on a line: the root of a difference of squares


def assert_same_features(found: np.ndarray, expected: torch.Tensor) -> None:
    assert found.shape == expected.shape
    for f, name in enumerate(eager.FEATURES):
        tolerance = 1e-6 if name in SINGLE + CANCELLING else 1e-9
        np.testing.assert_allclose(found[:, f], expected[:, f].numpy(), rtol=tolerance, atol=tolerance, err_msg=name)


def test_columns_are_those_of_the_eager_module() -> None:
    assert AT._fields == eager.FEATURES
    assert list(AT) == list(range(len(eager.FEATURES)))


@pytest.mark.parametrize("name", SCENES)
def test_features_are_those_of_the_eager_module(name: str) -> None:
    seen = survey(name)
    assert_same_features(seen.features, eager.hypothesis_features(seen.as_eager, seen.source, seen.target, seen.background))


@pytest.mark.parametrize("name", ["street", "closed", "collinear"])
def test_features_of_any_sets_and_motions(name: str) -> None:
    """Far from the target, with holes, round the seam, of one point and of all."""
    seen = survey(name)
    random = np.random.default_rng(1)
    P = len(seen.source)
    sets = [np.arange(P), np.array([0, 1, P - 1]), np.array([3]), np.sort(random.choice(P, P // 2, replace=False))]
    motions = np.concatenate([random.normal(0, [0.5, 2, 2], (8, 3)), [[3.1, 400.0, -400.0], [0.0, 0.0, 0.0]]])
    group = np.array([0, 0, 1, 1, 1, 2, 2, 3, 3, 3])
    start = np.cumsum([0, *map(len, sets)])
    found = hypothesis_features(seen.leftover, Hypotheses(motions, group, Groups(start, np.concatenate(sets))))
    members = torch.zeros(len(group), P, dtype=torch.bool)
    for h, s in enumerate(group):
        members[h, sets[s]] = True
    pool = EagerHypotheses(torch.from_numpy(motions), members)
    assert_same_features(found, eager.hypothesis_features(pool, seen.source, seen.target, seen.background))


def test_share_in_common() -> None:
    sets = [np.array(points) for points in ([0, 2, 4, 6], [4, 5, 6], [7, 9], [0, 9])]
    members = torch.tensor([[i in points for i in range(10)] for points in sets])
    found = [[share_in_common(one, other) for other in sets] for one in sets]
    np.testing.assert_allclose(found, eager.share_in_common(members).numpy(), rtol=1e-6)
    assert share_in_common(sets[0][:0], sets[1]) == 0
