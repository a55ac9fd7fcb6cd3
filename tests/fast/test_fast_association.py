from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import make_batch
from support import make_points, normal
from torch import Tensor

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.fast import association, static_features
from torchcrf_scan.fast.limit import Limit
from torchcrf_scan.features import potentials
from torchcrf_scan.features.association import pairwise_features
from torchcrf_scan.features.free_space import look
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops import shape
from torchcrf_scan.loops.candidates import by_motion
from torchcrf_scan.loops.nearest import boxes_of

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
MOTIONS = torch.tensor([[0.02, 0.5, 0.1], [3.0, 9.0, 9.0], [0.0, 1.5, 0.1], [0.1, 0.1, -0.4]], dtype=torch.float64)
ACTIVE = torch.tensor([True, False, True, True])
NO_LIMIT = Limit(0.0, 1.0)


@cache
def layer() -> JointScanCRF:
    return JointScanCRF.from_pretrained("simulated").double().requires_grad_(False)


def made_up(seed: int, **zero: bool) -> Parameters:
    """The fitted scales and boosters with random weights, of all features."""
    weights = normal(23, seed=seed)
    weights[[association.ASSOCIATION_WEIGHTS.index(name) for name in zero]] = 0
    return replace(layer().fitted, association=weights)


PARAMETERS = {
    "fitted": lambda: layer().fitted,
    "random": lambda: made_up(1),
    "no long edges": lambda: made_up(2, pairwise_distance=True, pairwise_translation=True),
    "no boosters": lambda: made_up(3, data_boosting=True, outlier_boosting=True, excess=True, gate=True),
    "a reward for jumps": lambda: replace(made_up(4, pairwise_distance=True, pairwise_translation=True), association=jumping()),
}


def jumping() -> Tensor:
    weights = made_up(5, pairwise_distance=True, pairwise_translation=True).association
    weights[association.SEQUENCE] = -1.5
    return weights


def array(values: Tensor) -> Any:
    return np.ascontiguousarray(values.numpy())


def eager(view: Any, parameters: Parameters, index: Any, mask: Any, moved: Tensor) -> tuple[Any, Any, Any]:
    """Log potentials and log-beliefs, and which target points they choose."""
    given = torch.from_numpy(index)[None], torch.from_numpy(mask)[None]
    states = potentials.AssociationStates.of(view, *given, parameters.scales, parameters.boosters)
    unary = potentials.association_unary(view, states, moved, parameters.scales, parameters.boosters)
    pairwise = pairwise_features(view.batch.source, view.batch.target, given[0], parameters.scales)
    both = potentials.association_potentials(unary, pairwise, given[1], parameters.association)
    return both[0][0].numpy(), both[1][0].numpy(), chain_beliefs(*both, view.batch.source_mask)[0].numpy()


