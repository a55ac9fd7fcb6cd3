"""The layer as its users meet it: named weights, saving, one pair and many, gradients."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support import PAPER_ASSOCIATION, PAPER_CLUSTERING, assert_close, assert_slopes, make_points, normal
from torch import Tensor

from torchcrf_scan import (
    ClusteringCRF,
    FeatureConfig,
    InferenceConfig,
    JointScanCRF,
    MatchingCRF,
    ModelConfig,
    PairPrediction,
    Scan,
    ScanPair,
    ScanPairBatch,
)
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start, beyond_reach
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS

ASSOCIATION = (
    *("dist1", "dist3", "dist5", "angle1", "angle3", "angle5", "geo1", "geo3", "geo5"),
    *("radius", "translation", "registered_translation", "data_boosting", "outlier_boosting"),
    *("sequence", "pairwise_outlier", "pairwise_distance", "pairwise_translation"),
)
CLUSTERING = (
    *("cluster_distance", "outlier", "cluster_inlier_in", "cluster_inlier_out", "sequence"),
    *("neighbour_weight_same", "neighbour_weight_different", "neighbour_stiffness_same", "neighbour_stiffness_different"),
    *("neighbour_distance_same", "neighbour_distance_different", "pairwise_outlier"),
)
ASSOCIATION_EXTENSION = ("excess", "gate", "outlier_bias", "outlier_seen_through", "outlier_hidden")
CLUSTERING_EXTENSION = (
    *("gate", "outlier_bias", "seen_through", "seen_through_back", "hidden", "hidden_back"),
    *("outlier_seen_through", "outlier_hidden", "reach"),
)
FREE_SPACE = ("seen_through", "hidden")  # all names of such weights have one of them
PAPER = FeatureConfig(free_space=False, decisions=False, reach="hard", left_out=())
EVERYTHING = FeatureConfig(left_out=(), reach="soft")
SOFT = {"motion_weights": "soft", "temperature": 1.0, "stop_early": False, "candidates": 0}
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3]], dtype=torch.float64)


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Three pairs of different sizes."""
    return [simulate_pairs(SimulatorConfig(beams=beams), 1, 1, seed)[0] for seed, beams in enumerate((61, 41, 51))]


def make_model(layer: type[JointScanCRF] = JointScanCRF, **inference: object) -> JointScanCRF:
    return layer(ModelConfig(inference=InferenceConfig(**inference)))  # type: ignore[arg-type]


@torch.no_grad()
def randomise(model: JointScanCRF) -> JointScanCRF:
    """Weights, boosters and scales that are not those of a new model."""
    for k, weight in enumerate(model.parameters()):
        weight.add_(0.1 * normal(1, seed=k)[0])
    for k, ensemble in enumerate((model.boosters.data, model.boosters.outlier)):
        features, stumps = ensemble.thresholds.shape
        numbers = normal(3, stumps, seed=k)
        ensemble.set_stumps(torch.arange(stumps) % features, -3 * numbers[0].abs(), 0.1 * numbers[1], 0.1 * numbers[2])
    model.scales.local.mul_(1.5)
    model.hypothesis_score.bias.add_(0.1)
    return model


