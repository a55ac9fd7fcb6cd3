"""The clustering chain's potentials and beliefs, against the eager functions."""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from support import all_real, generator, make_points, normal
from torch import Tensor

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.fast import clustering
from torchcrf_scan.fast.decode import limited
from torchcrf_scan.fast.free_space import Sweep, sweep_of
from torchcrf_scan.features import clustering as eager
from torchcrf_scan.features.candidates import by_motion
from torchcrf_scan.features.potentials import PairView, clustering_potentials, clustering_unary, possible_clusters
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.nearest import boxes_of

C = 4


@cache
def fitted() -> Parameters:
    return JointScanCRF.from_pretrained(backend="eager").double().requires_grad_(False).fitted


PARAMETERS = {
    "fitted": fitted,
    "all features": lambda: replace(fitted(), clustering=normal(21, seed=1)),
    "no beams": lambda: replace(fitted(), clustering=normal(21, seed=2).index_fill(0, torch.arange(6, 12), 0.0)),
}


class Case(NamedTuple):
    view: PairView  # of `reach` soft or hard
    motions: Tensor
    active: Tensor
    reach: Tensor
    association: Tensor
    nearest: Tensor


def case(n: int, m: int, seed: int, points: str = "spread") -> Case:
    source, target = make_points(n, seed, closed=seed % 2 == 1), make_points(m, seed + 1, closed=seed % 2 == 1)
    if points == "one spot":
        source, target = source[:1].repeat(n, 1), source[:1].repeat(m, 1)
    one = torch.ones(1, dtype=torch.float64)
    closed = torch.tensor([seed % 2 == 1])
    masks = all_real(source[None]), all_real(target[None])
    batch = ScanPairBatch(source[None], target[None], *masks, closed, closed, one / 10, one / 50, torch.zeros(1, 3).double())
    motions = 0.1 * normal(1, C, 3, seed=seed)
    active = torch.tensor([[True, False, True, seed % 3 > 0]])
    reach = (4 * torch.rand(1, n, C, generator=generator(seed), dtype=torch.float64) - 2.8).clamp(min=0)
    reach[..., 0] = 0
    association = torch.randint(-1, m, (1, n), generator=generator(seed))
    nearest = by_motion(batch.source, batch.target, batch.target_mask, motions, active, 1).nearest
    return Case(PairView.of(batch, reach=("hard", "soft")[seed // 2 % 2]), motions, active, reach, association, nearest)


def array(values: Tensor) -> Any:
    return np.ascontiguousarray(values[0].numpy())


def sweeps(view: PairView) -> tuple[Sweep, Sweep]:
    batch, noise, here = view.batch, float(view.batch.range_noise[0]), np.zeros(2)
    source = sweep_of(array(batch.source), noise, bool(batch.source_closed[0]), here)
    return source, sweep_of(array(batch.target), noise, bool(batch.target_closed[0]), here)


def tables(at: Case, model: clustering.ClusteringModel) -> clustering.Tables:
    source, target, association = array(at.view.batch.source), array(at.view.batch.target), array(at.association)
    motions, active, reach = array(at.motions), array(at.active), array(at.reach)
    reach = limited(reach) if at.view.reach == "hard" else reach
    nearest = clustering.nearest_to_outliers(boxes_of(target), source, motions, active, association)
    return clustering.tabulate(source, target, *sweeps(at.view), motions, active, reach, association, nearest, model)


def potentials(at: Case, parameters: Parameters) -> tuple[Tensor, Tensor]:
    batch, scales = at.view.batch, parameters.scales
    met = eager.correspond(batch.source, batch.target, at.motions, at.nearest, at.association)
    local = clustering_unary(at.view, met, at.motions, at.active, scales, at.reach)
    pairwise = eager.pairwise_features(batch.source, met, scales)
    possible = possible_clusters(at.active, at.view.within(at.reach), batch.source.shape[1])
    return clustering_potentials(local, pairwise, possible, parameters.clustering)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("seed", range(4))
def test_potentials_are_those_of_the_features(name: str, seed: int) -> None:
    parameters, at = PARAMETERS[name](), case(40, 37, seed)
    model = clustering.clustering_model(parameters)
    found, active = tables(at, model), array(at.active)
    states = np.flatnonzero(active)
    log_unary = clustering.node_potentials(found, states, model)
    log_pairwise = clustering.transition_potentials(found, states, log_unary, model)
    expected_unary, expected_pairwise = (array(values) for values in potentials(at, parameters))
    chosen = np.append(states, C)
    np.testing.assert_allclose(log_unary, expected_unary[:, chosen], atol=1e-9)
    matters = (log_unary[:-1, :, None] > -np.inf) & (log_unary[1:, None, :] > -np.inf)
    np.testing.assert_allclose(log_pairwise[matters], expected_pairwise[:, chosen][:, :, chosen][matters], atol=1e-9)
    assert np.isfinite(log_pairwise).all()


@pytest.mark.parametrize(("n", "m", "points"), [(40, 37, "spread"), (1, 1, "spread"), (2, 5, "spread"), (3, 2, "one spot")])
@pytest.mark.parametrize("seed", range(3))
def test_beliefs_and_labels_agree(n: int, m: int, points: str, seed: int) -> None:
    parameters, at = fitted(), case(n, m, seed, points)
    model = clustering.clustering_model(parameters)
    log_beliefs, labels = clustering.cluster(tables(at, model), array(at.active), model)
    expected = chain_beliefs(*potentials(at, parameters), at.view.batch.source_mask)[0]
    np.testing.assert_allclose(log_beliefs, expected, atol=1e-9)
    best = expected.argmax(-1)
    if points == "spread":  # on one spot all clusters are as good
        np.testing.assert_array_equal(labels, torch.where(best == C, -1, best))


def test_clusters_can_be_left_out_later() -> None:
    parameters, at = fitted(), case(40, 37, 1)
    model = clustering.clustering_model(parameters)
    fewer = at._replace(active=torch.tensor([[True, False, False, True]]))
    late, _ = clustering.cluster(tables(at, model), array(fewer.active), model)
    early, _ = clustering.cluster(tables(fewer, model), array(fewer.active), model)
    np.testing.assert_array_equal(late, early)


def test_weights_have_the_names_of_the_model() -> None:
    weights = clustering.clustering_model(fitted()).weights
    assert weights._fields == clustering.CLUSTERING_WEIGHTS
    np.testing.assert_array_equal(weights, fitted().clustering)
