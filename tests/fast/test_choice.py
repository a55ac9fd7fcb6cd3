"""Which engine runs the rounds: loops where they know the settings and no gradient is asked for, or the reason why not."""

from dataclasses import replace

import pytest
import torch

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.fast.choice import can_decode, can_run

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (ModelConfig(inference=InferenceConfig(schedule="flooding", backend="compiled")), "schedule: flooding"),
        (ModelConfig(inference=InferenceConfig(temperature=1.0, backend="compiled")), "temperature: 1.0"),
        (ModelConfig(coupling="lattice", inference=InferenceConfig(backend="compiled")), "coupling: lattice"),
        (ModelConfig(chains="matching", inference=InferenceConfig(backend="compiled")), "chains: matching"),
    ],
)
def test_what_is_not_compiled_is_said(config: ModelConfig, reason: str) -> None:
    with pytest.raises(ValueError, match=f"backend: expected for compiled .*{reason}"):
        can_decode(config, CPU)
    automatic = replace(config, inference=replace(config.inference, backend="auto"))
    assert not can_decode(automatic, CPU)


def test_loops_run_where_points_are_on_the_cpu_and_nothing_else_is_asked_for() -> None:
    elsewhere = torch.device("meta")
    assert [can_run(backend, CPU) for backend in ("auto", "compiled", "eager")] == [True, True, False]
    assert not can_run("auto", elsewhere)
    with pytest.raises(ValueError, match="backend: expected for compiled scans on the CPU, got meta"):
        can_run("compiled", elsewhere)
    assert can_decode(ModelConfig(), CPU)
    assert not can_decode(ModelConfig(inference=InferenceConfig(backend="eager")), CPU)
    assert not can_decode(ModelConfig(), elsewhere)
    with pytest.raises(ValueError, match="no embeddings"):
        can_decode(ModelConfig(inference=InferenceConfig(backend="compiled")), CPU, has_embeddings=True)


def test_what_has_a_gradient_beside_weights_needs_tensors() -> None:
    assert not can_decode(ModelConfig(), CPU, slopes=["batch.source"])
    compiled = ModelConfig(inference=InferenceConfig(backend="compiled"))
    with pytest.raises(ValueError, match=r"no gradient to be asked for by batch\.source"):
        can_decode(compiled, CPU, slopes=["batch.source"])
    assert not can_decode(ModelConfig(), CPU, is_transformed=True)
    with pytest.raises(ValueError, match=r"no call inside a transform of torch\.func"):
        can_decode(compiled, CPU, is_transformed=True)
