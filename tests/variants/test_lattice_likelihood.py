"""Likelihoods of the lattice: against plain loops and enumeration, over stacked batches, and as what a fit makes larger."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from scenes import MOTIONS, make_batch, random_stumps
from support import assert_close, extended, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import AssociationStates, Boosters, PairView, find_candidates, possible_clusters
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.learning.fit import Lesson, fit_one_chain
from torchcrf_scan.learning.plugins import training_plugins
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.learning.weights_fit import fit_chain, flatten, stack
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS
from torchcrf_scan.variants.lattice_features import LatticeFeatures, lattice_features
from torchcrf_scan.variants.lattice_likelihood import LatticeChain, lattice_chain, pseudo_log_likelihood

N, M, C = 4, 2, 2
DENSE = InferenceConfig(clusters=C + 1, candidates=0)
ASSOCIATION, CLUSTER = torch.tensor([[0, -1, 1, 1]]), torch.tensor([[0, -1, 1, 0]])
STATES = [0, 8, 4, 3]  # j D + k


def toy(seed: int = 0, known: Tensor | None = None) -> ScanPairBatch:
    """One annotated pair of four and two points: background, an outlier, a mover."""
    batch = make_batch(make_points(N, seed)[None], make_points(M, seed + 20)[None])
    known = torch.ones(1, N, dtype=torch.bool) if known is None else known
    return replace(batch, truth=Truth(ASSOCIATION.clone(), CLUSTER.clone(), MOTIONS[None, :C].clone(), known))


def toy_chain(seed: int = 0, known: Tensor | None = None) -> LatticeChain:
    batch, scales = toy(seed, known), Scales().double()
    scales.local.mul_(10)
    return lattice_chain(PairView.of(batch), true_plugins(batch, C), scales, Boosters(1).double(), DENSE)


def simulated(beams: tuple[int, ...] = (41, 61)) -> ScanPairBatch:
    pairs = [simulate_pairs(SimulatorConfig(beams=b), 1, 1, b)[0] for b in beams]
    return ScanPairBatch.collate(pairs, torch.float64)


def chain_of(batch: ScanPairBatch, clusters: int = 4, candidates: int = 3) -> LatticeChain:
    config = InferenceConfig(clusters=clusters + 1, candidates=candidates)
    return lattice_chain(PairView.of(batch), true_plugins(batch, clusters), Scales().double(), Boosters(1).double(), config)


@pytest.mark.parametrize("seed", range(3))
def test_both_equal_the_loops(seed: int) -> None:
    batch, scales, boosters = toy(seed), Scales().double(), Boosters(7).double()
    scales.local.mul_(10)
    scales.cluster_distance.fill_(1.0)
    scales.neighbour_distance.fill_(1.0)
    stumps = random_stumps(boosters.data, seed), random_stumps(boosters.outlier, seed + 7)
    plugins, view = true_plugins(batch, C), PairView.of(batch)
    chain = lattice_chain(view, plugins, scales, boosters, DENSE)
    weights = normal(30, seed=seed)

    plain: dict[str, Any] = {name: value.tolist() for name, value in scales.named_buffers()}
    arrays = batch.source[0].numpy(), batch.target[0].numpy(), MOTIONS[:C].numpy()
    local = oracles.lattice_local(*arrays, np.ones((N, C), dtype=bool), plain, [0.0, 0.0, 0.0], *stumps)
    pairwise = oracles.lattice_pairwise(*arrays, plain)
    design = chain.design()
    assert design.label[0].tolist() == STATES
    expected = oracles.conditionals(local, pairwise, STATES, weights.numpy())
    assert_close(design.log_likelihood(extended(weights))[0], expected, tolerance=1e-6)  # tables of stumps are summed in float32
    parameters = Parameters(extended(weights[:18]), extended(weights[18:]), scales, boosters)
    assert_close(pseudo_log_likelihood(view, plugins, parameters, ModelConfig(inference=DENSE)), [sum(expected)], tolerance=1e-6)
    scores = local @ weights.numpy(), pairwise @ weights.numpy()
    exact = oracles.score(*scores, STATES) - oracles.log_partition(*scores)
    assert_close(chain.log_likelihood(extended(weights)), [exact], tolerance=1e-6)


def test_gradients_equal_differences() -> None:
    chain = toy_chain()
    weights = (0.3 * normal(44)).requires_grad_()
    assert torch.autograd.gradcheck(chain.log_likelihood, weights)
    assert torch.autograd.gradcheck(chain.design().log_likelihood, weights)


def test_no_labelling_is_more_than_certain() -> None:
    chain = chain_of(simulated())
    for seed in range(3):
        weights = normal(44, seed=seed)
        assert (chain.log_likelihood(weights) < 0).all()
        assert (chain.design().log_likelihood(weights) <= 0).all()


@pytest.mark.parametrize("node", [0, 2, N - 1])
def test_an_unknown_node_cuts_the_chain(node: int) -> None:
    known = torch.ones(1, N, dtype=torch.bool)
    known[0, node] = False
    chain, weights = toy_chain(known=known), normal(44)
    pieces = [(0, node), (node + 1, N)]
    expected = 0.0
    for begin, end in pieces:
        if end > begin:
            whole = toy_chain()
            cut = {n: end - (axes[0] == "e") for n, axes in LatticeChain.axes.items()}
            alone = replace(whole, **{n: getattr(whole, n)[:, begin:stop] for n, stop in cut.items()})
            expected += float(alone.log_likelihood(weights))
    assert_close(chain.log_likelihood(weights), [expected])
    assert float(chain.design().log_likelihood(weights)[0, node]) == 0


def test_a_node_counts_when_both_labels_are_known() -> None:
    batch = toy()
    assert batch.truth is not None
    motions = batch.truth.motions.clone()
    motions[0, 1] = torch.nan  # the mover's motion is not annotated
    chain = chain_of(replace(batch, truth=replace(batch.truth, motions=motions)), C, 0)
    assert chain.known.tolist() == [[True, True, False, True]]


def test_a_batch_is_its_pairs() -> None:
    together, weights = chain_of(simulated((41, 61, 33))), 0.3 * normal(44)
    assert together.mask.shape[2:] == (4, 5)
    for b, beams in enumerate((41, 61, 33)):
        alone = chain_of(simulated((beams,)))
        assert_close(together.design().log_likelihood(weights)[b].sum(), alone.design().log_likelihood(weights).sum())
        assert_close(together.log_likelihood(weights)[b], alone.log_likelihood(weights)[0])


def test_stacked_batches_are_the_sum_of_their_parts() -> None:
    parts, weights = [chain_of(simulated((41,)), 3, 2), chain_of(simulated((61, 33)), 4, 4)], 0.3 * normal(44)
    together = stack(parts)
    assert together.mask.shape[2:] == (5, 5)
    assert_close(together.log_likelihood(weights), torch.cat([part.log_likelihood(weights) for part in parts]))
    flat = flatten([part.design() for part in parts])
    assert_close(flat.log_likelihood(weights).sum(), sum(float(part.design().log_likelihood(weights).sum()) for part in parts))


def test_a_true_motion_that_is_out_of_reach_of_nobody_leaves_the_truth_possible() -> None:
    batch = simulated()
    model = JointScanCRF(ModelConfig(coupling="lattice")).double()
    start = model.initialise(batch)
    plugins = training_plugins(batch, start, LearningConfig(), torch.Generator().manual_seed(0))
    chain = lattice_chain(PairView.of(batch), plugins, Scales().double(), Boosters(1).double(), InferenceConfig())
    truth = chain.mask.flatten(2).gather(-1, chain.design().label[..., None])[..., 0]
    assert truth[chain.known].all()


@pytest.mark.parametrize("objective", ["pseudo_likelihood", "likelihood"])
def test_the_fit_is_an_optimum_of_its_objective(objective: str) -> None:
    chain = chain_of(simulated(), 3, 3)
    live = torch.ones(44, dtype=torch.float64)
    live[:12] = 0
    weights = fit_chain([chain], live, LearningConfig(objective=objective, prior=1.0, tolerance=1e-8))
    assert (weights[:12] == 0).all()
    flat = flatten([chain.design()])
    spread = flat.features[flat.mask].std(dim=0)
    scale = torch.where(spread > 1e-9, spread, torch.ones_like(spread))

    def value(w: Tensor) -> Tensor:
        of_nodes = chain.design().log_likelihood(w).sum()
        own = of_nodes if objective == "pseudo_likelihood" else chain.log_likelihood(w).sum()
        return own - ((w * scale) ** 2).sum() / 2

    at = weights.clone().requires_grad_()
    (slope,) = torch.autograd.grad(value(at), at)
    assert (slope / scale)[live > 0].abs().max() < 1e-2


def lessons(model: JointScanCRF, seed: int) -> list[Lesson]:
    batch = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=91), 3, 3, seed))
    view, start = model.view(batch), model.initialise(batch)
    start = start.scaled(view.factor)
    generator = torch.Generator().manual_seed(0)
    return [Lesson(view, start, training_plugins(view.batch, start, LearningConfig(), generator), 0, torch.ones(3))]


@pytest.mark.parametrize("raw_channels", [True, False])
@pytest.mark.parametrize("objective", ["pseudo_likelihood", "likelihood"])
def test_a_fit_improves_both(objective: str, raw_channels: bool) -> None:
    features, inference = FeatureConfig(raw_channels=raw_channels, stumps=10), InferenceConfig(clusters=5, candidates=4)
    model = JointScanCRF(ModelConfig(coupling="lattice", features=features, inference=inference))
    taught = lessons(model, 4)
    plug, view = taught[0].plugins, taught[0].view
    chain = stack([lattice_chain(view, plug, model.scales, model.boosters, inference)])

    def values() -> tuple[float, float]:
        weights = torch.cat(model.weight_vectors).detach().double()
        return float(chain.design().log_likelihood(weights).sum()), float(chain.log_likelihood(weights).sum())

    before = values()
    seen: list[float] = []
    config = LearningConfig(objective=objective, max_steps=30)
    fit_one_chain(model, lattice_chain, taught, {0: model.boosters}, config, lambda step, loss, *_: seen.append(loss))
    after = values()
    assert after[0] > before[0]
    assert after[1] > before[1]
    assert len(seen) > 5
    if not raw_channels:
        assert all(model.association_weights[name].item() == 0 for name in LOCAL_CHANNELS)


def test_the_outlier_booster_sees_the_candidates_that_inference_finds() -> None:
    batch, config = simulated(), InferenceConfig(clusters=5, candidates=2)
    scales, boosters, view, plugins = Scales().double(), Boosters(9).double(), PairView.of(batch), true_plugins(batch, 4)
    random_stumps(boosters.data, 3)
    random_stumps(boosters.outlier, 4)
    assert batch.truth is not None
    far = replace(batch.truth, association=torch.where(batch.truth.association >= 0, (batch.truth.association + 9) % 30, -1))
    found = find_candidates(view, plugins.motions, plugins.active, config)
    assert ((found.index != far.association[..., None]).all(-1) & (far.association >= 0)).sum() > 20
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    possible = possible_clusters(plugins.active, plugins.reach, batch.source.shape[1])
    expected = lattice_features(view, states, plugins.motions, found.nearest, possible, scales, boosters)
    chain = lattice_chain(replace(view, batch=replace(batch, truth=far)), plugins, scales, boosters, config)
    assert_close(chain.static[:, :, -1], expected.static[:, :, -1])
    assert_close(chain.moving[:, :, -1], expected.moving[:, :, -1])
    assert not torch.equal(chain.static, expected.static)


def test_the_model_measures_what_the_fit_does() -> None:
    batch, model = simulated(), JointScanCRF(ModelConfig(coupling="lattice")).double()
    view = model.view(batch)
    chain = lattice_chain(view, true_plugins(view.batch, 7), model.scales, model.boosters, model.config.inference)
    expected = chain.design().log_likelihood(torch.cat(model.weight_vectors)).sum(-1)
    assert_close(model.pseudo_log_likelihood(batch).detach(), expected.detach())
    model.pseudo_log_likelihood(batch).sum().backward()
    assert all(weight.grad is not None for weight in model.parameters())


@pytest.mark.parametrize("mode", ["hard", "soft", "off"])
def test_the_chain_keeps_the_features_of_the_decoding(mode: str) -> None:
    batch, scales, boosters = simulated(), Scales().double(), Boosters(1).double()
    plugins, view = true_plugins(batch, 4), PairView.of(batch, reach=mode)
    reach = (4 * torch.rand(*plugins.label.shape, 4, generator=generator(3), dtype=torch.float64) - 2).clamp(min=0)
    plugins = replace(plugins, reach=reach * (torch.arange(4) > 0))
    config = InferenceConfig(clusters=5, candidates=0)
    found = find_candidates(view, plugins.motions, plugins.active, config)
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    possible = possible_clusters(plugins.active, view.within(plugins.reach), batch.source.shape[1])
    features = lattice_features(view, states, plugins.motions, found.nearest, possible, scales, boosters, plugins.reach)
    chain = lattice_chain(view, plugins, scales, boosters, config)
    for f in fields(LatticeFeatures):
        assert torch.equal(getattr(chain, f.name), getattr(features, f.name)), f.name
    within = (plugins.reach == 0) | (mode != "hard")
    assert torch.equal(possible[..., :4], plugins.active[:, None] & within)
    assert (chain.moving[..., -1] != 0).any() == (mode == "soft")
