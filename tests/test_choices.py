"""Every variant can do what its line in `choices` declares, and nothing that it denies."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from torchcrf_scan import ExtraLogUnary, FeatureConfig, InferenceConfig, JointScanCRF, ModelConfig, Prediction, ScanPairBatch
from torchcrf_scan.choices import MOTION_METRICS, OF_INFERENCE, OF_MODEL, OF_ROUNDS, STARTS, Variant, load, with_ability
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.export import OUTPUTS, UnrolledDecoder, decoder_inputs, unrolled_config
from torchcrf_scan.fast.choice import can_decode
from torchcrf_scan.fast.motion import METRICS
from torchcrf_scan.inference.motion import FITS
from torchcrf_scan.inference.start import Start

EVERY = {**OF_INFERENCE, **OF_MODEL}
VARIANTS = [(setting, name) for setting, register in EVERY.items() for name in register]
OF_THE_ROUNDS = [(setting, name) for setting, register in OF_ROUNDS.items() for name in register]
CLUSTERS, POINTS, CHANNELS = 3, 12, 4


def variant_of(setting: str, name: str) -> Variant:
    return EVERY[setting][name]


def config_of(setting: str, name: str, **inference: object) -> ModelConfig:
    """The default model with one choice changed, few clusters and one round."""
    settings = {"clusters": CLUSTERS, "candidates": 3, "iterations": 1, "backend": "eager"} | inference
    if setting in OF_INFERENCE:
        settings[setting] = name
    features = FeatureConfig(stumps=2, embedding="dot")
    config = ModelConfig(features=features, inference=InferenceConfig(**settings))  # type: ignore[arg-type]
    return config if setting in OF_INFERENCE else replace(config, **{setting: name})  # type: ignore[arg-type]


@cache
def scene(points: int = POINTS) -> ScanPairBatch:
    """The first points of a coarse pair of a street."""
    whole = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=41), 1, 1, 3)).without_truth()
    cut = {name: getattr(whole, name)[:, :points] for name in ("source", "target", "source_mask", "target_mask")}
    return replace(whole, **cut)


def start_of(batch: ScanPairBatch, config: ModelConfig) -> Start:
    """Standstill, and a mover that goes elsewhere."""
    motions = torch.zeros(len(batch), config.motions, 3)
    motions[:, 1:, 1] = 0.5
    return Start.at(batch, motions, torch.ones(len(batch), config.motions, dtype=torch.bool))


def own_beliefs(config: ModelConfig, found: Prediction) -> torch.Tensor:
    """The possible log-beliefs of the chains that the model has."""
    chains = [found.log_association] * config.has_association + [found.log_cluster] * config.has_clusters
    return torch.cat([chain[chain > -20.0] for chain in chains])


@pytest.mark.parametrize(("setting", "name"), VARIANTS)
def test_a_name_that_is_declared_can_be_chosen(setting: str, name: str) -> None:
    config = config_of(setting, name)
    assert getattr(config.inference if setting in OF_INFERENCE else config, setting) == name
    function = variant_of(setting, name).function
    assert not function or callable(load(function))


@pytest.mark.parametrize("setting", EVERY)
def test_another_name_is_refused(setting: str) -> None:
    with pytest.raises(ValueError, match=f"^{setting}: expected one of {', '.join(EVERY[setting])}, got nothing$"):
        config_of(setting, "nothing")


@pytest.mark.parametrize(("setting", "name"), VARIANTS)
def test_gradients_reach_the_weights_where_declared(setting: str, name: str) -> None:
    config, batch = config_of(setting, name), scene()
    model = JointScanCRF(config)
    found = model(batch, model.initialise(batch) if setting == "start" else start_of(batch, config))
    beliefs = own_beliefs(config, found)
    assert beliefs.requires_grad == variant_of(setting, name).has_gradient
    if variant_of(setting, name).has_gradient:
        beliefs.sum().backward()
        some = model.association_weights if config.has_association else model.clustering_weights
        assert sum(float(weight.grad.abs()) for weight in some.values() if weight.grad is not None) > 0


@pytest.mark.parametrize(("setting", "name"), VARIANTS)
@torch.no_grad()
def test_extra_inputs_change_the_beliefs_where_declared(setting: str, name: str) -> None:
    config, batch = config_of(setting, name), scene()
    model, start = JointScanCRF(config), start_of(batch, config)
    outlier = torch.linspace(-2.0, 2.0, POINTS)[None]
    embeddings = {f"{side}_embedding": torch.eye(POINTS, CHANNELS)[None] * 9 for side in ("source", "target")}
    for given in ({"extra_log_unary": ExtraLogUnary(outlier)}, embeddings if config.has_association else {}):
        if not given:
            continue
        if not variant_of(setting, name).takes_extras:
            able = " or ".join(with_ability(EVERY[setting], "takes_extras"))
            with pytest.raises(ValueError, match=f"^{setting}: expected {able} with embeddings or extra_log_unary, got {name}$"):
                model(batch, start, **given)  # type: ignore[arg-type]
            continue
        plain, informed = model(batch, start), model(batch, start, **given)  # type: ignore[arg-type]
        chain = "log_association" if config.has_association else "log_cluster"
        assert not torch.equal(getattr(plain, chain), getattr(informed, chain))


@pytest.mark.parametrize(("setting", "name"), OF_THE_ROUNDS)
def test_loops_take_a_model_where_declared(setting: str, name: str) -> None:
    config, batch = config_of(setting, name, backend="auto", iterations=2), scene()
    is_there = variant_of(setting, name).in_loops
    assert can_decode(config, torch.device("cpu")) == is_there
    compiled = replace(config, inference=replace(config.inference, backend="compiled"))
    with torch.no_grad():
        if not is_there:
            with pytest.raises(ValueError, match=f"^backend: expected for compiled settings that it knows, got {setting}: {name}$"):
                JointScanCRF(compiled)(batch, start_of(batch, config))
            return
        by_loops = JointScanCRF(compiled)(batch, start_of(batch, config))
        by_tensors = JointScanCRF(config_of(setting, name, iterations=2))(batch, start_of(batch, config))
    assert torch.equal(by_loops.association, by_tensors.association)
    assert torch.equal(by_loops.cluster, by_tensors.cluster)


@pytest.mark.parametrize(("setting", "name"), OF_THE_ROUNDS)
def test_rounds_are_exported_where_declared(setting: str, name: str) -> None:
    config = config_of(setting, name)
    variant = variant_of(setting, name)
    if not variant.is_exportable:
        able = " or ".join(with_ability(EVERY[setting], "is_exportable"))
        with pytest.raises(ValueError, match=f"^{setting}: expected {able} for a model to export, got {name}$"):
            unrolled_config(config)
        return
    batch = scene(4)
    start = start_of(batch, config)
    decoder = UnrolledDecoder(JointScanCRF(config), plain=True)
    inputs = decoder_inputs(batch, start)
    with torch.no_grad():
        found, expected = decoder(**inputs), decoder.model(batch, start)
        shapes = decoder.to("meta")(**{key: value.to("meta") for key, value in inputs.items()})  # no step may ask for a value
    for output in OUTPUTS:
        assert torch.allclose(found[output], getattr(expected, output), atol=1e-5), output
        assert shapes[output].shape == found[output].shape, output


@pytest.mark.parametrize("name", STARTS)
def test_a_start_has_every_motion_that_the_model_wants(name: str) -> None:
    config = config_of("start", name)
    found = JointScanCRF(config).initialise(scene())
    assert found.motions.shape == (1, config.motions, 3)
    assert bool(found.motions.isfinite().all())
    assert bool(found.active[:, 0].all())


def test_every_metric_is_fitted_where_it_says_so() -> None:
    assert set(FITS) == {name for name, metric in MOTION_METRICS.items() if metric.is_fitted}
    assert set(METRICS) == set(with_ability(MOTION_METRICS, "in_loops"))
