"""Which target points are candidates: near under the motions, near where they are, or alike in shape."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from scenes import make_batch
from support import all_real, assert_close, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features.potentials import PairView, find_candidates, shape_score
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.names import SHAPE_CHANNELS

N, M, C = 14, 11, 3
MOTIONS = torch.tensor([[0.1, 3.0, -1.0], [-0.2, -2.0, 4.0], [0.0, 50.0, 50.0]], dtype=torch.float64)[None]
ACTIVE = torch.tensor([[True, True, False]])
GUESS = torch.tensor([[0.3, 0.5, -0.8]], dtype=torch.float64)


def make_view(guess: Tensor = GUESS) -> PairView:
    """One pair whose last target point is padding."""
    batch = make_batch(make_points(N, 1)[None], make_points(M, 2)[None], ([N], [M - 1]))
    return PairView.of(replace(batch, initial_motion=guess))


def best(score: np.ndarray, count: int) -> list[list[int]]:
    """For every row the `count` targets with the highest score, ascending, without the padding."""
    return [sorted(np.argsort(-row[: M - 1])[:count].tolist()) for row in score]


def negative_distance(view: PairView, motions: Tensor) -> np.ndarray:
    """(N, M) minus the distance under the best of the motions (C, 3)."""
    moved = se2.apply(motions, view.batch.source.expand(len(motions), -1, -1)).numpy()
    return -np.linalg.norm(moved[:, :, None] - view.batch.target[0].numpy(), axis=-1).min(0)


@pytest.mark.parametrize("count", [1, 4])
def test_candidates_are_the_best_by_the_chosen_search(count: int) -> None:
    view = make_view()
    expected = {
        "motion": best(negative_distance(view, MOTIONS[0, :2]), count),
        "position": best(negative_distance(view, GUESS), count),
        "shape": best(shape_score(view)[0].numpy(), count),
    }
    assert len({str(index) for index in expected.values()}) == 3
    for search, index in expected.items():
        found = find_candidates(view, MOTIONS, ACTIVE, InferenceConfig(candidate_search=search, candidates=count))
        assert found.index[0].tolist() == index, search
        assert found.mask.all()


def test_position_and_shape_do_not_look_at_the_motions() -> None:
    view = make_view()
    for search in ("position", "shape"):
        config = InferenceConfig(candidate_search=search, candidates=3)
        one, other = find_candidates(view, MOTIONS, ACTIVE, config), find_candidates(view, MOTIONS.flip(1) + 1, ~ACTIVE, config)
        assert torch.equal(one.index, other.index)
        assert not torch.equal(one.nearest, other.nearest)


def test_shape_does_not_look_at_the_guess_either() -> None:
    config = InferenceConfig(candidate_search="shape", candidates=3)
    one, other = (find_candidates(make_view(guess), MOTIONS, ACTIVE, config) for guess in (GUESS, GUESS + 2))
    assert torch.equal(one.index, other.index)


@pytest.mark.parametrize("search", ["position", "shape"])
def test_the_nearest_are_those_of_the_motions_whatever_the_search(search: str) -> None:
    view = make_view()
    of_motion = find_candidates(view, MOTIONS, ACTIVE, InferenceConfig(candidates=1))
    found = find_candidates(view, MOTIONS, ACTIVE, InferenceConfig(candidate_search=search, candidates=5))
    assert torch.equal(found.nearest, of_motion.nearest)
    dense = find_candidates(view, MOTIONS, ACTIVE, InferenceConfig(candidate_search=search, candidates=0))
    assert dense.index.tolist() == [[list(range(M))] * N]
    assert torch.equal(dense.mask, view.batch.target_mask[:, None].expand(1, N, M))


@pytest.mark.parametrize("search", ["motion", "position", "shape"])
def test_short_targets_give_fewer_candidates(search: str) -> None:
    view = make_view()
    for real in (0, 2):
        mask = torch.arange(M)[None] < real
        short = PairView.of(replace(view.batch, target=view.batch.target * mask[..., None], target_mask=mask))
        found = find_candidates(short, MOTIONS, ACTIVE, InferenceConfig(candidate_search=search, candidates=4))
        assert found.mask.sum(-1).tolist() == [[real] * N]
        assert found.index[found.mask].unique().tolist() == list(range(real))


def test_the_shape_score_is_the_mean_of_the_shape_channels() -> None:
    view = make_view()
    source, target = view.batch.source[0].numpy(), view.batch.target[0, : M - 1].numpy()
    local = oracles.local_association(source, target, Scales().local.tolist(), [0.0, 0.0, 0.0], source)
    assert_close(shape_score(view)[0, :, : M - 1], np.asarray(local)[..., :SHAPE_CHANNELS].mean(-1), tolerance=1e-6)


def test_points_of_a_moved_scan_are_most_alike_themselves() -> None:
    source = make_points(30, 3)[None]
    target = se2.apply(torch.tensor([[1.0, 20.0, -7.0]]).double(), source) + 1e-4 * normal(1, 30, 2)
    mask = torch.ones(1, 30, dtype=torch.bool)
    batch = replace(make_view().batch, source=source, target=target, source_mask=mask, target_mask=mask)
    assert (shape_score(PairView.of(batch))[0, 5:25].argmax(-1) == torch.arange(5, 25)).all()


def test_a_view_changes_the_unit_of_length_there_and_back() -> None:
    points = make_points(12, 3)[None]
    mask, closed, one = all_real(points), torch.tensor([False]), torch.ones(1, dtype=torch.float64)
    batch = ScanPairBatch(points, points + 0.1, mask, mask, closed, closed, one, 0.01 * one, torch.zeros(1, 3).double())
    view = PairView.of(batch, length_unit="spacing")
    motions = torch.tensor([[[0.1, 2.0, -3.0], [0.0, 1.0, 0.0]]], dtype=torch.float64)
    found = view.in_unit(motions)
    assert_close(found[..., 0], motions[..., 0])
    assert_close(found[..., 1:], motions[..., 1:] * view.factor)
    assert_close(view.in_metres(found), motions)
    start = Start.at(batch, motions, torch.ones(1, 2, dtype=torch.bool))
    assert_close(view.in_unit(start).motions, found)
    assert_close(view.batch.source, batch.source * view.factor)
