"""Two clusters that turn out to be one become one at the end, and only those."""

import torch
from support import assert_close

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference.joint import merge_alike
from torchcrf_scan.inference.motion import Motions
from torchcrf_scan.inference.state import State


def state_with(view: PairView, motions: list[list[float]]) -> State:
    """Clusters take turns along the scan; beliefs are even."""
    B, N = view.batch.source.shape[:2]
    C = len(motions)
    value = torch.tensor(motions).expand(B, C, 3)
    cluster = (torch.arange(N) % C).expand(B, N)
    log_cluster = torch.full((B, N, C + 1), -1.0).log_softmax(-1)
    index = torch.zeros(B, N, 1, dtype=torch.int64)
    active = torch.ones(B, C, dtype=torch.bool)
    return State(Motions.start(value, active), index[..., 0], cluster, index, index == 0, torch.zeros(B, N, 2), log_cluster)


def make_view() -> PairView:
    return PairView.of(ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=61), 1, 1, 0)))


def test_alike_clusters_become_the_lower_one():
    view = make_view()
    state = state_with(view, [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.02, 0.0]])
    merged = merge_alike(view, state, torch.tensor(0.1))
    assert merged.motions.active.tolist() == [[True, True, False]]
    assert set(merged.cluster.flatten().tolist()) == {0, 1}
    assert_close(merged.log_cluster.exp().sum(-1), torch.ones(merged.cluster.shape))
    assert torch.isneginf(merged.log_cluster[..., 2]).all()


def test_other_clusters_stay():
    view = make_view()
    state = state_with(view, [[0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [0.02, 0.0, 0.0]])
    merged = merge_alike(view, state, torch.tensor(0.1))
    assert merged.motions.active.all()
    assert torch.equal(merged.cluster, state.cluster)
    assert torch.equal(merged.log_cluster, state.log_cluster)
