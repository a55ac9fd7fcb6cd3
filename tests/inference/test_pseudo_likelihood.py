"""Pseudo-likelihood: against plain loops, its derivatives, and the nodes that must not count."""

import math
from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from scenes import make_batch, random_stumps
from support import assert_close, extended, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.candidates import with_targets
from torchcrf_scan.features.potentials import (
    AssociationStates,
    Boosters,
    PairView,
    association_unary,
    find_candidates,
    registered_points,
)
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.pseudo_likelihood import (
    Chain,
    Design,
    PlugIns,
    association_chain,
    association_design,
    at_true_neighbours,
    clustering_chain,
    for_background_alone,
    pseudo_log_likelihood,
    true_plugins,
)
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.model import ClusteringCRF, JointScanCRF, MatchingCRF
from torchcrf_scan.names import CLUSTERING_UNARY, LOCAL_CHANNELS

N, M, C = 6, 5, 3
DENSE = InferenceConfig(candidates=0)
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3], [0.2, -0.2, -1.0]], dtype=torch.float64)
ASSOCIATION = torch.tensor([[0, 1, -1, 2, 4, 3]])
CLUSTER = torch.tensor([[0, 0, -1, 1, 1, 0]])


def tiny(seed: int = 0) -> ScanPairBatch:
    """One annotated pair: background, one mover, one outlier; partners where the truth sends them, a little off."""
    source = make_points(N, seed)[None]
    target = make_points(M, seed + 1)[None].clone()
    for i in range(N):
        if int(ASSOCIATION[0, i]) >= 0:
            target[0, ASSOCIATION[0, i]] = se2.apply(MOTIONS[CLUSTER[0, i]], source[0, i : i + 1])[0] + 0.1 * normal(2, seed=i)
    truth = Truth(ASSOCIATION.clone(), CLUSTER.clone(), MOTIONS[None, :2].clone(), torch.ones(1, N, dtype=torch.bool))
    guess = torch.tensor([[0.02, -0.1, 0.0]], dtype=torch.float64)
    return replace(make_batch(source, target), initial_motion=guess, truth=truth)


def plugins_of(batch: ScanPairBatch) -> PlugIns:
    """The truth with other motions and labels plugged in, so that it shows which is used where."""
    association = torch.tensor([[0, -1, 1, 2, 4, 4]])
    cluster = torch.tensor([[0, 1, -1, 1, 2, 0]])
    return replace(
        true_plugins(batch, C),
        motions=MOTIONS[None] + 0.01,
        active=torch.ones(1, C, dtype=torch.bool),
        association=association,
        cluster=cluster,
    )


def log_conditional(features: np.ndarray, weights: np.ndarray, label: int) -> float:
    scores = [float(row @ weights) for row in features]
    return scores[label] - oracles.log_sum_exp(scores)


def conditionals(unary: np.ndarray, pairwise: np.ndarray, labels: list[int], weights: np.ndarray) -> list[float]:
    """log p(label of i | labels of i - 1 and i + 1), a node after the other. unary: (N, S, F), pairwise: (N - 1, S, S, P)."""
    out = []
    for i, label in enumerate(labels):
        rows = []
        for state in range(unary.shape[1]):
            edge = np.zeros(pairwise.shape[-1])
            if i > 0:
                edge += pairwise[i - 1, labels[i - 1], state]
            if i + 1 < len(labels):
                edge += pairwise[i, state, labels[i + 1]]
            rows.append(np.concatenate([unary[i, state], edge]))
        out.append(log_conditional(np.array(rows), weights, label))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_edges_to_true_neighbours_alone_give_the_same_design(seed: int) -> None:
    """Fewer transitions are calculated, and not one number changes; also with few candidates, outliers and unknown points."""
    batch, scales, boosters = tiny(seed), Scales().double(), Boosters(7).double()
    plugins = plugins_of(batch)
    plugins = replace(plugins, known=plugins.known & (torch.arange(plugins.known.shape[1]) != 1 + seed % 3))
    for config in (DENSE, replace(DENSE, candidates=2)):
        for has_lengths in (True, False):
            inputs = (replace(PairView.of(batch), has_lengths=has_lengths), plugins, scales, boosters, config)
            expected, found = association_chain(*inputs).design(), association_design(*inputs)
            for name in ("features", "mask", "label", "known"):
                assert torch.equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize("seed", range(4))
