"""The rounds in tensors on any device: fake tensors of another device refuse to be mixed with others and to be read."""

from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from support import assert_close
from torch import Tensor
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode, unset_fake_temporarily

from torchcrf_scan import ExtraLogUnary, JointScanCRF, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.inference.start import Start

ELSEWHERE = torch.device("meta")  # a device without values, so that a test needs none with


def annotated() -> ScanPairBatch:
    return ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=16), 2, 1, 0))


def moved(mode: FakeTensorMode, given: Any) -> Any:
    """The same with fake tensors of the other device."""
    if isinstance(given, Tensor):
        with unset_fake_temporarily():
            there = given.detach().to(ELSEWHERE)
        return mode.from_tensor(there)
    if hasattr(given, "__dataclass_fields__"):
        return replace(given, **{f.name: moved(mode, getattr(given, f.name)) for f in fields(given)})
    return given


class Likelihood(torch.nn.Module):
    """The pseudo-likelihood as the call of a module."""

    def __init__(self, model: JointScanCRF) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: ScanPairBatch) -> Tensor:
        return self.model.pseudo_log_likelihood(batch)


def elsewhere(mode: FakeTensorMode, module: torch.nn.Module) -> dict[str, Tensor]:
    """Parameters, with gradients, and buffers of a module on the other device."""
    wanted = {name for name, _ in module.named_parameters()}
    return {name: moved(mode, of).requires_grad_(name in wanted) for name, of in module.state_dict(keep_vars=True).items()}


@pytest.mark.parametrize("settings", [{}, {"motion_weights": "soft", "motion_metric": "point"}, {"temperature": 1.0}], ids=str)
def test_rounds_mix_no_devices_and_read_no_value(settings: dict[str, Any]) -> None:
    batch = annotated().without_truth()
    model = JointScanCRF.from_pretrained(stop_early=False, iterations=1, clusters=4, **settings)
    start: Start = model.initialise(batch)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        state = elsewhere(mode, model)
        some = moved(mode, torch.zeros_like(batch.source[..., 0]))
        arguments = moved(mode, batch), moved(mode, start)
        answer = torch.func.functional_call(model, state, arguments, {"extra_log_unary": ExtraLogUnary(some, some)})
        assert answer.motions.device == answer.log_cluster.device == answer.association.device == ELSEWHERE
        assert answer.log_association.shape == (*batch.source.shape[:2], 9)
        slopes = torch.autograd.grad(answer.log_cluster.sum() + answer.log_association.sum(), state["clustering_weights.sequence"])
        assert slopes[0].device == ELSEWHERE


def test_the_pseudo_likelihood_mixes_no_devices_and_reads_no_value() -> None:
    batch, module = annotated(), Likelihood(JointScanCRF.from_pretrained("simulated"))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        state = elsewhere(mode, module)
        found = torch.func.functional_call(module, state, (moved(mode, batch),))
        assert found.shape == (2,)
        assert torch.autograd.grad(found.sum(), state["model.association_weights.sequence"])[0].device == ELSEWHERE


def test_a_value_that_is_read_would_be_noticed() -> None:
    batch = annotated().without_truth()
    model = JointScanCRF.from_pretrained(stop_early=True)  # ends when all pairs have converged, so it has to look
    start = model.initialise(batch)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode, pytest.raises(DataDependentOutputException):
        torch.func.functional_call(model, elsewhere(mode, model), (moved(mode, batch), moved(mode, start)))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_gives_the_labels_of_the_cpu() -> None:
    batch = annotated().without_truth()
    model = JointScanCRF.from_pretrained(motion_weights="soft", iterations=2, stop_early=False).double()
    start = model.initialise(batch)
    expected = model(batch, start)
    found = model.cuda()(batch.to(torch.device("cuda")), moved_really(start))
    assert torch.equal(found.cluster.cpu(), expected.cluster)
    assert_close(found.motions.detach().cpu(), expected.motions.detach(), tolerance=1e-6)


def moved_really(start: Start) -> Start:
    """The start on the GPU."""
    given = {f.name: getattr(start, f.name) for f in fields(start)}
    return replace(start, **{name: of.cuda() for name, of in given.items() if isinstance(of, Tensor)})