def assert_same_round(batch: ScanPairBatch, parameters: Parameters, count: int = 8, *, seed: int = 1) -> None:
    """Potentials, beliefs and labels of two rounds with different motions in one workspace, against the eager ones."""
    view = layer().view(batch)
    source, target = array(view.batch.source[0]), array(view.batch.target[0])
    N, C = len(source), len(MOTIONS)
    model = static_features.association_model(parameters)
    shapes = shape.describe(source, bool(batch.source_closed[0])), shape.describe(target, bool(batch.target_closed[0]))
    pair = static_features.association_pair(source, target, *shapes, array(view.batch.initial_motion[0]))
    log_cluster = normal(1, N, C + 1, seed=seed)
    work = None
    for motions in (MOTIONS, MOTIONS + 0.01):
        index, mask, _ = by_motion(boxes_of(target), source, motions.numpy(), ACTIVE.numpy(), count)
        given = array(motions), array(ACTIVE), array(log_cluster[0])
        moved = potentials.registered_points(view.batch.source, motions[None], ACTIVE[None], log_cluster)
        found = association.registered_points(source, *given)
        np.testing.assert_allclose(found, moved[0].numpy(), rtol=1e-12, atol=1e-12)
        sight = look(view.target_sweep, moved)
        seen = array(sight.seen_through[0]), array(sight.hidden[0])
        log_unary, log_pairwise, expected = eager(view, parameters, index, mask, moved)
        work = work or static_features.workspace(*index.shape)
        log_association, labels = association.associate(model, pair, work, index, mask, NO_LIMIT, found, *seen, np.zeros(N))
        ours = association.log_unary_of(model, pair, work, NO_LIMIT, found, *seen)
        np.testing.assert_allclose(ours, log_unary, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(association.log_pairwise_of(model, pair, index), log_pairwise, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(log_association, expected, rtol=1e-9, atol=1e-8)
        padded = np.concatenate([index, np.full((N, 1), -1)], axis=1)
        best = expected.argmax(1)
        if N > 0:
            runner_up = np.sort(expected, axis=1)[:, -2:]
            is_sure = runner_up[:, 1] - runner_up[:, 0] > 1e-9 if runner_up.shape[1] > 1 else np.ones(N, np.bool_)
            np.testing.assert_array_equal(labels[is_sure], padded[np.arange(N), best][is_sure])


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_simulated_scans(world: str, name: str) -> None:
    batch = ScanPairBatch.collate(simulate_pairs(WORLDS[world], 1, 1, seed=3), torch.float64).without_truth()
    assert_same_round(batch, PARAMETERS[name]())


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the recorded pairs are not here")
@pytest.mark.parametrize("name", PARAMETERS)
def test_recorded_scans(name: str) -> None:
    for path in sorted(PAIRS.glob("*.npz"))[::24]:
        assert_same_round(ScanPairBatch.collate([read_pair(path)], torch.float64).without_truth(), PARAMETERS[name]())


def small_batch(source: Tensor, target: Tensor, closed: bool = False) -> ScanPairBatch:
    is_closed, guess = torch.tensor([closed]), torch.tensor([[0.1, 0.5, -0.2]], dtype=torch.float64)
    batch = make_batch(source[None], target[None])
    return replace(batch, source_closed=is_closed, target_closed=is_closed, initial_motion=guess)


SPOT = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
SMALL = {
    "one and one": small_batch(make_points(1, 1), make_points(1, 2)),
    "one and many": small_batch(make_points(1, 1), make_points(20, 2)),
    "many and one": small_batch(make_points(20, 1), make_points(1, 2)),
    "three and two": small_batch(make_points(3, 1), make_points(2, 2)),
    "closed": small_batch(make_points(12, 1, closed=True), make_points(13, 2, closed=True), closed=True),
    "one spot": small_batch(SPOT.repeat(12, 1), SPOT.repeat(11, 1)),
    "duplicates": small_batch(make_points(8, 3).repeat_interleave(2, 0), make_points(9, 4).repeat_interleave(2, 0)),
    "far": small_batch(make_points(12, 5), make_points(12, 6) + 100),
}


@pytest.mark.parametrize("name", ["random", "no long edges", "a reward for jumps"])
@pytest.mark.parametrize("case", SMALL)
@pytest.mark.parametrize("count", [0, 4])
def test_small_scans(case: str, count: int, name: str) -> None:
    assert_same_round(SMALL[case], PARAMETERS[name](), count)


def test_candidates_that_are_not_real() -> None:
    view = layer().view(SMALL["closed"])
    source, target = array(view.batch.source[0]), array(view.batch.target[0])
    parameters = PARAMETERS["no long edges"]()
    shapes = shape.describe(source, True), shape.describe(target, True)
    pair = static_features.association_pair(source, target, *shapes, array(view.batch.initial_motion[0]))
    index, mask = np.tile(np.arange(4), (12, 1)), np.ones((12, 4), np.bool_)
    mask[3:5, 2:], mask[7] = False, False
    none = np.zeros(12)
    given = index, mask, view.batch.source
    work = static_features.workspace(12, 4)
    model = static_features.association_model(parameters)
    sight = look(view.target_sweep, view.batch.source)
    found, labels = association.associate(
        model, pair, work, index, mask, NO_LIMIT, source, array(sight.seen_through[0]), array(sight.hidden[0]), none
    )
    np.testing.assert_allclose(found, eager(view, parameters, *given)[2], rtol=1e-9, atol=1e-9)
    assert labels[7] == -1
    assert np.isfinite(
        association.associate(model, pair, work, index, mask, NO_LIMIT, source, none, none, none)[0][mask.all(1)]
    ).all()


def test_without_candidates_everything_is_an_outlier() -> None:
    source, target = array(make_points(3, 1)), np.empty((0, 2))
    pair = static_features.association_pair(
        source, target, shape.describe(source, False), shape.describe(target, False), np.zeros(3)
    )
    index, mask = np.empty((3, 0), np.int64), np.empty((3, 0), np.bool_)
    model, work = static_features.association_model(layer().fitted), static_features.workspace(3, 0)
    log_association, labels = association.associate(
        model, pair, work, index, mask, NO_LIMIT, source, np.zeros(3), np.ones(3), np.zeros(3)
    )
    assert log_association.tolist() == [[0.0]] * 3
    assert labels.tolist() == [-1] * 3