def test_the_association_conditionals_equal_the_loops(seed: int) -> None:
    batch, scales, boosters = tiny(seed), Scales().double(), Boosters(7).double()
    scales.local.mul_(10)  # else every error is as bad as any
    data, outlier = random_stumps(boosters.data, seed), random_stumps(boosters.outlier, seed + 7)
    plugins = plugins_of(batch)
    design = association_chain(PairView.of(batch), plugins, scales, boosters, DENSE).design()

    source, target = batch.source[0].numpy(), batch.target[0].numpy()
    own = plugins.cluster[0].clamp(min=0)
    moved = np.array([oracles.move(plugins.motions[0, own[i]].tolist(), source[i]) for i in range(N)])
    local = oracles.local_association(source, target, scales.local.tolist(), batch.initial_motion[0].tolist(), moved)
    unary = np.zeros((N, M + 1, 14))
    unary[:, :M, :12] = local
    unary[:, M, :12] = scales.local_outlier.numpy()
    for i in range(N):
        margins = [oracles.stump_sum(local[i, j], *data) for j in range(M)]
        unary[i, :M, 12] = margins
        best = max(range(M), key=lambda j: margins[j])
        others = [margins[j] for j in range(M) if abs(j - best) >= 3]
        gap = margins[best] - max(others) if others else 0.0
        unary[i, M, 13] = oracles.stump_sum([*local[i].max(axis=0), margins[best], gap], *outlier)
    pairwise = oracles.pairwise_association(source, target, scales.pairwise.tolist(), scales.pairwise_outlier.tolist())
    labels = [j if j >= 0 else M for j in ASSOCIATION[0].tolist()]
    weights = normal(18, seed=seed)
    expected = conditionals(unary, pairwise, labels, weights.numpy())
    assert_close(design.log_likelihood(extended(weights))[0], expected, tolerance=1e-6)  # tables of stumps are summed in float32
    assert design.label[0].tolist() == labels


@pytest.mark.parametrize("seed", range(4))
def test_the_clustering_conditionals_equal_the_loops(seed: int) -> None:
    batch, scales = tiny(seed), Scales().double()
    scales.cluster_distance.fill_(1.0)
    plugins = plugins_of(batch)
    design = clustering_chain(PairView.of(batch), plugins, scales).design()
    arrays = batch.source[0].numpy(), batch.target[0].numpy(), plugins.motions[0].numpy()
    plugged = plugins.association[0].tolist()
    limits = float(scales.cluster_distance), float(scales.outlier_threshold)
    local = oracles.local_clustering(*arrays, plugins.active[0].tolist(), plugged, *limits)
    pairwise = oracles.pairwise_clustering(*arrays, plugged, float(scales.neighbour_weight), float(scales.neighbour_distance))
    labels = [k if k >= 0 else C for k in CLUSTER[0].tolist()]
    weights = normal(12, seed=seed)
    assert_close(design.log_likelihood(extended(weights))[0], conditionals(local, pairwise, labels, weights.numpy()))


def test_inactive_slots_are_no_alternative() -> None:
    batch = tiny()
    plugins = true_plugins(batch, 4)
    assert plugins.active.tolist() == [[True, True, False, False]]
    weights = normal(21)
    wide = clustering_chain(PairView.of(batch), plugins, Scales().double()).design().log_likelihood(weights)
    narrow = clustering_chain(PairView.of(batch), true_plugins(batch, 2), Scales().double()).design().log_likelihood(weights)
    assert_close(wide, narrow)


def test_the_joint_is_the_sum_of_both_chains() -> None:
    batch, scales, boosters = tiny(), Scales().double(), Boosters(1).double()
    parameters = Parameters(normal(23), normal(21, seed=1), scales, boosters)
    view, plugins = PairView.of(batch), plugins_of(batch)
    first = (
        association_chain(view, plugins, scales, boosters, InferenceConfig())
        .design()
        .log_likelihood(parameters.association)
        .sum(-1)
    )
    second = clustering_chain(view, plugins, scales).design().log_likelihood(parameters.clustering).sum(-1)
    for chains, expected in (("joint", first + second), ("matching", first), ("clustering", second)):
        assert_close(pseudo_log_likelihood(view, plugins, parameters, ModelConfig(chains=chains)), expected)


# --- derivatives --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pairs() -> ScanPairBatch:
    """Three annotated pairs of different sizes."""
    return ScanPairBatch.collate([simulate_pairs(SimulatorConfig(beams=b), 1, 1, b)[0] for b in (41, 61, 33)], torch.float64)


