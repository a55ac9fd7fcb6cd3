import numpy as np
import pytest
import torch
from support import assert_close

pytest.importorskip("numba")

from surveyed import SCENES, survey

from torchcrf_scan.features.potentials import resolution
from torchcrf_scan.inference import initialise as eager
from torchcrf_scan.loops.pair import Start
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.choose import choose_movers
from torchcrf_scan.search.score import HypothesisScore


def choose(name: str, clusters: int) -> tuple[Start, eager.Start]:
    seen, score = survey(name), HypothesisScore().double()
    guess, unit = seen.batch.initial_motion[0].numpy(), float(resolution(seen.batch)[0])
    found = choose_movers(seen.leftover, guess, seen.found, seen.features, score_of(score), clusters, unit)
    features = torch.from_numpy(seen.features)
    is_enough = min(len(seen.source), len(seen.target)) >= eager.FEWEST_POINTS
    known = eager.Survey(seen.source, seen.target, seen.background, seen.as_eager, features) if is_enough else None
    return found, eager.choose(seen.batch, [known], score, clusters)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("clusters", [1, 6])
def test_start_is_that_of_the_eager_module(name: str, clusters: int) -> None:
    found, expected = choose(name, clusters)
    for field in Start._fields:
        assert_close(torch.from_numpy(getattr(found, field)), getattr(expected, field)[0])
        assert not np.isnan(getattr(found, field)).any()


def test_scenes_hold_movers() -> None:
    assert sum(int(choose(name, 6)[0].active.sum()) for name in ("street", "room", "closed")) > 5
