"""Inside a network that calculates in bfloat16 the layer keeps its geometry: the same start, beliefs and motions nearly as good."""

import pytest
import torch
from support import assert_close

from torchcrf_scan import JointScanCRF, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig


@pytest.fixture(scope="module")
def batch() -> ScanPairBatch:
    return ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=121), 2, 2, 3))


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained(
        "simulated", motion_weights="soft", temperature=1.0, stop_early=False, iterations=2, backend="eager"
    )


def test_the_start_is_the_same(model: JointScanCRF, batch: ScanPairBatch) -> None:
    expected = model.initialise(batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = model.initialise(batch)
    assert torch.equal(found.motions, expected.motions)
    assert torch.equal(found.association, expected.association)


def test_messages_and_motions_keep_their_precision(model: JointScanCRF, batch: ScanPairBatch) -> None:
    start = model.initialise(batch)
    full = model(batch, start)
    with torch.autocast("cpu", torch.bfloat16):
        half = model(batch, start)
    for found in (half.log_association, half.log_cluster, half.motions):
        assert found.dtype == torch.float32
    assert (half.association == full.association).double().mean() > 0.98
    assert (half.cluster == full.cluster).double().mean() > 0.98
    assert_close(half.motions[:, 0], full.motions[:, 0].detach(), tolerance=5e-3)
    half.motions[:, 0].sum().backward()
    assert all(weight.grad is None or bool(weight.grad.isfinite().all()) for weight in model.parameters())
