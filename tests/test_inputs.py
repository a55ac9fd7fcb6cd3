"""Tensors that do not fit are refused by name, wherever the model is given them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from scenes import MOTIONS, make_batch, make_start
from support import make_points, normal
from torch import Tensor

from torchcrf_scan import ExtraLogUnary, FeatureConfig, JointScanCRF, ModelConfig
from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.inference.pseudo_likelihood import PlugIns, true_plugins
from torchcrf_scan.inference.start import Start

N, M = 7, 6


def annotated() -> ScanPairBatch:
    batch = make_batch(make_points(N)[None], make_points(M, 1)[None])
    truth = Truth(torch.arange(N)[None] % M, torch.zeros(1, N, dtype=torch.int64), MOTIONS[None, :1], torch.ones(1, N).bool())
    return replace(batch, truth=truth)


def full_start(batch: ScanPairBatch) -> Start:
    start = make_start(batch, MOTIONS[:2])
    return replace(start, reach=torch.zeros(1, N, 2).double(), log_odds=torch.zeros(1, 2).double())


def given() -> dict[str, Any]:
    """Everything that the model can be given, all of it fitting."""
    batch = annotated()
    return {
        "batch": batch,
        "start": full_start(batch),
        "source_embedding": normal(1, N, 3),
        "target_embedding": normal(1, M, 3),
        "extra_log_unary": ExtraLogUnary(normal(1, N), normal(1, N)),
    }


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF(ModelConfig(features=FeatureConfig(embedding="dot"))).double()


def longer(value: Tensor) -> Tensor:
    return torch.cat([value, value], dim=-1)


def flat(value: Tensor) -> Tensor:
    return value[..., None]


def other_dtype(value: Tensor) -> Tensor:
    return value.float() if value.dtype == torch.float64 else value.to(torch.int16)


def elsewhere(value: Tensor) -> Tensor:
    return value.to("meta")


def spoilt(everything: dict[str, Any], path: str, change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """The same with one tensor changed. path: as in the message, e.g. `batch.truth.known`."""

    def at(owner: Any, names: list[str]) -> Any:
        return change(owner) if not names else replace(owner, **{names[0]: at(getattr(owner, names[0]), names[1:])})

    first, *rest = path.split(".")
    return everything | {first: at(everything[first], rest)}


BATCH = (
    *("source", "target", "source_mask", "target_mask", "source_closed", "target_closed", "dt", "range_noise"),
    *("initial_motion", "target_origin", "truth.association", "truth.cluster", "truth.motions", "truth.known"),
)
START = ("motions", "active", "association", "target_tangents", "reach", "log_odds")
PATHS = (
    *(f"batch.{name}" for name in BATCH),
    *(f"start.{name}" for name in START),
    *("source_embedding", "target_embedding", "extra_log_unary.outlier", "extra_log_unary.moving"),
)
CHANGES = [(other_dtype, "dtype"), (elsewhere, "device"), (flat, "shape")]


def call(model: JointScanCRF, method: str, everything: dict[str, Any]) -> Tensor:
    batch, *_ = (everything.pop("batch"),)
    found = getattr(model, method)(batch, **everything)
    return found if isinstance(found, Tensor) else found.log_cluster


@pytest.mark.parametrize("method", ["forward", "pseudo_log_likelihood"])
def test_what_fits_is_taken(model: JointScanCRF, method: str) -> None:
    assert call(model, method, given()).shape[0] == 1


@pytest.mark.parametrize(("change", "what"), CHANGES)
@pytest.mark.parametrize("path", PATHS)
def test_what_does_not_fit_is_named(model: JointScanCRF, path: str, change: Callable[[Tensor], Tensor], what: str) -> None:
    for method in ("forward", "pseudo_log_likelihood"):
        with pytest.raises(ValueError, match=rf"^{path}: expected {what} .*, got "):
            call(model, method, spoilt(given(), path, change))


@pytest.mark.parametrize("path", [path for path in PATHS if path not in ("batch.source", "batch.target", "target_embedding")])
def test_sizes_are_compared(model: JointScanCRF, path: str) -> None:
    named = "target_embedding: expected both" if path == "source_embedding" else f"{path}: expected shape"
    if path in ("start.motions", "batch.truth.motions"):
        named = f"{path}: expected shape .*3\\), got"
    with pytest.raises(ValueError, match=rf"^{named}"):
        call(model, "forward", spoilt(given(), path, longer))


@pytest.mark.parametrize(("change", "what"), CHANGES)
@pytest.mark.parametrize("name", ["motions", "active", "association", "cluster", "label", "known"])
def test_plugins_that_do_not_fit_are_named(model: JointScanCRF, name: str, change: Callable[[Tensor], Tensor], what: str) -> None:
    plugins: PlugIns = true_plugins(annotated(), 2)
    with pytest.raises(ValueError, match=rf"^plugins\.{name}: expected {what} .*, got "):
        model.pseudo_log_likelihood(annotated(), replace(plugins, **{name: change(getattr(plugins, name))}))


def test_a_search_takes_the_models_kind_of_batch_alone(model: JointScanCRF) -> None:
    with pytest.raises(ValueError, match=r"batch\.source: expected dtype torch\.float64, got torch\.float32"):
        model.initialise(annotated().to(torch.float32))


def test_under_autocast_a_network_may_give_what_it_calculates_in() -> None:
    model, everything = JointScanCRF(ModelConfig(features=FeatureConfig(embedding="dot"))), given()
    batch, start = everything["batch"].to(torch.float32), everything["start"]
    start = replace(start, **{name: getattr(start, name).float() for name in ("motions", "target_tangents", "reach", "log_odds")})
    half = {name: everything[name].bfloat16() for name in ("source_embedding", "target_embedding")}
    with torch.autocast("cpu", torch.bfloat16):
        assert model(batch, start, **half).log_association.dtype == torch.float32
    with pytest.raises(ValueError, match=r"^source_embedding: expected dtype torch\.float32, got torch\.bfloat16"):
        model(batch, start, **half)
