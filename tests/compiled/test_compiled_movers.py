import numpy as np
import pytest
import torch
from support import assert_close

pytest.importorskip("numba")

from surveyed import SCENES, survey

from torchcrf_scan.inference import movers as eager
from torchcrf_scan.search.accept import probabilities_of, score_of, select
from torchcrf_scan.search.score import FEATURES


def test_probabilities_are_those_of_the_eager_module() -> None:
    score = eager.HypothesisScore().double()
    features = 8 * torch.randn(20, len(FEATURES), dtype=torch.float64)  # some beyond `LARGEST`
    features[:10] = score.mean + score.scale * torch.randn(10, len(FEATURES), dtype=torch.float64)
    assert_close(torch.from_numpy(probabilities_of(score_of(score), features.numpy())), score(features))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("threshold", "most"), [(0.02, 50), (0.1, 5), (0.1, 0), (2.0, 5)])
def test_the_same_movers_in_the_same_order(name: str, threshold: float, most: int) -> None:
    seen, score = survey(name), eager.HypothesisScore().double()
    probabilities = probabilities_of(score_of(score), seen.features)
    found = select(seen.leftover, seen.found, probabilities, threshold, most)
    kept = torch.from_numpy(probabilities)
    expected = eager.select(seen.as_eager, kept, seen.source, seen.target, threshold=threshold, most=most)
    assert probabilities[found].tolist() == expected.probabilities.tolist()
    assert seen.found.motions[found].tolist() == expected.motions.tolist()
    assert seen.as_eager.members[found].tolist() == expected.members.tolist()


def test_all_that_do_not_compete_are_accepted() -> None:
    seen = survey("street")
    probabilities = np.random.default_rng(0).random(len(seen.found.motions))
    found = select(seen.leftover, seen.found, probabilities, 0.0, 100)
    kept = torch.from_numpy(probabilities)
    expected = eager.select(seen.as_eager, kept, seen.source, seen.target, threshold=0.0, most=100)
    assert len(found) > 3
    assert probabilities[found].tolist() == expected.probabilities.tolist()
