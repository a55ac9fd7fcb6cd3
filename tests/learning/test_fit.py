"""Fitting a model: folds that keep sequences whole, boosters that have not seen their pairs, better weights than before."""

import copy
from dataclasses import replace

import pytest
import torch
from support import PAPER_ASSOCIATION, PAPER_CLUSTERING

from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.inference.pseudo_likelihood import pseudo_log_likelihood
from torchcrf_scan.learning.fit import fit, fit_all_boosters, prepare, set_weights
from torchcrf_scan.learning.material import Material, collect
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import ClusteringCRF, JointScanCRF, MatchingCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, FREE_SPACE_WEIGHTS, LOCAL_CHANNELS
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.score import HypothesisScore

LEARNING = LearningConfig(folds=2, negatives=3, batch_size=2)
MODEL = ModelConfig(features=FeatureConfig(stumps=15), inference=InferenceConfig(clusters=6))


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    return simulate_pairs(SimulatorConfig(beams=91), 6, 3, 4)


@pytest.fixture(scope="module")
def material(pairs: list[ScanPair]) -> list[Material]:
    return collect(pairs, LEARNING).material(range(len(pairs)), HypothesisScore(), 5, LEARNING)


@pytest.fixture(scope="module")
def fitted(material: list[Material]) -> JointScanCRF:
    model = JointScanCRF(MODEL)
    fit(model, material, LEARNING)
    return model


def test_a_folds_boosters_have_not_seen_it(material: list[Material]) -> None:
    model = JointScanCRF(MODEL)
    generator = torch.Generator().manual_seed(0)
    lessons = [prepare(model, part, LEARNING, generator) for part in material]
    margins = fit_all_boosters(model, lessons, LEARNING, torch.Generator().manual_seed(0))
    assert sorted(margins) == [0, 1]
    tables = [boosters.data.table for boosters in (margins[0], margins[1], model.boosters)]
    assert not torch.equal(tables[0], tables[1])
    assert not torch.equal(tables[0], tables[2])
    others = [replace(lesson, fold=1) if lesson.fold == 1 else lesson for lesson in lessons if lesson.fold == 1]
    alone = fit_all_boosters(JointScanCRF(MODEL), others, LEARNING, torch.Generator().manual_seed(5))
    assert list(alone) == [1]  # one fold alone has nothing to be kept from


def test_one_fold_uses_the_same_boosters(material: list[Material]) -> None:
    model = JointScanCRF(MODEL)
    lessons = [prepare(model, replace(part, fold=0), LEARNING, torch.Generator().manual_seed(0)) for part in material[:1]]
    margins = fit_all_boosters(model, lessons, LEARNING, torch.Generator().manual_seed(0))
    assert list(margins) == [0]
    assert torch.equal(margins[0].data.table, model.boosters.data.table)


def test_everything_is_fitted(fitted: JointScanCRF) -> None:
    fresh = JointScanCRF(MODEL)
    for name, value in fitted.state_dict().items():
        assert value.isfinite().all() or name.endswith("thresholds"), name
    for name in ("boosters.data.table", "boosters.outlier.table", "scales.local", "scales.local_outlier", "scales.pairwise"):
        assert not torch.equal(fitted.state_dict()[name], fresh.state_dict()[name]), name
    for one, other in zip(fitted.weight_vectors, fresh.weight_vectors, strict=True):
        assert (one != other).float().mean() > 0.8


def test_the_fit_explains_what_it_has_seen_better(fitted: JointScanCRF, material: list[Material]) -> None:
    before = copy.deepcopy(fitted)
    before.reset_parameters()
    generator = torch.Generator().manual_seed(LEARNING.seed)
    lessons = [prepare(fitted, part, LEARNING, generator) for part in material]
    for chains in ("matching", "clustering"):
        config = replace(MODEL, chains=chains)
        with torch.no_grad():
            old, new = (
                sum(float(pseudo_log_likelihood(lesson.view, lesson.plugins, model.fitted, config).sum()) for lesson in lessons)
                for model in (before, fitted)
            )
        assert new > 0.8 * old, chains  # both are negative


def test_a_fit_can_be_repeated(fitted: JointScanCRF, material: list[Material]) -> None:
    again = JointScanCRF(MODEL)
    torch.manual_seed(321)
    fit(again, material, LEARNING)
    for name, value in fitted.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


