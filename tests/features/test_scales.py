"""Which weights a model has."""

import itertools

import pytest
import torch

from torchcrf_scan.config import FeatureConfig
from torchcrf_scan.features.scales import live_weights
from torchcrf_scan.model import JointScanCRF, ModelConfig
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, LOCAL_CHANNELS

EVERY = [*(f"association.{name}" for name in ASSOCIATION_WEIGHTS), *(f"clustering.{name}" for name in CLUSTERING_WEIGHTS)]


def dead(config: FeatureConfig) -> set[str]:
    return {name for name, is_live in zip(EVERY, torch.cat(live_weights(config)).tolist(), strict=True) if not is_live}


@pytest.mark.parametrize(
    "left_out", [(), *itertools.combinations(EVERY[::4], 2), ("association.sequence",), ("clustering.sequence",)]
)
def test_what_is_left_out_is_dead_and_nothing_else(left_out: tuple[str, ...]) -> None:
    raw = {f"association.{name}" for name in LOCAL_CHANNELS}
    assert dead(FeatureConfig(left_out=left_out, reach="soft")) == set(left_out)
    assert dead(FeatureConfig(left_out=left_out, reach="soft", raw_channels=False)) == set(left_out) | raw
    for reach in ("hard", "off"):
        assert dead(FeatureConfig(left_out=left_out, reach=reach)) == {*left_out, "clustering.reach"}


def test_the_model_has_no_dead_weight_whatever_its_parameters_say() -> None:
    model = JointScanCRF(ModelConfig(features=FeatureConfig(left_out=("association.geo1", "clustering.outlier"), reach="soft")))
    with torch.no_grad():
        for weight in model.parameters():
            weight.fill_(2.0)
    association, clustering = model.weight_vectors
    assert {name for name, value in zip(ASSOCIATION_WEIGHTS, association, strict=True) if value == 0} == {"geo1"}
    assert {name for name, value in zip(CLUSTERING_WEIGHTS, clustering, strict=True) if value == 0} == {"outlier"}