def test_the_gradient_equals_central_differences(pairs: ScanPairBatch) -> None:
    model = JointScanCRF(ModelConfig(features=FeatureConfig(reach="soft"))).double()
    random_stumps(model.boosters.data, 1)
    random_stumps(model.boosters.outlier, 2)
    plugins = true_plugins(model.view(pairs).batch, 7)
    reach = 3 * torch.rand(*plugins.label.shape, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    plugins = replace(plugins, reach=reach)
    value = model.pseudo_log_likelihood(pairs, plugins).sum()
    names, weights = zip(*model.named_parameters(), strict=True)
    slopes = torch.autograd.grad(value, weights)
    step = 1e-4
    assert len(names) == 44
    for name, weight, slope in zip(names, weights, slopes, strict=True):
        sides = []
        for sign in (1, -1):
            with torch.no_grad():
                weight += sign * step
                sides.append(float(model.pseudo_log_likelihood(pairs, plugins).sum()))
                weight -= sign * step
        numeric = (sides[0] - sides[1]) / (2 * step)
        assert math.isclose(float(slope), numeric, rel_tol=1e-6, abs_tol=1e-6), name
    assert slopes[names.index("clustering_weights.reach")] != 0


@pytest.mark.parametrize("chain", ["association", "clustering"])
def test_the_hessian_is_positive_definite_with_the_prior(pairs: ScanPairBatch, chain: str) -> None:
    view, plugins, scales = PairView.of(pairs), true_plugins(pairs, 7), Scales().double()
    design = (
        association_chain(view, plugins, scales, Boosters(1).double(), InferenceConfig()).design()
        if chain == "association"
        else clustering_chain(view, plugins, scales).design()
    )
    prior = 10.0

    def loss(weights: Tensor) -> Tensor:
        return (weights**2).sum() / (2 * prior**2) - design.log_likelihood(weights).sum()

    at = 0.1 * normal(design.features.shape[-1])
    eigenvalues = torch.linalg.eigvalsh(torch.autograd.functional.hessian(loss, at))
    assert float(eigenvalues[0]) > 0.999 / prior**2
    assert float(eigenvalues[-1]) > 1.0


# --- what counts --------------------------------------------------------------------------------------------------------------


def designs(batch: ScanPairBatch) -> list[Design]:
    view, plugins = PairView.of(batch), true_plugins(batch, C)
    return [
        association_chain(view, plugins, Scales().double(), Boosters(1).double(), DENSE).design(),
        clustering_chain(view, plugins, Scales().double()).design(),
    ]


def annotated(batch: ScanPairBatch, **changes: Tensor) -> ScanPairBatch:
    assert batch.truth is not None
    return replace(batch, truth=replace(batch.truth, **changes))


@pytest.mark.parametrize("node", [0, 3, N - 1])
def test_unknown_nodes_say_nothing_and_do_not_count(node: int) -> None:
    known = torch.ones(1, N, dtype=torch.bool)
    known[0, node] = False
    other_association, other_cluster = ASSOCIATION.clone(), CLUSTER.clone()
    other_association[0, node], other_cluster[0, node] = -1, -1
    one = annotated(tiny(), known=known)
    other = annotated(tiny(), known=known, association=other_association, cluster=other_cluster)
    first, second = designs(one)[0], designs(other)[0]
    weights = normal(23)
    assert float(first.log_likelihood(weights)[0, node]) == 0
    assert_close(second.log_likelihood(weights), first.log_likelihood(weights))
    clustering = designs(one)[1]
    assert float(clustering.log_likelihood(normal(21))[0, node]) == 0
    edges = slice(CLUSTERING_UNARY, None)
    full = designs(tiny())[1].features[0, :, :, edges]
    for neighbour in {node - 1, node + 1} & set(range(N)):
        assert not torch.equal(clustering.features[0, neighbour, :, edges], full[neighbour])
    assert torch.equal(clustering.features[0, node, :, edges], full[node])


def test_movers_without_a_slot_are_unknown() -> None:
    plugins = true_plugins(tiny(), 1)
    assert plugins.known.tolist() == [[True, True, True, False, False, True]]
    assert plugins.label.tolist() == [[0, 0, -1, -1, -1, 0]]
    assert plugins.motions.shape == (1, 1, 3)


def test_movers_without_a_slot_do_not_train_the_association_chain() -> None:
    """Their registered channel would be taken under the background's motion."""
    batch, scales, boosters, weights = tiny(), Scales().double(), Boosters(1).double(), normal(23)
    chain = association_chain(PairView.of(batch), true_plugins(batch, 1), scales, boosters, DENSE)
    assert chain.known.tolist() == [[True, True, True, False, False, True]]
    without = annotated(batch, known=CLUSTER < 1)
    expected = association_chain(PairView.of(without), true_plugins(without, 1), scales, boosters, DENSE)
    assert_close(chain.design().log_likelihood(weights), expected.design().log_likelihood(weights))


def test_movers_without_a_motion_are_unknown() -> None:
    batch = tiny()
    assert batch.truth is not None
    motions = batch.truth.motions.clone()
    motions[0, 1] = torch.nan
    plugins = true_plugins(annotated(batch, motions=motions), C)
    assert plugins.active.tolist() == [[True, False, False]]
    assert plugins.motions.isfinite().all()
    assert plugins.known.tolist() == [[True, True, True, False, False, True]]


def test_padding_does_not_count() -> None:
    batch = tiny()
    padded = replace(
        batch,
        source=torch.cat([batch.source, torch.full((1, 3, 2), 2.5).double()], dim=1),
        source_mask=torch.arange(N + 3)[None] < N,
        target=torch.cat([batch.target, torch.full((1, 2, 2), 1.5).double()], dim=1),
        target_mask=torch.arange(M + 2)[None] < M,
        truth=Truth(
            torch.nn.functional.pad(ASSOCIATION, (0, 3), value=-1),
            torch.nn.functional.pad(CLUSTER, (0, 3), value=-1),
            MOTIONS[None, :2],
            torch.arange(N + 3)[None] < N,
        ),
    )
    for one, other, width in zip(designs(batch), designs(padded), (23, 21), strict=True):
        assert_close(other.log_likelihood(normal(width))[:, :N], one.log_likelihood(normal(width)))
        assert (other.log_likelihood(normal(width))[:, N:] == 0).all()


@pytest.mark.parametrize("layer", [JointScanCRF, MatchingCRF, ClusteringCRF])
def test_a_batch_is_its_pairs(pairs: ScanPairBatch, layer: type[JointScanCRF]) -> None:
    model = layer().double()
    together = model.pseudo_log_likelihood(pairs).detach()
    assert together.shape == (3,)
    assert (together < 0).all()
    for b in range(3):
        assert_close(model.pseudo_log_likelihood(pairs[b : b + 1])[0].detach(), together[b])


def test_more_candidates_are_more_alternatives(pairs: ScanPairBatch) -> None:
    values = [
        MatchingCRF(ModelConfig(inference=InferenceConfig(candidates=count))).double().pseudo_log_likelihood(pairs)
        for count in (2, 8, 0)
    ]
    assert (values[0] > values[1]).all()
    assert (values[1] > values[2]).all()


def test_without_truth_there_is_none() -> None:
    with pytest.raises(ValueError, match=r"batch\.truth: expected annotated pairs"):
        JointScanCRF().pseudo_log_likelihood(tiny().without_truth())


# --- the true target among the candidates -------------------------------------------------------------------------------------

FAR = ASSOCIATION.roll(2, dims=1)  # annotated targets that are not among the nearest


def fitted() -> tuple[Scales, Boosters]:
    """Wide scales and random stumps."""
    scales, boosters = Scales().double(), Boosters(9).double()
    scales.local.mul_(10)
    random_stumps(boosters.data, 3)
    random_stumps(boosters.outlier, 4)
    return scales, boosters


def few_candidates(batch: ScanPairBatch) -> tuple[Chain, Tensor, AssociationStates]:
    """The association chain with two candidates, its outlier states (B, N, 19) and candidates as inference has them."""
    (scales, boosters), config = fitted(), InferenceConfig(candidates=2)
    view, plugins = PairView.of(batch), replace(plugins_of(tiny()), motions=MOTIONS[None])
    found = find_candidates(view, plugins.motions, plugins.active, config)
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    one_hot = torch.nn.functional.one_hot(plugins.cluster.clamp(min=0), C + 1).double()
    moved = registered_points(batch.source, plugins.motions, plugins.active, one_hot)
    outlier = association_unary(view, states, moved, scales, boosters)[:, :, -1]
    return association_chain(view, plugins, scales, boosters, config), outlier, states


def test_the_outlier_booster_sees_the_candidates_that_inference_finds() -> None:
    chain, outlier, states = few_candidates(annotated(tiny(), association=FAR))
    is_found = (states.candidates == FAR[..., None]).any(-1)
    assert (~is_found & (FAR >= 0)).sum() >= 2
    assert_close(chain.unary[:, :, -1], outlier)
    other, _, _ = few_candidates(tiny())
    assert_close(other.unary[:, :, -1], chain.unary[:, :, -1])
    assert outlier[..., len(LOCAL_CHANNELS) + 1].unique().numel() > 1


def test_the_inlier_states_have_the_features_of_their_targets() -> None:
    chain, _, _ = few_candidates(annotated(tiny(), association=FAR))
    plugins = replace(plugins_of(tiny()), motions=MOTIONS[None])
    dense = association_chain(PairView.of(annotated(tiny(), association=FAR)), plugins, *fitted(), DENSE)
    for i in torch.arange(N)[FAR[0] >= 0].tolist():
        own = chain.unary[0, i, chain.label[0, i], : len(LOCAL_CHANNELS) + 1]
        assert_close(own, dense.unary[0, i, FAR[0, i], : len(LOCAL_CHANNELS) + 1])


# --- parts --------------------------------------------------------------------------------------------------------------------


def test_the_truth_is_among_the_candidates() -> None:
    index = torch.tensor([[[1, 3, 5], [1, 3, 5], [1, 3, 5], [0, 0, 0]]])
    mask = torch.tensor([[[True, True, True]] * 2 + [[True, True, False], [False, False, False]]])
    found, is_real, label = with_targets(index, mask, torch.tensor([[3, 7, 5, -1]]))
    assert label.tolist() == [[1, 2, 2, 3]]
    assert found[0, :3].tolist() == [[1, 3, 5], [1, 3, 7], [1, 3, 5]]
    assert is_real.tolist() == [[[True] * 3] * 3 + [[False] * 3]]


def test_a_masked_candidate_does_not_pass_for_the_truth() -> None:
    found, is_real, label = with_targets(torch.tensor([[[4, 0]]]), torch.tensor([[[True, False]]]), torch.tensor([[0]]))
    assert found.tolist() == [[[4, 0]]]
    assert is_real.tolist() == [[[True, True]]]
    assert label.tolist() == [[1]]


def test_edges_at_the_true_neighbours() -> None:
    pairwise = normal(1, 2, 3, 3, 2)
    label, known = torch.tensor([[2, 0, 1]]), torch.tensor([[True, True, False]])
    found = at_true_neighbours(pairwise, label, known)
    assert_close(found[0, 0], pairwise[0, 0, :, 0])
    assert_close(found[0, 1], pairwise[0, 0, 2])  # nothing from the unknown neighbour
    assert_close(found[0, 2], pairwise[0, 1, 0])


def test_one_node_has_no_edges() -> None:
    found = at_true_neighbours(normal(2, 0, 3, 3, 4), torch.zeros(2, 1, dtype=torch.int64), torch.ones(2, 1, dtype=torch.bool))
    assert_close(found, torch.zeros(2, 1, 3, 4).double())


def test_matching_moves_everything_with_the_background() -> None:
    plugins = for_background_alone(true_plugins(tiny(), C), tiny())
    assert plugins.motions.shape == (1, 1, 3)
    assert (plugins.cluster == 0).all()
    assert plugins.label.tolist() == [[0, 0, -1, 0, 0, 0]]


def test_matching_needs_no_slot_for_a_mover() -> None:
    wide, narrow = (for_background_alone(true_plugins(tiny(), clusters), tiny()) for clusters in (C, 1))
    assert narrow.known.all()
    for name in ("motions", "active", "cluster", "label", "known"):
        assert torch.equal(getattr(narrow, name), getattr(wide, name)), name


def test_matching_is_scored_as_it_is_fitted() -> None:
    batch, model = tiny(), MatchingCRF().double()
    own = model.view(batch).batch
    expected = model.pseudo_log_likelihood(batch, for_background_alone(true_plugins(own, C), own))
    assert_close(model.pseudo_log_likelihood(batch).detach(), expected.detach())


# --- reaches ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["hard", "soft", "off"])
def test_a_mover_beyond_its_reach_is_no_alternative(pairs: ScanPairBatch, mode: str) -> None:
    model = JointScanCRF(ModelConfig(features=FeatureConfig(reach=mode))).double()
    view = model.view(pairs)
    plugins = true_plugins(view.batch, 7)
    label = plugins.label.masked_fill(plugins.label < 0, 0)[..., None]
    beyond = torch.rand(*plugins.label.shape, 7, generator=torch.Generator().manual_seed(4)) < 0.3
    beyond = beyond.scatter(-1, label, False)  # the true clusters are within reach
    plugins = replace(plugins, active=torch.ones_like(plugins.active), reach=beyond.double())
    chain = clustering_chain(view, plugins, model.scales)
    assert torch.equal(chain.mask[..., :7], ~beyond if mode == "hard" else torch.ones_like(beyond))
    assert chain.mask[..., 7].all()
    with torch.no_grad():
        within = model.pseudo_log_likelihood(pairs, plugins)
        blind = model.pseudo_log_likelihood(pairs, replace(plugins, reach=None))
    assert torch.equal(within > blind, torch.full_like(pairs.source_closed, mode == "hard"))  # a soft weight begins at 0