@pytest.mark.parametrize("layer", [MatchingCRF, ClusteringCRF])
def test_one_chain_alone_is_fitted_alone(layer: type[JointScanCRF], material: list[Material]) -> None:
    model, fresh = layer(MODEL), layer(MODEL)
    seen: dict[str, int] = {}

    def watch(chain: str) -> None:
        seen[chain] = seen.get(chain, 0) + 1

    callbacks = {chain: lambda *_, chain=chain: watch(chain) for chain in ("association", "clustering")}
    fit(model, material[:2], LEARNING, callbacks)
    own, other = ("association", "clustering") if layer is MatchingCRF else ("clustering", "association")
    assert list(seen) == [own]
    for name, weight in getattr(fresh, f"{other}_weights").items():
        assert torch.equal(getattr(model, f"{other}_weights")[name], weight), name
    assert any(not torch.equal(getattr(model, f"{own}_weights")[name], w) for name, w in getattr(fresh, f"{own}_weights").items())


def test_the_literal_reading_learns_no_raw_weight(material: list[Material]) -> None:
    model = MatchingCRF(replace(MODEL, features=FeatureConfig(raw_channels=False, stumps=10)))
    fit(model, material[:2], LEARNING)
    learned = model.weight_vectors[0].detach()
    assert (learned[: len(LOCAL_CHANNELS)] == 0).all()
    assert (learned[len(LOCAL_CHANNELS) :] != 0).any()
    assert all(model.association_weights[name].item() == 0 for name in LOCAL_CHANNELS)


@pytest.mark.parametrize("objective", ["pseudo_likelihood", "likelihood"])
@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_the_weight_of_the_reach_is_learned(objective: str, coupling: str, material: list[Material]) -> None:
    learning = replace(LEARNING, objective=objective, max_steps=8)
    weights = {}
    for reach in ("soft", "hard", "off"):
        features = FeatureConfig(stumps=4, reach=reach)
        model = JointScanCRF(replace(MODEL, coupling=coupling, features=features))
        fit(model, material[:1], learning)
        weights[reach] = model.weight_vectors[1]
    place = CLUSTERING_WEIGHTS.index("reach")
    assert weights["soft"][place] > 0.1
    assert weights["hard"][place] == weights["off"][place] == 0
    assert not torch.equal(weights["hard"], weights["off"])


def test_set_weights_follows_the_names() -> None:
    model = JointScanCRF(ModelConfig(features=FeatureConfig(reach="soft")))
    set_weights(model, "association", torch.arange(23.0))
    set_weights(model, "clustering", torch.arange(21.0))
    assert [model.association_weights[name].item() for name in ASSOCIATION_WEIGHTS] == list(range(23))
    assert [model.clustering_weights[name].item() for name in CLUSTERING_WEIGHTS] == list(range(21))
    with pytest.raises(ValueError, match="zip"):
        set_weights(model, "clustering", torch.arange(23.0))


def test_set_weights_passes_over_what_the_model_does_not_have() -> None:
    model = JointScanCRF(ModelConfig(features=FeatureConfig(free_space=False, decisions=False, reach="hard", left_out=())))
    set_weights(model, "association", torch.arange(23.0))
    set_weights(model, "clustering", torch.arange(21.0))
    assert [weight.item() for weight in model.parameters()] == [*PAPER_ASSOCIATION, *PAPER_CLUSTERING]


@pytest.mark.parametrize("layer", [MatchingCRF, ClusteringCRF])
def test_what_is_left_out_is_not_learned(layer: type[JointScanCRF], material: list[Material]) -> None:
    left_out = (
        "association.geo1",
        "association.sequence",
        "association.data_boosting",
        "clustering.outlier",
        "clustering.sequence",
    )
    model = layer(replace(MODEL, features=FeatureConfig(stumps=10, free_space=False, left_out=left_out)))
    fit(model, material[:2], LEARNING)
    chain, names = ("association", ASSOCIATION_WEIGHTS) if layer is MatchingCRF else ("clustering", CLUSTERING_WEIGHTS)
    learned = dict(zip(names, model.weight_vectors[chain == "clustering"].tolist(), strict=True))
    assert {f"{chain}.{name}" for name, value in learned.items() if value == 0} == {
        name for name in (*left_out, *FREE_SPACE_WEIGHTS, "clustering.reach") if name.startswith(chain)
    }
    inputs = -9 * torch.rand(100, len(LOCAL_CHANNELS))
    changed = inputs.clone()
    changed[:, LOCAL_CHANNELS.index("geo1")] = 0.0
    assert torch.equal(model.boosters.data(inputs), model.boosters.data(changed))


def test_a_lattice_does_not_learn_what_is_left_out(material: list[Material]) -> None:
    left_out = ("association.translation", "clustering.pairwise_outlier")
    model = JointScanCRF(replace(MODEL, coupling="lattice", features=FeatureConfig(stumps=4, left_out=left_out)))
    fit(model, material[:1], replace(LEARNING, max_steps=4))
    dead = [
        [name for name, value in zip(names, weights.tolist(), strict=True) if value == 0]
        for names, weights in zip((ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS), model.weight_vectors, strict=True)
    ]
    assert dead == [["translation"], ["reach", "pairwise_outlier"]]
