"""Which movers there are: the evidence of a cluster against enumeration, and which clusters go."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from scenes import MOTIONS, make_batch, make_start, scene
from support import assert_close, generator, make_points, normal

from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.potentials import Boosters, PairView, clustering_unary
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.selection import discard_vacuous, evidence
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import ClusterPotential, Parameters
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_UNARY, CLUSTERING_WEIGHTS

CONFIG = InferenceConfig(clusters=4)
MODEL = JointScanCRF().double()


def judged(start: Start, log_odds: list[float]) -> Start:
    """The start with log-odds of the movers; all are considered, none is active."""
    odds = torch.tensor([torch.inf, *log_odds]).to(start.motions).expand(len(start.motions), -1)
    return replace(start, log_odds=odds, active=odds == torch.inf)


@pytest.mark.parametrize("seed", range(3))
def test_evidence_equals_enumeration(seed: int) -> None:
    N, C = 5, 3
    batch = make_batch(make_points(N, seed)[None], make_points(4, seed + 20)[None])
    association = torch.randint(-1, 4, (1, N), generator=generator(seed))
    start = judged(make_start(batch, MOTIONS, association), [0.0, 0.0]).considered()
    weights = normal(len(CLUSTERING_WEIGHTS), seed=seed)
    scales = Scales().double()
    parameters = Parameters(normal(len(ASSOCIATION_WEIGHTS), seed=1), weights, scales, Boosters(1).double())
    view = PairView.of(batch)
    state = joint.first_state(view, start, CONFIG)
    found = evidence(view, start, state, parameters, CONFIG)

    nearest = torch.cdist(torch.stack([oracle_move(MOTIONS[c], batch.source[0]) for c in range(C)]), batch.target[0]).argmin(-1)
    at = clustering.correspond(batch.source, batch.target, start.motions, nearest.T[None], association)
    pairwise = (clustering.pairwise_features(batch.source, at, scales) @ weights[CLUSTERING_UNARY:])[0].numpy()
    local = (clustering_unary(view, at, start.motions, start.active, scales) @ weights[:CLUSTERING_UNARY])[0].numpy()

    def log_total(active: list[bool]) -> float:
        unary = local.copy()
        unary[:, :C][:, ~np.array(active)] = -np.inf
        return oracles.log_partition(unary, pairwise)

    whole = log_total([True] * C)
    expected = [0.0, whole - log_total([True, False, True]), whole - log_total([True, True, False])]
    assert_close(found[0], expected)


def oracle_move(motion: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    return torch.tensor([oracles.move(motion.tolist(), point) for point in points.tolist()], dtype=torch.float64)


def test_a_cluster_that_explains_stays_and_one_that_does_not_goes() -> None:
    batch, _ = scene(40)
    elsewhere = torch.tensor([[0.0, 30.0, 30.0]], dtype=torch.float64)
    start = judged(make_start(batch, torch.cat([MOTIONS[:2], elsewhere, MOTIONS[2:]])), [0.0, 0.0, 0.0]).considered()
    view = PairView.of(batch)
    state = joint.first_state(view, start, CONFIG)
    kept = discard_vacuous(view, start, state, MODEL.fitted, CONFIG).motions.active
    assert kept[0].tolist() == [True, True, False, True]


def test_of_two_that_explain_the_same_one_stays() -> None:
    batch, _ = scene(40, movers=1)
    start = judged(make_start(batch, torch.cat([MOTIONS[:2], MOTIONS[1:2] + 1e-4])), [1.0, 0.5]).considered()
    view = PairView.of(batch)
    state = joint.first_state(view, start, CONFIG)
    kept = discard_vacuous(view, start, state, MODEL.fitted, CONFIG).motions.active
    assert kept[0].tolist() == [True, True, False]


def test_the_background_always_stays() -> None:
    batch, _ = scene(20, movers=0)
    start = judged(make_start(batch, MOTIONS + 50.0), [-4.0, -4.0]).considered()
    view = PairView.of(batch)
    state = joint.first_state(view, start, CONFIG)
    kept = discard_vacuous(view, start, state, MODEL.fitted, CONFIG).motions.active
    assert kept[0].tolist() == [True, False, False]


def test_the_order_of_movers_does_not_matter() -> None:
    batch, _ = scene(40)
    elsewhere = torch.tensor([[0.0, 30.0, 30.0]], dtype=torch.float64)
    motions, odds = torch.cat([MOTIONS, elsewhere]), [0.3, 0.1, -0.5]
    order = [0, 3, 1, 2]
    kept = []
    for motion, log_odds in ((motions, odds), (motions[order], [odds[k - 1] for k in order[1:]])):
        start = judged(make_start(batch, motion), log_odds).considered()
        view = PairView.of(batch)
        state = joint.first_state(view, start, CONFIG)
        kept.append(discard_vacuous(view, start, state, MODEL.fitted, CONFIG).motions.active[0])
    assert torch.equal(kept[1], kept[0][order])


def test_the_threshold_alone_never_looks_at_what_it_does_not_accept() -> None:
    batch, cluster = scene(40)
    start = judged(make_start(batch, MOTIONS), [2.0, 2.0])
    view = PairView.of(batch)
    config = replace(MODEL.config, inference=InferenceConfig(clusters=4, movers="threshold"))
    with torch.no_grad():
        alone = joint.decode(view, start, MODEL.fitted, config)
        together = joint.decode(view, start, MODEL.fitted, replace(config, inference=InferenceConfig(clusters=4)))
    assert alone.active[0].tolist() == [True, False, False]
    assert together.active.all()
    assert together.cluster[0].tolist() == cluster.tolist()


def test_worth_rises_with_what_is_explained_and_scored() -> None:
    potential = ClusterPotential()
    assert float(potential(torch.tensor(0.0), torch.tensor(0.0))) == pytest.approx(-2.0)
    assert float(potential(torch.tensor(9.0), torch.tensor(0.0))) > float(potential(torch.tensor(1.0), torch.tensor(0.0)))
    assert float(potential(torch.tensor(1.0), torch.tensor(3.0))) > float(potential(torch.tensor(1.0), torch.tensor(-3.0)))
    assert potential(torch.tensor(-7.0), torch.tensor(torch.inf)).isfinite()
