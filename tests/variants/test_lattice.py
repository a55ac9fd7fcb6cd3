"""The lattice against enumeration: messages on random factors, features by plain loops, decoding (T12 of the specification)."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import (
    CASES,
    MOTIONS,
    assert_identical,
    assert_same,
    assert_sane,
    make_batch,
    make_start,
    part_of,
    poor_scene,
    random_stumps,
    scene,
)
from support import PAPER_WEIGHTS, all_real, assert_close, extended, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.potentials import (
    AssociationStates,
    Boosters,
    PairView,
    association_unary,
    clustering_unary,
    find_candidates,
    possible_clusters,
    state_mask,
)
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.messages import chain_beliefs, log_partition
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.model import ClusteringCRF, JointScanCRF, MatchingCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.variants import sweep
from torchcrf_scan.variants.lattice import (
    LatticeBeliefs,
    lattice_beliefs,
    lattice_bound,
    lattice_log_partition,
    lattice_messages,
    lattice_score,
)
from torchcrf_scan.variants.lattice_features import (
    MOVING_WEIGHTS,
    LatticeFeatures,
    LatticePotentials,
    lattice_features,
    transition_kinds,
)

SEEDS = st.integers(0, 10_000)
NODES, CANDIDATES, CLUSTERS = st.integers(1, 4), st.integers(0, 2), st.integers(1, 2)
TEMPERATURES = st.sampled_from([0.0, 1.0])
LIMIT = 1_500  # labellings that an oracle may enumerate
WEIGHTS = JointScanCRF().double().fitted


def make_potentials(B: int, N: int, A: int, D: int, seed: int, *, impossible: bool = False) -> LatticePotentials:
    """Random factors; with `impossible`, a third of the super-nodes is -inf, but never the outlier of both labels."""
    unary = 2 * normal(B, N, A, D, seed=seed)
    if impossible:
        mask = torch.rand(unary.shape, generator=generator(seed)) < 1 / 3
        mask[..., -1, -1] = False
        unary = unary.masked_fill(mask, -torch.inf)
    return LatticePotentials(unary, 2 * normal(B, N - 1, A, A, 3, seed=seed + 1), 2 * normal(B, N - 1, D, D, seed=seed + 2))


def tables(potentials: LatticePotentials, b: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return oracles.lattice_tables(*(getattr(potentials, f.name)[b].detach().numpy() for f in fields(potentials)))


@pytest.mark.parametrize("seed", range(3))
def test_the_best_super_nodes_reach_the_value_of_the_relaxation(seed: int) -> None:
    potentials = make_potentials(2, 4, 3, 3, seed, impossible=True)
    states = lattice_beliefs(potentials, all_real(potentials.log_unary[..., 0])).best()
    scores = lattice_score(potentials, *states)
    assert_close(lattice_bound(potentials), scores)
    for b in range(2):
        unary, pairwise = tables(potentials, b)
        assert float(scores[b]) == pytest.approx(oracles.relaxed_best(list(unary), oracles.chain_edges(pairwise)), abs=1e-7)


def part(potentials: LatticePotentials, b: int, nodes: int) -> LatticePotentials:
    """The first nodes of chain b."""
    ends = (nodes, nodes - 1, nodes - 1)
    return LatticePotentials(*(getattr(potentials, f.name)[b : b + 1, :n] for f, n in zip(fields(potentials), ends, strict=True)))


def beliefs_of(potentials: LatticePotentials, temperature: float = 0.0) -> LatticeBeliefs:
    return lattice_beliefs(potentials, all_real(potentials.log_unary[..., 0]), temperature)


# --- messages -----------------------------------------------------------------------------------------------------------------


@given(NODES, CANDIDATES, CLUSTERS, TEMPERATURES, st.booleans(), SEEDS)
def test_beliefs_equal_brute_force(N: int, K: int, C: int, temperature: float, impossible: bool, seed: int) -> None:
    A, D = K + 1, C + 1
    N = max(n for n in range(1, N + 1) if (A * D) ** n <= LIMIT)
    potentials = make_potentials(1, N, A, D, seed, impossible=impossible)
    found = beliefs_of(potentials, temperature)
    expected = oracles.log_marginals(*tables(potentials), temperature).reshape(N, A, D)
    assert_close(found.log_joint[0], expected)
    for one, axis in ((found.log_association, 2), (found.log_cluster, 1)):
        summed = np.exp(expected).sum(axis) if temperature == 1 else np.exp(expected).max(axis)
        assert_close(one[0].exp(), summed / summed.sum(-1, keepdims=True))


@pytest.mark.parametrize("seed", range(3))
def test_the_best_super_nodes_of_a_toy_are_the_best_labelling(seed: int) -> None:
    potentials = make_potentials(1, 4, 3, 3, seed)
    unary, pairwise = tables(potentials)
    best = oracles.best_labelling(unary, pairwise)
    association, cluster = beliefs_of(potentials).best()
    assert tuple((association * 3 + cluster)[0].tolist()) == best
    assert oracles.score(unary, pairwise, best) <= float(lattice_log_partition(potentials))


@given(NODES, CANDIDATES, CLUSTERS, st.booleans(), SEEDS)
def test_log_partition_equals_brute_force(N: int, K: int, C: int, impossible: bool, seed: int) -> None:
    A, D = K + 1, C + 1
    N = max(n for n in range(1, N + 1) if (A * D) ** n <= LIMIT)
    potentials = make_potentials(1, N, A, D, seed, impossible=impossible)
    assert_close(lattice_log_partition(potentials), [oracles.log_partition(*tables(potentials))])


@given(st.integers(1, 12), st.integers(0, 4), st.integers(1, 4), st.booleans(), SEEDS)
def test_the_factored_chain_is_the_chain_of_all_states(N: int, K: int, C: int, impossible: bool, seed: int) -> None:
    A, D = K + 1, C + 1
    potentials = make_potentials(1, N, A, D, seed, impossible=impossible)
    unary, pairwise = (torch.from_numpy(table)[None] for table in tables(potentials))
    for temperature in (0.0, 0.5, 1.0):
        expected = chain_beliefs(unary, pairwise, all_real(unary), temperature)
        assert_close(beliefs_of(potentials, temperature).log_joint.flatten(2), expected)
    assert_close(lattice_log_partition(potentials), log_partition(unary, pairwise))


@given(NODES, CANDIDATES, CLUSTERS, st.booleans(), SEEDS)
def test_marginals_are_the_gradient_of_the_log_partition(N: int, K: int, C: int, impossible: bool, seed: int) -> None:
    potentials = make_potentials(2, N, K + 1, C + 1, seed, impossible=impossible)
    potentials.log_unary.requires_grad_()
    (gradient,) = torch.autograd.grad(lattice_log_partition(potentials).sum(), potentials.log_unary)
    assert_close(gradient, beliefs_of(potentials, 1.0).log_joint.detach().exp())


def test_gradients_equal_differences() -> None:
    potentials = make_potentials(1, 3, 3, 3, 0)
    inputs = [getattr(potentials, f.name).requires_grad_() for f in fields(potentials)]
    assert torch.autograd.gradcheck(lambda *factors: lattice_log_partition(LatticePotentials(*factors)), inputs)
    for temperature in (0.0, 0.7, 1.0):

        def logs(*factors: Tensor, temperature: float = temperature) -> tuple[Tensor, ...]:
            found = beliefs_of(LatticePotentials(*factors), temperature)
            return found.log_joint, found.log_association, found.log_cluster

        assert torch.autograd.gradcheck(logs, inputs)


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_gradients_with_impossible_states_are_finite(temperature: float) -> None:
    potentials = make_potentials(1, 6, 3, 3, 1, impossible=True)
    inputs = [getattr(potentials, f.name).requires_grad_() for f in fields(potentials)]
    found = beliefs_of(potentials, temperature).log_joint
    value = found[found > -torch.inf].sum() + lattice_log_partition(potentials).sum()
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(value, inputs))


def test_long_chains_neither_overflow_nor_vanish() -> None:
    potentials = make_potentials(1, 500, 3, 3, 0)
    strong = LatticePotentials(*(30 * getattr(potentials, f.name) for f in fields(potentials)))
    unary, pairwise = (torch.from_numpy(table)[None] for table in tables(strong))
    assert_close(lattice_log_partition(strong), log_partition(unary, pairwise))
    for temperature in (0.0, 1.0):
        assert beliefs_of(strong, temperature).log_joint.exp().sum((2, 3)).sub(1).abs().max() < 1e-9


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_without_terms_of_both_labels_the_chains_are_independent(temperature: float) -> None:
    A, D = 4, 3
    potentials = make_potentials(1, 6, A, D, 3)
    of_association, of_cluster = normal(1, 6, A, seed=5), normal(1, 6, D, seed=6)
    transitions = potentials.log_association[..., :1].expand(-1, -1, -1, -1, 3)
    apart = LatticePotentials(of_association[..., None] + of_cluster[:, :, None], transitions, potentials.log_cluster)
    found, mask = beliefs_of(apart, temperature), all_real(of_association)
    assert_close(found.log_association, chain_beliefs(of_association, transitions[..., 0], mask, temperature))
    assert_close(found.log_cluster, chain_beliefs(of_cluster, apart.log_cluster, mask, temperature))


@given(st.lists(NODES, min_size=1, max_size=3), TEMPERATURES, st.sampled_from([7.0, -np.inf, np.nan]), SEEDS)
def test_padding_and_other_chains_are_invisible(lengths: list[int], temperature: float, rubbish: float, seed: int) -> None:
    N = max(lengths) + 2
    whole = make_potentials(len(lengths), N, 3, 3, seed)
    mask = torch.arange(N) < torch.tensor(lengths)[:, None]
    factors = (whole.log_unary, mask), (whole.log_association, mask[:, 1:]), (whole.log_cluster, mask[:, 1:])
    dirty = [torch.where(real.view(*real.shape, *[1] * (f.dim() - 2)), f, rubbish) for f, real in factors]
    together = lattice_beliefs(LatticePotentials(*dirty), mask, temperature)
    for b, n in enumerate(lengths):
        alone = beliefs_of(part(whole, b, n), temperature)
        for f in fields(LatticeBeliefs):
            assert_close(getattr(together, f.name)[b, :n], getattr(alone, f.name)[0])
        assert_close(lattice_log_partition(whole)[b : b + 1], lattice_log_partition(part(whole, b, N)))


def test_an_inlier_is_not_outvoted_because_its_candidates_are_alike() -> None:
    joint = torch.tensor([[0.2, 0.0], [0.19, 0.0], [0.21, 0.0], [0.0, 0.4]]).log()[None, None]
    found = LatticeBeliefs(joint, joint.logsumexp(3), joint.logsumexp(2))
    assert [int(best) for best in found.best()] == [2, 0]
    cold = LatticeBeliefs(joint, joint.amax(3), joint.amax(2))
    assert [int(best) for best in cold.best()] == [3, 1]


def test_messages_are_normalised_and_start_at_nothing() -> None:
    forward, backward = lattice_messages(make_potentials(2, 5, 3, 2, 0))
    assert not forward[:, 0].any()
    assert not backward[:, -1].any()
    for messages in (forward, backward):
        assert_close(messages.flatten(2).amax(-1), torch.zeros(2, 5))


def test_kinds_of_transitions() -> None:
    assert transition_kinds(3).tolist() == [[0, 1, 2], [1, 0, 2], [2, 2, 2]]
    assert transition_kinds(2).tolist() == [[0, 2], [2, 2]]


# --- features -----------------------------------------------------------------------------------------------------------------


def loose_scales() -> Scales:
    """Scales at which few errors are as bad as any, and no two alike."""
    scales = Scales().double()
    scales.local.mul_(torch.linspace(8, 12, 12).double())
    scales.local_outlier.copy_(-torch.linspace(1, 4, 12).double())
    scales.pairwise_outlier.copy_(torch.tensor([-3.0, -2.0]))
    for name, value in {
        "cluster_distance": 4.0,
        "outlier_threshold": 0.9,
        "neighbour_weight": 2.0,
        "neighbour_distance": 1.5,
    }.items():
        getattr(scales, name).fill_(value)
    return scales


def features_of(
    batch: ScanPairBatch,
    motions: Tensor,
    possible: Tensor,
    scales: Scales,
    boosters: Boosters,
    candidates: int = 0,
    reach: Tensor | None = None,
    mode: str = "hard",
) -> LatticeFeatures:
    view, motions = PairView.of(batch, reach=mode), motions.expand(len(batch), -1, -1)
    active = torch.ones(motions.shape[:2], dtype=torch.bool)
    found = find_candidates(view, motions, active, InferenceConfig(candidates=candidates))
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    return lattice_features(view, states, motions, found.nearest, possible, scales, boosters, reach)


@pytest.mark.parametrize("seed", range(4))
def test_the_potentials_of_a_toy_equal_the_loops_and_so_does_the_answer(seed: int) -> None:
    N, M, C = 4, 2 + seed % 2 * 3, 2
    source, target = make_points(N, seed), make_points(M, seed + 20)
    batch = make_batch(source[None], target[None])
    scales, boosters, weights = loose_scales(), Boosters(9).double(), normal(30, seed=seed)
    stumps = random_stumps(boosters.data, seed), random_stumps(boosters.outlier, seed + 5)
    reach = torch.rand(1, N, C, generator=generator(seed)) < 0.6
    reach[..., 0] = True
    possible = possible_clusters(torch.ones(1, C, dtype=torch.bool), reach, N)
    found = features_of(batch, MOTIONS[:C], possible, scales, boosters).potentials(extended(weights))

    plain: dict[str, Any] = {name: value.tolist() for name, value in scales.named_buffers()}
    arrays = source.numpy(), target.numpy(), MOTIONS[:C].numpy()
    local = oracles.lattice_local(*arrays, reach[0].numpy(), plain, [0.0, 0.0, 0.0], *stumps)
    unary = local @ weights.numpy()
    unary.reshape(N, M + 1, C + 1)[:, :, :C][~reach[0].numpy()[:, None].repeat(M + 1, 1)] = -np.inf
    pairwise = oracles.lattice_pairwise(*arrays, plain) @ weights.numpy()
    for ours, theirs in zip(tables(found), (unary, pairwise), strict=True):
        assert_close(torch.from_numpy(ours), theirs, tolerance=1e-6)  # tables of stumps are summed in float32

    if M == 2:  # nine states a node: 6561 labellings
        parameters = Parameters(extended(weights[:18]), extended(weights[18:]), scales, boosters)
        start = replace(make_start(batch, MOTIONS[:C]), reach=(~reach).double())
        answer = decode(batch, start, config(clusters=C + 1, candidates=0, iterations=1), parameters)
        best = np.array(oracles.best_labelling(unary, pairwise))
        j, k = best // (C + 1), best % (C + 1)
        assert answer.association[0].tolist() == np.where(j == M, -1, j).tolist()
        assert answer.cluster[0].tolist() == np.where(k == C, -1, k).tolist()


@pytest.mark.parametrize("seed", range(4))
def test_with_extensions_they_equal_the_loops_too_and_so_does_the_answer(seed: int) -> None:
    N, M, C, mode = 4, 2 + seed % 2 * 3, 2, ("soft", "hard")[seed // 2]
    source, target = make_points(50, seed)[16 : 16 + N], make_points(50, seed + 20)[18 : 18 + M]  # dense: beams say something
    batch = make_batch(source[None], target[None])
    scales, boosters, weights = loose_scales(), Boosters(1).double(), normal(44, seed=seed)
    scales.gate.fill_(1.2)
    reach = (4 * torch.rand(1, N, C, generator=generator(seed), dtype=torch.float64) - 2).clamp(min=0)
    reach[..., 0] = 0
    within = PairView.of(batch, reach=mode).within(reach)
    possible = possible_clusters(torch.ones(1, C, dtype=torch.bool), within, N)
    found = features_of(batch, MOTIONS[:C], possible, scales, boosters, reach=reach, mode=mode).potentials(weights)

    plain: dict[str, Any] = {name: value.tolist() for name, value in scales.named_buffers()}
    arrays = source.numpy(), target.numpy(), MOTIONS[:C].numpy()
    nothing, there = ([], [], [], []), possible[0, :, :C].numpy()
    local = oracles.lattice_local(*arrays, there, plain, [0.0, 0.0, 0.0], nothing, nothing)
    feature = reach[0].numpy() * (mode == "soft")
    extension = oracles.lattice_extension(*arrays, there, plain, float(batch.range_noise), feature)
    assert (extension != 0).any((0, 1)).sum() >= 9 + (mode == "soft")
    paper, others = weights[PAPER_WEIGHTS].numpy(), weights[[k for k in range(44) if k not in PAPER_WEIGHTS]].numpy()
    unary = local @ paper + extension @ others
    unary.reshape(N, M + 1, C + 1)[:, :, :C][~there[:, None].repeat(M + 1, 1)] = -np.inf
    pairwise = oracles.lattice_pairwise(*arrays, plain) @ paper
    for ours, theirs in zip(tables(found), (unary, pairwise), strict=True):
        assert_close(torch.from_numpy(ours), theirs)

    if M == 2:
        start = replace(make_start(batch, MOTIONS[:C]), reach=reach)
        parameters = Parameters(*weights.split([23, 21]), scales, boosters)
        answer = decode(batch, start, config(clusters=C + 1, candidates=0, iterations=1), parameters, mode)
        j, k = np.divmod(np.array(oracles.best_labelling(unary, pairwise)), C + 1)
        assert answer.association[0].tolist() == np.where(j == M, -1, j).tolist()
        assert answer.cluster[0].tolist() == np.where(k == C, -1, k).tolist()


def test_what_a_mover_explains_beyond_its_reach_is_unexplained() -> None:
    batch, cluster = scene(24)
    scales, boosters = Scales().double(), Boosters(1).double()
    reach = torch.arange(3) != 1  # the first mover reaches none
    feature = MOVING_WEIGHTS.index(len(ASSOCIATION_WEIGHTS) + CLUSTERING_WEIGHTS.index("outlier"))

    def unexplained(within: Tensor | None) -> list[bool]:
        possible = possible_clusters(torch.ones(1, 3, dtype=torch.bool), within, 24)
        found = features_of(batch, MOTIONS, possible, scales, boosters).moving[0, ..., -1, feature]  # of the outlier cluster
        return (found == 1).all(-1).tolist()

    assert not any(unexplained(None))
    apart = torch.stack([torch.cdist(se2.apply(motion, batch.source[0]), batch.target[0]).amin(-1) for motion in MOTIONS[reach]])
    expected = apart.amin(0) > scales.outlier_threshold
    assert unexplained(reach) == expected.tolist()
    assert expected.any()
    assert not expected[cluster != 1].any()


@pytest.mark.parametrize("search", ["motion", "position"])
@pytest.mark.parametrize("candidates", [0, 3, 6])
def test_a_super_node_has_the_extensions_of_both_chains_given_the_others_state(candidates: int, search: str) -> None:
    N, M, C = 30, 26, 3
    source, target = make_points(N, 1), make_points(M, 21)
    batch = make_batch(source.expand(2, N, 2), target.expand(2, M, 2), ([N, N], [M, 4]))  # the second has few candidates
    view, scales, boosters = PairView.of(batch), loose_scales(), Boosters(1).double()
    motions, active = MOTIONS.expand(2, -1, -1), torch.ones(2, C, dtype=torch.bool)
    found = find_candidates(view, motions, active, InferenceConfig(candidates=candidates, candidate_search=search))
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    possible = torch.ones(2, N, C + 1, dtype=torch.bool)
    moving = lattice_features(view, states, motions, found.nearest, possible, scales, boosters).moving
    real = state_mask(found.mask)
    for k in range(C):
        moved = se2.apply(motions[:, k], batch.source)
        expected = association_unary(view, states, moved, scales, boosters)[..., 14:]
        assert_close(moving[..., k, 2:7][real], expected[real])
    K = found.index.shape[-1]
    for j in range(K + 1):
        association = found.index[..., j] if j < K else torch.full((2, N), -1)
        at = clustering.correspond(batch.source, batch.target, motions, found.nearest, association)
        expected = clustering_unary(view, at, motions, active, scales)[..., 4:]
        assert_close(moving[:, :, j, :, 11:][real[..., j]], expected[real[..., j]])
    assert moving.shape[-1] == 20
    assert (moving[real][..., 2:7] != 0).flatten(0, -2).any(0).all()


def test_no_motion_but_the_own_one_matters_to_an_inlier() -> None:
    batch, _ = scene(8)
    boosters = Boosters(9).double()
    random_stumps(boosters.data, 1)
    possible = torch.ones(1, 8, 4, dtype=torch.bool)
    one = features_of(batch, MOTIONS, possible, loose_scales(), boosters)
    other = features_of(batch, torch.cat([MOTIONS[:2], MOTIONS[2:] + 1]), possible, loose_scales(), boosters)
    assert torch.equal(one.moving[..., :2, :], other.moving[..., :2, :])
    assert not torch.equal(one.moving[..., 2, :], other.moving[..., 2, :])


def test_features_are_differentiable() -> None:
    batch, _ = scene(3)
    possible = torch.ones(1, 3, 4, dtype=torch.bool)

    def potentials(source: Tensor, motions: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        made = features_of(replace(batch, source=source), motions, possible, loose_scales(), Boosters(1).double(), 2)
        found = made.potentials(extended(weights))
        return found.log_unary, found.log_association, found.log_cluster

    inputs = [value.clone().requires_grad_() for value in (batch.source, MOTIONS, normal(30))]
    assert torch.autograd.gradcheck(potentials, inputs)


# --- decoding -----------------------------------------------------------------------------------------------------------------


def config(**inference: object) -> ModelConfig:
    return ModelConfig(coupling="lattice", inference=InferenceConfig(**inference))  # type: ignore[arg-type]


def decode(
    batch: ScanPairBatch,
    start: Start,
    settings: ModelConfig | None = None,
    parameters: Parameters | None = None,
    reach: str = "hard",
) -> Prediction:
    with torch.no_grad():
        return sweep.decode(PairView.of(batch, reach=reach), start, parameters or WEIGHTS, settings or config())


def test_a_clean_scene_is_solved() -> None:
    batch, cluster = scene(40)
    found = decode(batch, make_start(batch, MOTIONS + torch.tensor([0.01, 0.05, -0.05])), config(clusters=4))
    assert found.association[0].tolist() == list(range(40))
    assert found.cluster[0].tolist() == cluster.tolist()
    assert bool(found.converged)
    members = torch.stack([cluster == k for k in range(3)])  # (C, N)
    apart = torch.linalg.vector_norm(se2.apply(found.motions[0], batch.source) - se2.apply(MOTIONS, batch.source), dim=-1)
    assert float(apart[members].max()) < 0.03


@pytest.mark.parametrize("settings", [{}, {"temperature": 1.0, "motion_weights": "soft"}])
def test_the_order_of_the_movers_does_not_matter(settings: dict[str, object]) -> None:
    batch, _ = scene(24)
    order = [0, 2, 1, 3]  # a slot stays empty
    motions, active = torch.cat([MOTIONS, MOTIONS[:1] + 5]), torch.tensor([True, True, True, False])
    one = decode(batch, make_start(batch, motions, active=active), config(clusters=5, **settings))
    other = decode(batch, make_start(batch, motions[order], active=active[order]), config(clusters=5, **settings))
    assert_close(other.motions, one.motions[:, order])
    assert_close(other.log_cluster, one.log_cluster[..., [*order, 4]])
    assert_close(other.log_association, one.log_association)
    assert torch.equal(other.association, one.association)
    assert torch.equal(other.cluster, torch.tensor([*order, -1])[one.cluster])  # the permutation is its own inverse


def test_clusters_that_are_ruled_out_are_never_visited() -> None:
    batch, _ = scene(24)
    reach = torch.zeros(1, 24, 3, dtype=torch.float64)
    reach[0, :, 2] = 0.1
    active = torch.tensor([True, False, True])
    start = replace(make_start(batch, MOTIONS, active=active), reach=reach)
    for temperature in (0.0, 1.0):
        found = decode(batch, start, config(clusters=4, temperature=temperature))
        assert_sane(found, batch)
        assert (found.log_cluster[..., 1:3] == -torch.inf).all()
        assert set(found.cluster[0].tolist()) <= {-1, 0}
        assert (found.cluster == 0).any()


@pytest.mark.parametrize("settings", [{}, {"temperature": 1.0, "motion_weights": "soft", "candidates": 0}])
@pytest.mark.parametrize("name", CASES)
def test_there_is_an_answer_whatever_the_scans(name: str, settings: dict[str, object]) -> None:
    batch, start = poor_scene(name)
    found = decode(batch, start, config(clusters=start.motions.shape[1] + 1, **settings))
    assert_sane(found, batch)
    if name == "all outliers":
        assert (found.association == -1).all()
        assert_close(found.motions[:, 0], start.motions[:, 0])


def test_every_pair_is_decoded_as_if_alone() -> None:
    scenes = [scene(n, seed=n)[0] for n in (20, 28, 24)]
    lengths = [20, 28, 24]
    source, target = (torch.zeros(3, 28, 2).double() for _ in range(2))
    for b, alone in enumerate(scenes):
        source[b, : lengths[b]], target[b, : lengths[b]] = alone.source[0], alone.target[0]
    batch = make_batch(source, target, (lengths, lengths))
    start = make_start(batch, MOTIONS)
    for settings in ({}, {"temperature": 1.0}):
        together = decode(batch, start, config(clusters=4, **settings))
        for b in range(3):
            alone, own_start = part_of(batch, start, b)
            assert_same(together, decode(alone, own_start, config(clusters=4, **settings)), b, lengths[b])


def test_all_candidates_are_the_dense_model() -> None:
    batch, _ = scene(16)
    dense, every = (decode(batch, make_start(batch, MOTIONS), config(clusters=4, candidates=count)) for count in (0, 16))
    assert_identical(dense, every)


def test_gradients_reach_all_weights_that_a_scene_can_teach() -> None:
    pairs = simulate_pairs(SimulatorConfig(beams=61), 2, 1, 3)
    batch = ScanPairBatch.collate(pairs).without_truth()
    model = JointScanCRF(config(temperature=1.0, motion_weights="soft", iterations=2))
    found = model(batch)
    sum(log[log > -1e3].sum() for log in (found.log_association, found.log_cluster)).backward()  # type: ignore[union-attr]
    gradients = {name: weight.grad for name, weight in model.named_parameters()}
    assert all(gradient is not None and gradient.isfinite() for gradient in gradients.values())
    assert sum(float(gradient.abs()) > 0 for gradient in gradients.values() if gradient is not None) > 24


def test_simulated_pairs_are_decoded_from_scratch() -> None:
    pairs = simulate_pairs(SimulatorConfig(beams=121), 2, 1, 3)
    batch = ScanPairBatch.collate(pairs)
    assert batch.truth is not None
    with torch.no_grad():
        found = JointScanCRF(ModelConfig(coupling="lattice"))(batch.without_truth())
    assert_sane(found, batch)
    counts = batch.truth.known & (batch.truth.association >= 0)
    near = (found.association - batch.truth.association).abs() <= 2
    assert float((near & (found.association >= 0))[counts].float().mean()) > 0.6
    assert float((found.cluster == batch.truth.cluster)[counts & (batch.truth.cluster == 0)].float().mean()) > 0.5


# --- settings -----------------------------------------------------------------------------------------------------------------


def test_the_coupling_is_saved(tmp_path: Any) -> None:
    JointScanCRF(config(clusters=5)).save_pretrained(tmp_path)
    again = JointScanCRF.from_pretrained(tmp_path)
    assert again.config.coupling == "lattice"


@pytest.mark.parametrize("chains", ["matching", "clustering"])
def test_one_chain_alone_has_nothing_to_couple(chains: str) -> None:
    with pytest.raises(ValueError, match=f"coupling: expected motions for the {chains} chain alone, got lattice"):
        ModelConfig(chains=chains, coupling="lattice")
    layer = {"matching": MatchingCRF, "clustering": ClusteringCRF}[chains]
    assert layer(config()).config.coupling == "motions"


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="coupling: expected motions with schedule flooding, got lattice"):
        config(schedule="flooding")
    with pytest.raises(ValueError, match="coupling: expected one of motions, lattice, got ladder"):
        ModelConfig(coupling="ladder")