def tiny(n: int = 10) -> tuple[ScanPairBatch, Start]:
    """One pair whose two halves move as MOTIONS says, with noise that is far from every kink."""
    source = make_points(n, 4)[None]
    cluster = (torch.arange(n) >= n // 2).long()
    target = se2.apply(MOTIONS[cluster], source[0, :, None])[None, :, 0] + 0.03 * normal(1, n, 2)
    batch = ScanPairBatch(
        source=source,
        target=target,
        source_mask=torch.ones(1, n, dtype=torch.bool),
        target_mask=torch.ones(1, n, dtype=torch.bool),
        source_closed=torch.zeros(1, dtype=torch.bool),
        target_closed=torch.zeros(1, dtype=torch.bool),
        dt=torch.full((1,), 0.1).double(),
        range_noise=torch.full((1,), 0.01).double(),
        initial_motion=torch.zeros(1, 3).double(),
    )
    tangents = torch.nn.functional.normalize(normal(1, n, 2, seed=8), dim=-1)
    return batch, Start(MOTIONS[None] + 0.02, torch.ones(1, 2, dtype=torch.bool), torch.arange(n)[None], tangents)


def assert_equal(found: PairPrediction, expected: PairPrediction) -> None:
    assert np.array_equal(found.association, expected.association)
    assert np.array_equal(found.cluster, expected.cluster)
    assert np.allclose(found.motions, expected.motions, atol=1e-4)
    assert np.allclose(found.association_confidence, expected.association_confidence, atol=1e-4)
    assert np.allclose(found.cluster_confidence, expected.cluster_confidence, atol=1e-4)
    assert found.converged == expected.converged


# --- weights ------------------------------------------------------------------------------------------------------------------


def test_thirty_named_weights_in_the_order_of_the_specification() -> None:
    model = JointScanCRF(ModelConfig(features=PAPER))
    assert tuple(ASSOCIATION_WEIGHTS[k] for k in PAPER_ASSOCIATION) == ASSOCIATION
    assert tuple(CLUSTERING_WEIGHTS[k] for k in PAPER_CLUSTERING) == CLUSTERING
    assert set(model.association_weights) == set(ASSOCIATION)
    assert set(model.clustering_weights) == set(CLUSTERING)
    assert (len(ASSOCIATION), len(CLUSTERING)) == (18, 12)
    assert len(list(model.parameters())) == 30
    assert all(weight.shape == () for weight in model.parameters())
    assert [len(vector) for vector in model.weight_vectors] == [23, 21]


def test_the_parameters_keep_the_papers_order() -> None:
    model = JointScanCRF(ModelConfig(features=PAPER))
    assert tuple(model.association_weights) == ASSOCIATION
    assert tuple(model.clustering_weights) == CLUSTERING


def test_fourteen_more_weights_stand_between_unary_and_pairwise_ones() -> None:
    model = JointScanCRF(ModelConfig(features=EVERYTHING))
    assert tuple(ASSOCIATION_WEIGHTS) == (*ASSOCIATION[:14], *ASSOCIATION_EXTENSION, *ASSOCIATION[14:])
    assert tuple(CLUSTERING_WEIGHTS) == (*CLUSTERING[:4], *CLUSTERING_EXTENSION, *CLUSTERING[4:])
    assert tuple(model.association_weights) == ASSOCIATION_WEIGHTS
    assert tuple(model.clustering_weights) == CLUSTERING_WEIGHTS
    assert len(list(model.parameters())) == 44


@pytest.mark.parametrize("free_space", [True, False])
@pytest.mark.parametrize("decisions", [True, False])
@pytest.mark.parametrize("reach", ["hard", "soft", "off"])
def test_each_group_of_extensions_has_a_switch(free_space: bool, decisions: bool, reach: str, tmp_path: Path) -> None:
    features = FeatureConfig(free_space=free_space, decisions=decisions, reach=reach, left_out=())
    model = randomise(JointScanCRF(ModelConfig(features=features)))
    has = {"beams": free_space, "reach": reach == "soft"}
    for names, paper, weights, vector in (
        (ASSOCIATION_WEIGHTS, ASSOCIATION, model.association_weights, model.weight_vectors[0]),
        (CLUSTERING_WEIGHTS, CLUSTERING, model.clustering_weights, model.weight_vectors[1]),
    ):
        group = {name: "beams" if any(part in name for part in FREE_SPACE) else name for name in names}
        own = [name for name in names if name in paper or has.get(group[name], decisions)]
        assert list(weights) == own
        assert [name for name, value in zip(names, vector.tolist(), strict=True) if value != 0] == own
    assert len(list(model.parameters())) == 30 + 5 * decisions + 8 * free_space + (reach == "soft")
    model.save_pretrained(tmp_path)
    again = JointScanCRF.from_pretrained(tmp_path)
    assert again.config == model.config
    assert again.state_dict().keys() == model.state_dict().keys()
    for found, expected in zip(again.weight_vectors, model.weight_vectors, strict=True):
        assert torch.equal(found, expected)


def test_without_extensions_their_weights_pass_no_gradient_and_change_nothing() -> None:
    small, large = (JointScanCRF(ModelConfig(features=features)).double() for features in (PAPER, EVERYTHING))
    with torch.no_grad():
        for name, weight in small.named_parameters():
            dict(large.named_parameters())[name].copy_(weight)
    batch, start = tiny()
    one, other = small(batch, start), large(batch, start)  # new extensions weigh nothing
    assert torch.equal(one.log_association, other.log_association)
    assert torch.equal(one.log_cluster, other.log_cluster)
    assert torch.equal(one.motions, other.motions)


@pytest.mark.parametrize("layer", [JointScanCRF, MatchingCRF, ClusteringCRF])
def test_weight_vectors_follow_the_names(layer: type[JointScanCRF]) -> None:
    model = layer(ModelConfig(features=EVERYTHING))
    with torch.no_grad():
        for k, weight in enumerate(model.parameters()):
            weight.fill_(k)
    numbered = dict(model.named_parameters())
    association, clustering = model.weight_vectors
    assert association.tolist() == [numbered[f"association_weights.{name}"].item() for name in ASSOCIATION_WEIGHTS]
    assert clustering.tolist() == [numbered[f"clustering_weights.{name}"].item() for name in CLUSTERING_WEIGHTS]


def test_the_literal_reading_switches_the_raw_channels_off() -> None:
    model = JointScanCRF(ModelConfig(features=replace(PAPER, raw_channels=False)))
    with torch.no_grad():
        for weight in model.parameters():
            weight.fill_(2.0)
    association, clustering = model.weight_vectors
    assert association[PAPER_ASSOCIATION].tolist() == [0.0] * 12 + [2.0] * 6
    assert clustering[PAPER_CLUSTERING].tolist() == [2.0] * 12
    assert sum(association.tolist() + clustering.tolist()) == 36.0  # the rest are 0
    association.sum().backward()
    assert [float(model.association_weights[name].grad) for name in ASSOCIATION] == [0.0] * 12 + [1.0] * 6


def test_reset_parameters_brings_the_first_weights_back() -> None:
    model = JointScanCRF()
    first = [weight.item() for weight in model.parameters()]
    randomise(model)
    model.reset_parameters()
    assert [weight.item() for weight in model.parameters()] == first
    assert any(first)


def test_layers_of_one_chain_say_so() -> None:
    assert MatchingCRF().config.chains == "matching"
    assert ClusteringCRF().config.chains == "clustering"
    assert "chains=matching" in repr(MatchingCRF())
    assert "candidates=dense" in repr(make_model(candidates=0))


@pytest.mark.parametrize(
    ("name", "value"),
    [("schedule", "fast"), ("flooding_order", "up"), ("motion_weights", "firm"), ("motion_metric", "plane"), ("clusters", 1)],
)
def test_wrong_settings_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected"):
        InferenceConfig(**{name: value})  # type: ignore[arg-type]


# --- saving -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layer", [JointScanCRF, MatchingCRF, ClusteringCRF])
def test_a_saved_model_answers_as_before(layer: type[JointScanCRF], pairs: list[ScanPair], tmp_path: Path) -> None:
    model = randomise(make_model(layer, clusters=4))
    model.save_pretrained(tmp_path / "model")
    again = JointScanCRF.from_pretrained(tmp_path / "model")
    assert again.config == model.config
    assert not again.training
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    for one, other in zip(model.match_pairs(pairs[:2]), again.match_pairs(pairs[:2]), strict=True):
        assert_equal(other, one)
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == ["config.json", "model.safetensors"]


def test_saving_twice_keeps_the_last(tmp_path: Path) -> None:
    JointScanCRF().save_pretrained(tmp_path)
    second = randomise(JointScanCRF())
    second.save_pretrained(tmp_path)
    assert_close(JointScanCRF.from_pretrained(tmp_path).weight_vectors[0].detach(), second.weight_vectors[0].detach())


def test_state_dict_round_trip() -> None:
    model = randomise(JointScanCRF())
    again = JointScanCRF()
    again.load_state_dict(model.state_dict())
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    buffers = {name.split(".")[0] for name, _ in model.named_buffers()}
    assert buffers == {"scales", "boosters", "hypothesis_score", "calibration", "cluster_potential"}


# --- answers ------------------------------------------------------------------------------------------------------------------


def test_one_pair_is_matched_like_many(pairs: list[ScanPair]) -> None:
    model = JointScanCRF()
    many = model.match_pairs(pairs)
    few = model.match_pairs(pairs, batch_size=2)
    for pair, expected, other in zip(pairs, many, few, strict=True):
        assert_equal(model.match(pair.source, pair.target, pair.dt), expected)
        assert_equal(other, expected)


def test_no_pair_has_no_answer() -> None:
    assert JointScanCRF().match_pairs([]) == []
    for wrong in (0, -1):
        with pytest.raises(TorchCRFScanError, match=f"batch_size: expected at least 1, got {wrong}"):
            JointScanCRF().match_pairs([], batch_size=wrong)


def test_answers_are_by_beam(pairs: list[ScanPair]) -> None:
    for pair, found in zip(pairs, JointScanCRF().match_pairs(pairs), strict=True):
        n = pair.source.n_beams
        for values in (found.association, found.cluster, found.association_confidence, found.cluster_confidence):
            assert values.shape == (n,)
        silent = np.setdiff1d(np.arange(n), pair.source.beam)
        assert (found.association[silent] == -1).all()
        assert (found.cluster[silent] == -1).all()
        partners = found.association[found.association >= 0]
        assert np.isin(partners, pair.target.beam).all()
        assert found.cluster.max() < len(found.motions)
        for confidence in (found.association_confidence, found.cluster_confidence):
            assert ((confidence >= 0) & (confidence <= 1 + 1e-6)).all()


def test_the_same_pair_has_the_same_answer(pairs: list[ScanPair]) -> None:
    model = JointScanCRF()
    first = model.match_pairs(pairs[:1])[0]
    torch.manual_seed(99)
    np.random.seed(99)
    second = JointScanCRF().match_pairs(pairs[:1])[0]
    assert np.array_equal(first.association, second.association)
    assert np.array_equal(first.cluster, second.cluster)
    assert np.array_equal(first.motions, second.motions)


def test_matching_draws_no_global_random_numbers(pairs: list[ScanPair]) -> None:
    before = torch.random.get_rng_state()
    JointScanCRF().match_pairs(pairs[:1])
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_double_model_gives_double_answers(pairs: list[ScanPair]) -> None:
    model = JointScanCRF().double()
    batch = ScanPairBatch.collate(pairs[:1], torch.float64)
    prediction = model(batch)
    for value in (prediction.motions, prediction.log_association, prediction.log_cluster):
        assert value.dtype == torch.float64
        assert not value.isnan().any()
    single, double = JointScanCRF().match_pairs(pairs[:1])[0], model.match_pairs(pairs[:1])[0]
    assert (single.association == double.association).mean() > 0.9
    assert np.allclose(single.motions[0], double.motions[0], atol=0.05)


def test_the_annotation_is_not_looked_at(pairs: list[ScanPair]) -> None:
    model = JointScanCRF()
    batch = ScanPairBatch.collate(pairs[:1])
    start = model.initialise(batch)
    with_truth, without = model(batch, start), model(batch.without_truth(), start)
    assert torch.equal(with_truth.association, without.association)
    assert torch.equal(model.initialise(batch.without_truth()).motions, start.motions)


@pytest.mark.parametrize("chains", ["joint", "matching", "clustering"])
@pytest.mark.parametrize("schedule", ["sweep", "flooding"])
def test_every_layer_and_schedule_answers_without_a_start(schedule: str, chains: str) -> None:
    bearings = np.linspace(-1.0, 1.0, 12)
    wall = Scan.from_ranges(3.0 / np.cos(bearings) + 0.3 * np.sin(9 * bearings), bearings)
    settings = InferenceConfig(schedule=schedule, clusters=3, iterations=2)
    found = JointScanCRF(ModelConfig(chains=chains, inference=settings)).match(wall, wall)
    assert np.isfinite(found.motions).all()
    assert np.abs(found.motions[0]).max() < 0.1


def test_a_still_scan_stays() -> None:
    bearings = np.linspace(-1.5, 1.5, 91)
    room = Scan.from_ranges(4.0 + np.sin(5 * bearings) + 0.5 * np.cos(11 * bearings), bearings)
    found = JointScanCRF().match(room, room)
    assert found.association.tolist() == list(range(91))
    assert (found.cluster == 0).all()
    assert np.abs(found.motions).max() < 1e-3
    assert found.converged


# --- gradients ----------------------------------------------------------------------------------------------------------------


def soft_model(metric: str, iterations: int = 2, **features: bool) -> JointScanCRF:
    """Every feature but those named; lengths in metres, as no gradient passes through the choice of a unit."""
    settings = InferenceConfig(clusters=3, iterations=iterations, motion_metric=metric, min_extent=0.0, **SOFT)  # type: ignore[arg-type]
    own = replace(EVERYTHING, length_unit="metre", **features)
    model = JointScanCRF(ModelConfig(features=own, inference=settings)).double()
    model.scales.local.fill_(2.0)  # no error is capped
    model.scales.pairwise.fill_(2.0)
    for name in ("cluster_distance", "neighbour_distance", "neighbour_weight"):
        getattr(model.scales, name).fill_(2.0)
    with torch.no_grad():
        for k, weight in enumerate(model.parameters()):
            weight.copy_(0.3 + 0.1 * normal(1, seed=k)[0])
    return model


def total(log_beliefs: Tensor) -> Tensor:
    """Sum of what is possible."""
    return log_beliefs[log_beliefs > -torch.inf].sum()


@pytest.mark.parametrize("metric", ["point", "line"])
@pytest.mark.parametrize("what", ["log_association", "log_cluster", "motions"])
def test_gradients_reach_weights_and_points(what: str, metric: str) -> None:
    batch, start = tiny()
    source, target = batch.source.clone().requires_grad_(), batch.target.clone().requires_grad_()
    model = soft_model(metric)
    halves = (torch.arange(10) >= 5) == torch.tensor([[False], [True]])
    start = replace(start, reach=beyond_reach(source, halves[None], torch.tensor([0.05]).double()))
    found = getattr(model(replace(batch, source=source, target=target), start), what)
    value = total(found) if what != "motions" else (found * torch.tensor([3.0, 1.0, 2.0])).sum()
    value.backward()
    for points in (source, target):
        assert points.grad is not None
        assert points.grad.isfinite().all()
        assert (points.grad.abs().sum(-1) > 0).all()
    slopes = {name: weight.grad for name, weight in model.named_parameters()}
    assert all(slope is not None and bool(slope.isfinite()) for slope in slopes.values())
    silent = {name for name, slope in slopes.items() if float(slope.abs()) == 0}  # type: ignore[union-attr]
    boosted = {"association_weights.data_boosting", "association_weights.outlier_boosting"}  # nothing is boosted yet
    threshold = {"clustering_weights.outlier"}  # every point is explained
    both = {"clustering_weights.cluster_inlier_out"}  # none is an outlier
    unseen = {name for name in slopes if any(part in name for part in FREE_SPACE)}  # no point is in front of a beam or behind it
    assert silent - unseen <= boosted | threshold | both


def test_gradients_of_padded_simulated_pairs_are_finite(pairs: list[ScanPair]) -> None:
    model = make_model(**(SOFT | {"candidates": 8, "iterations": 3}))
    batch = ScanPairBatch.collate(pairs)
    start = model.initialise(batch)
    source = batch.source.clone().requires_grad_()
    found = model(replace(batch, source=source), start)
    value = total(found.log_association[batch.source_mask]) + total(found.log_cluster[batch.source_mask]) + found.motions.sum()
    value.backward()
    assert source.grad is not None
    assert source.grad.isfinite().all()
    assert (source.grad[~batch.source_mask] == 0).all()
    assert all(weight.grad is not None and bool(weight.grad.isfinite()) for weight in model.parameters())


def test_a_missing_slope_is_noticed() -> None:
    values = normal(3)
    assert_slopes(lambda x: (x.square(), x.prod()), values)
    with pytest.raises(AssertionError, match="not close"):
        assert_slopes(lambda x: (x.square(), x.prod() + 0.01 * x.detach()[0]), values)


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # `vmap` has no clamp_ of its own
@pytest.mark.parametrize("metric", ["point", "line"])
def test_gradcheck_of_the_unrolled_rounds_in_the_weights(metric: str) -> None:
    batch, start = tiny(6)
    start = replace(start, reach=(4 * normal(1, 6, 2, seed=5)).clamp(0, 3))
    model = soft_model(metric)
    names = [name for name, _ in model.named_parameters()]

    def answers(values: Tensor) -> tuple[Tensor, ...]:
        weights = dict(zip(names, values.unbind(), strict=True))
        found = torch.func.functional_call(model, weights, (batch, start))
        return found.log_association.exp(), found.log_cluster.exp(), found.motions

    assert_slopes(answers, torch.stack([weight.detach() for weight in model.parameters()]))


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # `vmap` has no clamp_ of its own
@pytest.mark.parametrize("metric", ["point", "line"])
def test_gradcheck_of_the_unrolled_rounds_in_the_points(metric: str) -> None:
    batch, start = tiny(6)
    model = soft_model(metric, free_space=False)  # no gradient passes through what the beams say

    def answers(source: Tensor, target: Tensor) -> tuple[Tensor, ...]:
        halves = (torch.arange(6) >= 3) == torch.tensor([[False], [True]])
        begun = replace(start, reach=beyond_reach(source, halves[None], torch.tensor([0.05]).double()))
        found = model(replace(batch, source=source, target=target), begun)
        return found.log_association.exp(), found.log_cluster.exp(), found.motions

    assert_slopes(answers, batch.source, batch.target)


def test_hard_labels_pass_no_gradient_to_the_weights() -> None:
    batch, start = tiny()
    found = make_model(clusters=3, motion_metric="point").double()(batch, start)
    assert found.log_cluster.requires_grad
    assert not found.motions.requires_grad
