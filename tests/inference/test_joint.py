"""The sweep schedule on scenes small enough to enumerate: exact chains, batches, slots, scans with little in them."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from scenes import CASES, MOTIONS, assert_identical, assert_same, assert_sane, make_batch, make_start, part_of, poor_scene, scene
from support import PAPER_ASSOCIATION, PAPER_CLUSTERING, assert_close, generator, make_points, normal, paper_weights
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.model import ClusteringCRF, JointScanCRF, MatchingCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import Scan, ScanPair

MODEL = JointScanCRF().double()


def random_parameters(seed: int) -> Parameters:
    return Parameters(*paper_weights(seed, seed + 1), Scales().double(), Boosters(1).double())


def config(chains: str = "joint", **inference: object) -> ModelConfig:
    return ModelConfig(chains=chains, inference=InferenceConfig(**inference))  # type: ignore[arg-type]


def decode(
    batch: ScanPairBatch,
    start: Start,
    settings: ModelConfig | None = None,
    parameters: Parameters | None = None,
    reach: str = "hard",
) -> Prediction:
    with torch.no_grad():
        return joint.decode(PairView.of(batch, reach=reach), start, parameters or MODEL.fitted, settings or config())


# --- exactness ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_clustering_chain_equals_brute_force(seed: int, temperature: float) -> None:
    source, target = make_points(6, seed), make_points(5, seed + 20)
    batch, parameters = make_batch(source[None], target[None]), random_parameters(seed)
    association = torch.randint(-1, 5, (1, 6), generator=generator(seed))
    active = torch.tensor([True, True, seed % 2 == 0])
    found = decode(
        batch,
        make_start(batch, MOTIONS, association, active),
        config("clustering", clusters=4, iterations=1, temperature=temperature),
        parameters,
    )
    scales, weights = parameters.scales, parameters.clustering[PAPER_CLUSTERING].numpy()
    arrays = source.numpy(), target.numpy(), MOTIONS.numpy()
    labels = association[0].tolist()
    local = oracles.local_clustering(
        *arrays, active.tolist(), labels, float(scales.cluster_distance), float(scales.outlier_threshold)
    )
    pairwise = oracles.pairwise_clustering(*arrays, labels, float(scales.neighbour_weight), float(scales.neighbour_distance))
    unary = local @ weights[:4]
    unary[:, :3][:, ~active.numpy()] = -np.inf
    assert_close(found.log_cluster[0], oracles.log_marginals(unary, pairwise @ weights[4:], temperature))
    if temperature == 0:
        best = oracles.best_labelling(unary, pairwise @ weights[4:])
        assert tuple(found.cluster[0].tolist()) == tuple(-1 if k == 3 else k for k in best)
    assert found.association[0].tolist() == labels


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_association_chain_equals_brute_force(seed: int, temperature: float) -> None:
    source, target = make_points(5, seed), make_points(4, seed + 20)
    batch, parameters = make_batch(source[None], target[None]), random_parameters(seed)
    settings = config("matching", candidates=0, iterations=1, temperature=temperature)
    found = decode(batch, make_start(batch, MOTIONS[:1]), settings, parameters)
    scales, weights = parameters.scales, parameters.association[PAPER_ASSOCIATION].numpy()
    moved = se2.apply(MOTIONS[0], source).numpy()
    local = oracles.local_association(source.numpy(), target.numpy(), scales.local.tolist(), [0.0, 0.0, 0.0], moved)
    outlier = np.broadcast_to(scales.local_outlier.numpy(), (5, 1, 12))
    unary = np.concatenate([local, outlier], axis=1) @ weights[:12]  # without boosters their two channels are zero
    pairwise = oracles.pairwise_association(
        source.numpy(), target.numpy(), scales.pairwise.tolist(), scales.pairwise_outlier.tolist()
    )
    assert_close(found.log_association[0], oracles.log_marginals(unary, pairwise @ weights[14:], temperature))
    if temperature == 0:
        best = oracles.best_labelling(unary, pairwise @ weights[14:])
        assert tuple(found.association[0].tolist()) == tuple(-1 if j == 4 else j for j in best)


def sharp_scales() -> Scales:
    """Scales at which a point is neither as bad as any nor wholly inside the gate."""
    scales = Scales().double()
    scales.cluster_distance.fill_(1.5)
    scales.gate.fill_(1.2)
    return scales


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_clustering_chain_with_its_extensions_equals_brute_force(seed: int, temperature: float) -> None:
    source, target = make_points(50, seed)[16:22], make_points(50, seed + 20)[18:23]  # dense, so that beams say something
    batch, weights, scales = make_batch(source[None], target[None]), normal(21, seed=seed), sharp_scales()
    association = torch.randint(-1, 5, (1, 6), generator=generator(seed))
    settings = config("clustering", clusters=4, iterations=1, temperature=temperature, motion_metric="given")
    parameters = Parameters(normal(23), weights, scales, Boosters(1).double())
    reach = 3 * torch.rand(1, 6, 3, generator=generator(seed + 9), dtype=torch.float64)
    found = decode(batch, replace(make_start(batch, MOTIONS, association), reach=reach), settings, parameters, "soft")
    arrays, labels = (source.numpy(), target.numpy(), MOTIONS.numpy()), association[0].tolist()
    local = oracles.local_clustering(*arrays, [True] * 3, labels, 1.5, float(scales.outlier_threshold))
    plain, possible = {name: value.tolist() for name, value in scales.named_buffers()}, np.ones((6, 3), dtype=bool)
    every = oracles.lattice_extension(*arrays, possible, plain, float(batch.range_noise), reach[0].numpy()).reshape(6, 6, 4, 14)
    extension = np.array([every[i, j, :, 5:] for i, j in enumerate(labels)])  # -1 is the outlier, the last state
    pairwise = oracles.pairwise_clustering(*arrays, labels, float(scales.neighbour_weight), float(scales.neighbour_distance))
    unary = np.concatenate([local, extension], axis=-1) @ weights[:13].numpy()
    assert_close(found.log_cluster[0], oracles.log_marginals(unary, pairwise @ weights[13:].numpy(), temperature))


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_association_chain_with_its_extensions_equals_brute_force(seed: int, temperature: float) -> None:
    source, target = make_points(50, seed)[16:21], make_points(50, seed + 20)[18:22]
    batch, weights, scales = make_batch(source[None], target[None]), normal(23, seed=seed), sharp_scales()
    settings = config("matching", candidates=0, iterations=1, temperature=temperature, motion_metric="given")
    parameters = Parameters(weights, normal(21), scales, Boosters(1).double())
    found = decode(batch, make_start(batch, MOTIONS[:1]), settings, parameters)
    moved = se2.apply(MOTIONS[0], source).numpy()
    local = oracles.local_association(source.numpy(), target.numpy(), scales.local.tolist(), [0.0, 0.0, 0.0], moved)
    outlier = np.broadcast_to(scales.local_outlier.numpy(), (5, 1, 12))
    plain, possible = {name: value.tolist() for name, value in scales.named_buffers()}, np.ones((5, 1), dtype=bool)
    arrays = source.numpy(), target.numpy(), MOTIONS[:1].numpy()
    every = oracles.lattice_extension(*arrays, possible, plain, float(batch.range_noise), np.zeros((5, 1)))
    extension = every.reshape(5, 5, 2, 14)[:, :, 0, :5]
    unary = np.concatenate([local, outlier], axis=1) @ weights[:12].numpy() + extension @ weights[14:19].numpy()
    pairwise = oracles.pairwise_association(
        source.numpy(), target.numpy(), scales.pairwise.tolist(), scales.pairwise_outlier.tolist()
    )
    assert_close(found.log_association[0], oracles.log_marginals(unary, pairwise @ weights[19:].numpy(), temperature))


def test_a_clean_scene_is_solved() -> None:
    batch, cluster = scene(40)
    start = make_start(batch, MOTIONS + torch.tensor([0.01, 0.05, -0.05]))
    found = decode(batch, start, config(clusters=4))
    assert found.association[0].tolist() == list(range(40))
    assert found.cluster[0].tolist() == cluster.tolist()
    assert bool(found.converged)
    members = torch.stack([cluster == k for k in range(3)])  # (C, N)
    apart = torch.linalg.vector_norm(se2.apply(found.motions[0], batch.source) - se2.apply(MOTIONS, batch.source), dim=-1)
    assert float(apart[members].max()) < 0.03


@pytest.mark.parametrize("metric", ["point", "line"])
def test_marginals_sum_to_one_and_labels_are_their_best(metric: str) -> None:
    batch, _ = scene(20)
    found = decode(batch, make_start(batch, MOTIONS), config(clusters=4, temperature=1.0, motion_metric=metric))
    assert_sane(found, batch)
    states = torch.cat([found.candidates, torch.full_like(found.candidates[..., :1], -1)], dim=-1)
    assert torch.equal(states.gather(-1, found.log_association.argmax(-1, keepdim=True))[..., 0], found.association)
    best = found.log_cluster.argmax(-1)
    assert torch.equal(torch.where(best == 3, -1, best), found.cluster)


def test_all_candidates_are_the_dense_model() -> None:
    batch, _ = scene(16)
    start = make_start(batch, MOTIONS)
    dense, every = (decode(batch, start, config(clusters=4, candidates=count, temperature=1.0)) for count in (0, 16))
    assert_identical(dense, every)


def test_all_real_candidates_are_the_dense_model_in_a_padded_batch() -> None:
    batch, _ = scene(16)
    padded = make_batch(*(torch.nn.functional.pad(points, (0, 0, 0, 4)) for points in (batch.source, batch.target)), ([16], [16]))
    start = make_start(padded, MOTIONS)
    dense, every = (decode(padded, start, config(clusters=4, candidates=count, temperature=1.0)) for count in (0, 16))
    assert every.candidates.shape[-1] == 16
    assert torch.equal(dense.association, every.association)
    assert torch.equal(dense.cluster, every.cluster)
    assert_close(every.motions, dense.motions)
    assert_close(every.log_association[:, :16, :16], dense.log_association[:, :16, :16])
    assert_close(every.log_association[:, :16, -1], dense.log_association[:, :16, -1])


# --- batches ------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated() -> tuple[ScanPairBatch, Start]:
    """Four simulated pairs of different sizes, started near the truth."""
    pairs = [simulate_pairs(SimulatorConfig(beams=beams), 1, 1, seed)[0] for seed, beams in enumerate((41, 61, 51, 33))]
    batch = ScanPairBatch.collate(pairs, torch.float64)
    assert batch.truth is not None
    known = batch.truth.motions.isfinite().all(-1)
    motions = batch.truth.motions.nan_to_num() + 0.02 * normal(*batch.truth.motions.shape)
    across = torch.stack([-batch.target[..., 1], batch.target[..., 0]], dim=-1)
    tangents = torch.nn.functional.normalize(across, dim=-1)
    return batch.without_truth(), Start(motions, known, nearest_association(batch, motions, known), tangents)


@pytest.mark.parametrize("chains", ["joint", "matching", "clustering"])
@pytest.mark.parametrize(
    "settings", [{}, {"temperature": 1.0, "motion_weights": "soft"}, {"motion_metric": "point", "candidates": 0}]
)
def test_every_pair_is_decoded_as_if_alone(
    simulated: tuple[ScanPairBatch, Start], settings: dict[str, object], chains: str
) -> None:
    batch, start = simulated
    if chains == "matching":
        start = start.background_alone()
    model = config(chains, clusters=start.motions.shape[1] + 1, **settings)
    together = decode(batch, start, model)
    for b in range(len(batch)):
        alone, own_start = part_of(batch, start, b)
        assert_same(together, decode(alone, own_start, model), b, alone.source.shape[1])


def test_what_lies_in_the_padding_is_never_read(simulated: tuple[ScanPairBatch, Start]) -> None:
    batch, start = simulated
    rubbish = replace(
        batch,
        source=torch.where(batch.source_mask[..., None], batch.source, 7.7),
        target=torch.where(batch.target_mask[..., None], batch.target, -3.3),
    )
    model = config(clusters=start.motions.shape[1] + 1)
    clean, dirty = decode(batch, start, model), decode(rubbish, start, model)
    assert torch.equal(clean.association, dirty.association)
    assert torch.equal(clean.cluster, dirty.cluster)
    assert_close(dirty.motions, clean.motions)


def test_settled_pairs_are_frozen(simulated: tuple[ScanPairBatch, Start]) -> None:
    batch, start = simulated
    clusters = start.motions.shape[1] + 1
    whole = decode(batch, start, config(clusters=clusters, iterations=12))
    assert whole.converged.any()
    for b in whole.converged.nonzero()[:, 0].tolist():
        cut = decode(batch, start, config(clusters=clusters, iterations=int(whole.iterations[b])))
        assert bool(cut.converged[b])
        for name in ("association", "cluster", "motions", "log_association", "log_cluster"):
            assert torch.equal(getattr(cut, name)[b], getattr(whole, name)[b]), name


def test_settled_is_what_another_round_would_not_change() -> None:
    batch, _ = scene(24)
    first = decode(batch, make_start(batch, MOTIONS), config(clusters=4, iterations=20))
    assert bool(first.converged)
    start = make_start(batch, first.motions[0], first.association, first.active)
    again = decode(batch, start, config(clusters=4, iterations=20))
    assert torch.equal(again.association, first.association)
    assert torch.equal(again.cluster, first.cluster)
    assert_close(again.motions, first.motions, tolerance=1e-3)


@pytest.mark.parametrize("iterations", [1, 4, 7])
def test_without_an_early_stop_every_round_is_done(iterations: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rounds = []
    step = joint.step

    def counted(*arguments: object) -> joint.State:
        rounds.append(1)
        return step(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(joint, "step", counted)
    batch, _ = scene(16)
    found = decode(batch, make_start(batch, MOTIONS), config(clusters=4, iterations=iterations, stop_early=False))
    assert len(rounds) == iterations
    assert found.iterations.tolist() == [iterations]


def test_no_round_leaves_the_start() -> None:
    batch, _ = scene(16)
    start = make_start(batch, MOTIONS)
    found = decode(batch, start, config(clusters=4, iterations=0))
    assert torch.equal(found.association, start.association)
    assert_close(found.motions, start.motions)
    assert found.iterations.tolist() == [0]
    assert_sane(found, batch)


def test_early_stop_saves_rounds() -> None:
    batch, _ = scene(16)
    found = decode(batch, make_start(batch, MOTIONS), config(clusters=4, iterations=30))
    assert 1 < int(found.iterations) < 30


def test_a_swing_is_halved() -> None:
    batch, _ = scene(6)
    state = joint.first_state(PairView.of(batch), make_start(batch, MOTIONS), InferenceConfig(clusters=4))
    apart = replace(state, association=state.association.roll(1, -1))

    def at(of: joint.State, motions: Tensor) -> joint.State:
        return replace(of, motions=replace(of.motions, value=motions[None]))

    older, before, after = at(state, MOTIONS), at(apart, MOTIONS + 1), at(state, MOTIONS + 2)
    assert_close(joint.damp(after, before, older).motions.value[0], MOTIONS + 1.5)
    onward = joint.damp(at(apart, MOTIONS + 2), before, older)
    assert_close(onward.motions.value[0], MOTIONS + 2)


# --- slots of the movers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"temperature": 1.0, "motion_weights": "soft"}])
def test_the_order_of_the_movers_does_not_matter(settings: dict[str, object]) -> None:
    batch, _ = scene(24)
    order = [0, 2, 1, 3]  # a slot stays empty
    motions, active = torch.cat([MOTIONS, MOTIONS[:1] + 5]), torch.tensor([True, True, True, False])
    one = decode(batch, make_start(batch, motions, active=active), config(clusters=5, **settings))
    other = decode(batch, make_start(batch, motions[order], active=active[order]), config(clusters=5, **settings))
    assert_close(other.motions, one.motions[:, order])
    assert torch.equal(other.active, one.active[:, order])
    assert_close(other.log_cluster, one.log_cluster[..., [*order, 4]])
    assert_close(other.log_association, one.log_association)
    assert torch.equal(other.association, one.association)
    slot_of = torch.tensor([*order, -1])  # the permutation is its own inverse
    assert torch.equal(other.cluster, slot_of[one.cluster])


def test_a_slot_that_does_not_exist_is_never_taken() -> None:
    batch, _ = scene(24)
    active = torch.tensor([True, False, True])
    found = decode(batch, make_start(batch, MOTIONS, active=active), config(clusters=4, temperature=1.0))
    assert_sane(found, batch)
    assert (found.log_cluster[..., 1] == -torch.inf).all()
    assert not (found.cluster == 1).any()
    assert not bool(found.active[0, 1])


def test_an_empty_cluster_keeps_its_slot_for_two_rounds() -> None:
    batch, _ = scene(16, movers=0)
    nowhere = torch.cat([MOTIONS[:1], MOTIONS[:1] + torch.tensor([0.0, 50.0, 50.0])])
    start = make_start(batch, nowhere)
    settings = {"clusters": 3, "stop_early": False}
    after = [decode(batch, start, config(iterations=rounds, **settings)) for rounds in (1, 2)]
    assert not (after[0].cluster == 1).any()
    assert after[0].active.tolist() == [[True, True]]
    assert after[1].active.tolist() == [[True, False]]
    assert_close(after[1].motions[0, 1], nowhere[1])


def test_more_movers_than_slots() -> None:
    batch, _ = scene(30, movers=2)
    found = decode(batch, make_start(batch, MOTIONS[:2]), config(clusters=3))
    assert_sane(found, batch)
    assert set(found.cluster[0].tolist()) <= {-1, 0, 1}


# --- scans with little in them ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chains", ["joint", "matching", "clustering"])
@pytest.mark.parametrize("settings", [{}, {"temperature": 1.0, "motion_weights": "soft", "candidates": 0}])
@pytest.mark.parametrize("name", CASES)
def test_there_is_an_answer_whatever_the_scans(name: str, settings: dict[str, object], chains: str) -> None:
    batch, start = poor_scene(name)
    if chains == "matching":
        start = start.background_alone()
    for metric in ("point", "line"):
        model = config(chains, clusters=start.motions.shape[1] + 1, motion_metric=metric, **settings)
        found = decode(batch, start, model)
        assert_sane(found, batch)
        if name == "all outliers":
            assert (found.association == -1).all()
            assert_close(found.motions[:, 0], start.motions[:, 0])


def test_a_poor_pair_does_not_disturb_its_neighbour() -> None:
    batch, _ = scene(12)
    both = make_batch(batch.source.repeat(2, 1, 1), batch.target.repeat(2, 1, 1), ([12, 0], [12, 0]))
    alone, together = (decode(b, make_start(b, MOTIONS), config(clusters=4)) for b in (batch, both))
    assert_same(together, alone, 0, 12)


# --- one chain alone ----------------------------------------------------------------------------------------------------------


def test_matching_has_one_motion_and_calls_every_associated_point_background() -> None:
    batch, cluster = scene(30, movers=1)
    found = decode(batch, make_start(batch, MOTIONS[:1]), config("matching"))
    assert found.motions.shape == (1, 1, 3)
    assert found.log_cluster.shape == (1, 30, 2)
    assert torch.equal(found.cluster, torch.where(found.association >= 0, 0, -1))
    inlier = found.log_association[..., :-1].exp().sum(-1)
    assert_close(found.log_cluster[..., 0].exp(), inlier)
    still = cluster == 0
    assert (found.association[0, still] == torch.arange(30)[still]).float().mean() > 0.9


def test_matching_layer_has_eighteen_weights_in_use() -> None:
    model = MatchingCRF().double()
    batch, _ = scene(12)
    found = model(batch, make_start(batch, MOTIONS[:1]))
    found.log_association[found.log_association > -torch.inf].sum().backward()
    used = [name for name, weight in model.named_parameters() if weight.grad is not None and float(weight.grad.abs()) > 0]
    assert all(name.startswith("association_weights") for name in used)
    assert "association_weights.registered_translation" in used


def test_clustering_keeps_the_associations_that_it_is_given() -> None:
    batch, cluster = scene(30)
    association = torch.arange(30)[None].clone()
    association[0, 4] = -1
    found = ClusteringCRF(config(clusters=4)).double()(batch, make_start(batch, MOTIONS, association))
    assert torch.equal(found.association, association)
    right = found.cluster[0] == cluster
    assert right[torch.arange(30) != 4].all()


@pytest.mark.parametrize("weights", ["hard", "soft"])
def test_clustering_believes_the_associations_that_it_is_given(weights: str) -> None:
    batch, _ = scene(12, movers=0)
    association = torch.arange(12)[None].roll(3, -1)  # not among the two nearest
    settings = config("clustering", clusters=2, candidates=2, iterations=1, motion_weights=weights, temperature=1.0)
    found = decode(batch, make_start(batch, MOTIONS[:1], association), settings)
    assert torch.equal(found.association, association)
    states = torch.cat([found.candidates, torch.full_like(found.candidates[..., :1], -1)], dim=-1)
    believed = states.gather(-1, found.log_association.argmax(-1, keepdim=True))[..., 0]
    assert torch.equal(believed, association)


def test_a_scan_pair_without_returns_is_matched() -> None:
    bearings = np.linspace(-1.0, 1.0, 9)
    silent, wall = Scan.from_ranges(np.full(9, np.inf), bearings), Scan.from_ranges(np.full(9, 4.0), bearings)
    for pair in (ScanPair(silent, wall), ScanPair(wall, silent), ScanPair(silent, silent)):
        found = JointScanCRF().match_pairs([pair])[0]
        assert (found.association == -1).all()
        assert np.isfinite(found.motions).all()


# --- motions that are given ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chains", ["joint", "matching", "clustering"])
@pytest.mark.parametrize("weights", ["hard", "soft"])
def test_given_motions_stay_exactly(chains: str, weights: str) -> None:
    batch, _ = scene()
    start = make_start(batch, MOTIONS[:1] if chains == "matching" else MOTIONS)
    given = InferenceConfig(motion_metric="given", motion_weights=weights, stop_early=False)
    found, moved = (
        decode(batch, start, settings=ModelConfig(chains=chains, inference=inference))
        for inference in (given, replace(given, motion_metric="point"))
    )
    assert torch.equal(found.motions, start.motions)
    assert not torch.equal(moved.motions, start.motions)
    assert_sane(found, batch)


def test_the_labels_at_given_motions_are_those_of_one_round() -> None:
    batch, cluster = scene()
    model = ModelConfig(inference=InferenceConfig(motion_metric="given", iterations=6))
    found = decode(batch, make_start(batch, MOTIONS), settings=model)
    assert found.cluster[0].tolist() == cluster.tolist()
    assert found.association[0].tolist() == list(range(batch.source.shape[1]))
    assert found.converged.all()


def test_associate_is_the_first_pass_over_the_association_chain() -> None:
    batch, cluster = scene()
    start, matching = make_start(batch, MOTIONS), InferenceConfig(motion_metric="given", iterations=1)
    view = PairView.of(batch)
    here = joint.associate(view, start, cluster[None], MODEL.fitted, matching)
    assert here[0].tolist() == list(range(batch.source.shape[1]))
    alone = start.background_alone()
    one_motion = joint.associate(view, alone, torch.zeros_like(cluster)[None], MODEL.fitted, matching)
    expected = decode(batch, alone, settings=ModelConfig(chains="matching", inference=matching)).association
    assert torch.equal(one_motion, expected)
    nobody = torch.full_like(cluster, -1)[None]  # outliers move with the background
    assert torch.equal(joint.associate(view, alone, nobody, MODEL.fitted, matching), expected)
