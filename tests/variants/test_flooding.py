"""Algorithm 1 as printed against the exact chains: equal beliefs where the motions stand still, equal labels on easy pairs."""

from dataclasses import replace

import pytest
import scenes
import torch
from support import assert_close, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.candidates import by_motion
from torchcrf_scan.features.potentials import Boosters, PairView, clustering_potentials, clustering_unary, possible_clusters
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference import joint, motion
from torchcrf_scan.inference.motion import Motions, RunningSums
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.variants import flooding

N, M = 6, 5
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3], [0.2, -0.2, -1.0]], dtype=torch.float64)
MODEL = JointScanCRF().double()
CHAINS = ("clustering", "matching")


def make_batch(pairs: int, n: int = N, m: int = M) -> ScanPairBatch:
    source = torch.stack([make_points(n, seed) for seed in range(pairs)])
    target = torch.stack([make_points(m, seed + 50) for seed in range(pairs)])
    return scenes.make_batch(source, target)


def random_case(chains: str, pairs: int = 4) -> tuple[ScanPairBatch, Start, Parameters]:
    """Scans that do not fit, random associations and weights: every message matters."""
    batch = make_batch(pairs)
    motions = MOTIONS[:1] if chains == "matching" else MOTIONS
    motions = motions.expand(pairs, -1, 3)
    association = torch.randint(-1, M, (pairs, N), generator=generator(1))
    start = Start(motions, torch.ones(motions.shape[:2], dtype=torch.bool), association, torch.zeros_like(batch.target))
    return batch, start, Parameters(normal(23, seed=3), normal(21, seed=4), Scales().double(), Boosters(1).double())


def config(chains: str = "joint", **inference: object) -> ModelConfig:
    settings = {"motion_metric": "point", "schedule": "flooding"} | inference
    return ModelConfig(chains=chains, inference=InferenceConfig(**settings))  # type: ignore[arg-type]


@pytest.fixture
def standing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motions that nothing changes, and clusters that nobody removes."""

    def unmoved(self: RunningSums, previous: Motions, min_extent: float) -> Tensor:
        return previous.value

    monkeypatch.setattr(RunningSums, "motions", unmoved)
    monkeypatch.setattr(motion, "PATIENCE", 1000)


def beliefs_of(found: Prediction, chains: str) -> Tensor:
    return found.log_cluster if chains == "clustering" else found.log_association


def flood_and_pass(chains: str, order: str, iterations: int, temperature: float) -> tuple[Tensor, Tensor]:
    """Beliefs after some flooding, and those of the exact passes; nothing counts as settled before the iterations are over."""
    batch, start, parameters = random_case(chains)
    settings = {"clusters": start.motions.shape[1] + 1, "candidates": 3, "temperature": temperature, "rotation_tolerance": 0.0}
    view = PairView.of(batch)
    exact = joint.decode(view, start, parameters, config(chains, **settings, iterations=1))
    found = flooding.decode(view, start, parameters, config(chains, **settings, iterations=iterations, flooding_order=order))
    assert found.iterations.tolist() == [iterations] * len(batch)
    return beliefs_of(found, chains), beliefs_of(exact, chains)


@pytest.mark.usefixtures("standing")
@pytest.mark.parametrize("temperature", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("chains", CHAINS)
def test_two_alternating_iterations_are_exact(chains: str, temperature: float) -> None:
    found, exact = flood_and_pass(chains, "alternate", 2, temperature)
    assert_close(found, exact)


@pytest.mark.usefixtures("standing")
@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("chains", CHAINS)
def test_ascending_iterations_are_exact_after_as_many_as_there_are_nodes(chains: str, temperature: float) -> None:
    found, exact = flood_and_pass(chains, "ascending", N, temperature)
    assert_close(found, exact)
    for iterations in range(1, N):
        early, _ = flood_and_pass(chains, "ascending", iterations, temperature)
        first = N - 1 - iterations  # from here on what is behind a node has been heard in full
        assert_close(early[:, first:], exact[:, first:])
        assert iterations > 1 or temperature == 0 or not torch.allclose(early, exact, atol=1e-3)


@pytest.mark.usefixtures("standing")
@pytest.mark.parametrize("order", ["alternate", "ascending"])
@pytest.mark.parametrize("chains", CHAINS)
def test_nothing_is_settled_before_every_message_has_arrived(chains: str, order: str) -> None:
    batch, start, parameters = random_case(chains, 32)
    parameters = replace(parameters, association=normal(23, seed=6) / 2, clustering=normal(21, seed=106) / 2)
    settings = {"clusters": start.motions.shape[1] + 1, "candidates": 3}
    view = PairView.of(batch)
    exact = joint.decode(view, start, parameters, config(chains, **settings, iterations=1))
    found = flooding.decode(view, start, parameters, config(chains, **settings, iterations=50, flooding_order=order))
    assert found.converged.all()
    assert torch.equal(found.association, exact.association)
    assert torch.equal(found.cluster, exact.cluster)


def clustering_tables(view: PairView, start: Start, state: State, parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Log potentials of the whole clustering chain at a state."""
    batch, motions, scales = view.batch, state.motions, parameters.scales
    nearest = by_motion(batch.source, batch.target, batch.target_mask, motions.value, motions.active, 1).nearest
    at = clustering.correspond(batch.source, batch.target, motions.value, nearest, state.association)
    local = clustering_unary(view, at, motions.value, motions.active, scales, start.reach)
    possible = possible_clusters(motions.active, view.within(start.reach), batch.source.shape[1])
    return clustering_potentials(local, clustering.pairwise_features(batch.source, at, scales), possible, parameters.clustering)


@pytest.mark.usefixtures("standing")
def test_labels_are_the_argmax_over_all_messages() -> None:
    """Lines 16 to 21: a visit of an ascending iteration has not heard the node after it, the answer has."""
    batch, start, parameters = random_case("clustering", 8)
    parameters = replace(parameters, clustering=normal(21, seed=106) / 2)
    view, model = PairView.of(batch), config("clustering", clusters=4, iterations=1, flooding_order="ascending")
    run = flooding.Flooding(view, start, parameters, model)
    unary, edges = clustering_tables(view, start, run.state, parameters)
    run.iterate(descending=False)
    forward, backward = torch.zeros_like(unary), torch.zeros_like(unary)
    for i in range(N - 1):
        forward[:, i + 1] = (unary[:, i, :, None] + forward[:, i, :, None] + edges[:, i]).amax(1)
        backward[:, i] = (unary[:, i + 1, None] + edges[:, i]).amax(2)  # sent before anything came from behind
    expected = (unary + forward + backward).argmax(-1)
    expected[expected == unary.shape[-1] - 1] = -1
    assert not torch.equal(run.state.cluster, expected)
    assert torch.equal(flooding.decode(view, start, parameters, model).cluster, expected)


def test_labels_are_those_at_the_last_motions(simulated: tuple[ScanPairBatch, Start]) -> None:
    part, start = alone(*simulated, 0)
    view, model = PairView.of(part), config(clusters=start.motions.shape[1] + 1, flooding_order="ascending")
    with torch.no_grad():
        run = flooding.Flooding(view, start, MODEL.fitted, model)
        run.iterate(descending=False)
        visited = run.state
        unary, _ = clustering_tables(view, start, visited, MODEL.fitted)
        run.take_labels()
    belief = unary + run.cluster_messages.forward + run.cluster_messages.backward
    expected = belief.argmax(-1).masked_fill(belief.argmax(-1) == belief.shape[-1] - 1, -1)
    assert torch.equal(run.state.cluster, expected)
    assert torch.equal(run.state.motions.value, visited.motions.value)
    assert_close(run.state.log_cluster, torch.log_softmax(belief, -1))
    assert not torch.allclose(visited.log_cluster, run.state.log_cluster, atol=1e-3)
    assert not torch.allclose(visited.log_association, run.state.log_association, atol=1e-3)


@pytest.mark.usefixtures("standing")
def test_one_point_is_exact_at_once() -> None:
    batch, start, parameters = random_case("clustering")
    batch = replace(batch, source=batch.source[:, :1], source_mask=batch.source_mask[:, :1])
    start = replace(start, association=start.association[:, :1])
    settings = {"clusters": 4, "candidates": 3, "iterations": 1}
    view = PairView.of(batch)
    exact = joint.decode(view, start, parameters, config("clustering", **settings))
    assert_close(flooding.decode(view, start, parameters, config("clustering", **settings)).log_cluster, exact.log_cluster)


@pytest.fixture(scope="module")
def simulated() -> tuple[ScanPairBatch, Start]:
    """Three simulated pairs of different sizes, started near the truth."""
    easy = SimulatorConfig(scale=0.1, range_max=9.0, range_noise=0.003, clutter=0.0, mixed_pixels=0.0, movers_min=2, movers_max=2)
    pairs = [simulate_pairs(replace(easy, beams=beams), 1, 1, seed)[0] for seed, beams in ((5, 61), (1, 31), (2, 41))]
    batch = ScanPairBatch.collate(pairs, torch.float64)
    assert batch.truth is not None
    known = batch.truth.motions.isfinite().all(-1)
    motions = batch.truth.motions.nan_to_num() + 0.005 * normal(*batch.truth.motions.shape)
    start = Start(motions, known, nearest_association(batch, motions, known), torch.zeros_like(batch.target))
    return batch.without_truth(), start


def alone(batch: ScanPairBatch, start: Start, b: int) -> tuple[ScanPairBatch, Start]:
    """Pair b without its padding."""
    n, m, here = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum()), slice(b, b + 1)
    cut = {"source": n, "source_mask": n, "target": m, "target_mask": m}
    part = batch[here]
    part = replace(part, **{name: getattr(part, name)[:, :length] for name, length in cut.items()})
    return part, Start(start.motions[here], start.active[here], start.association[here, :n], start.target_tangents[here, :m])


def decode(batch: ScanPairBatch, start: Start, schedule: str, **inference: object) -> Prediction:
    model = config(schedule=schedule, clusters=start.motions.shape[1] + 1, **inference)
    decoder = flooding.decode if schedule == "flooding" else joint.decode
    with torch.no_grad():
        return decoder(PairView.of(batch), start, MODEL.fitted, model)


def test_flooding_and_sweep_agree_on_easy_pairs(simulated: tuple[ScanPairBatch, Start]) -> None:
    part, start = alone(*simulated, 0)
    flood, sweep = decode(part, start, "flooding", iterations=20), decode(part, start, "sweep", iterations=20)
    assert bool(flood.converged)
    assert bool(sweep.converged)
    assert len(set(sweep.cluster[0].tolist()) - {-1}) > 1  # there is something to tell apart
    assert (flood.association == sweep.association).float().mean() > 0.95
    assert (flood.cluster == sweep.cluster).float().mean() > 0.95
    assert torch.equal(flood.active, sweep.active)
    assert_close(flood.motions[flood.active], sweep.motions[flood.active], tolerance=0.02)


def test_every_pair_is_decoded_as_if_alone(simulated: tuple[ScanPairBatch, Start]) -> None:
    batch, start = simulated
    together = decode(batch, start, "flooding", iterations=2)
    for b in range(len(batch)):
        part, own_start = alone(batch, start, b)
        found, n = decode(part, own_start, "flooding", iterations=2), part.source.shape[1]
        assert together.association[b, :n].tolist() == found.association[0].tolist()
        assert together.cluster[b, :n].tolist() == found.cluster[0].tolist()
        assert_close(together.motions[b], found.motions[0])
        assert torch.equal(together.iterations[b], found.iterations[0])
        assert (together.association[b, n:] == -1).all()
        assert (together.cluster[b, n:] == -1).all()


@pytest.mark.parametrize("chains", ["joint", *CHAINS])
def test_a_batch_with_an_empty_scan_has_an_answer(chains: str) -> None:
    batch, start, parameters = random_case(chains)
    batch = replace(
        batch,
        source_mask=batch.source_mask & torch.tensor([True, False, True, True])[:, None],
        target_mask=batch.target_mask & torch.tensor([True, True, False, True])[:, None],
    )
    start = replace(start, association=nearest_association(batch, start.motions, start.active))
    model = config(chains, clusters=start.motions.shape[1] + 1, candidates=3, iterations=3)
    found = flooding.decode(PairView.of(batch), start, parameters, model)
    assert found.motions.isfinite().all()
    assert not found.log_association.isnan().any()
    assert not found.log_cluster.isnan().any()
    assert (found.association[2] == -1).all()
    assert (found.cluster[1] == -1).all()


def test_an_empty_cluster_is_removed_after_two_iterations(simulated: tuple[ScanPairBatch, Start]) -> None:
    part, start = alone(*simulated, 1)
    nowhere = torch.cat([start.motions[:, :1], start.motions[:, :1] + torch.tensor([0.0, 300.0, 300.0])], dim=1)
    start = Start(nowhere, torch.ones(1, 2, dtype=torch.bool), start.association, start.target_tangents)
    for iterations, is_active in ((1, True), (2, False)):
        found = decode(part, start, "flooding", iterations=iterations, rotation_tolerance=0.0)
        assert found.active.tolist() == [[True, is_active]]
        assert_close(found.motions[0, 1], nowhere[0, 1])


def test_without_an_early_stop_every_iteration_is_done(simulated: tuple[ScanPairBatch, Start]) -> None:
    part, start = alone(*simulated, 1)
    assert int(decode(part, start, "flooding", iterations=9).iterations) < 9
    found = decode(part, start, "flooding", iterations=9, stop_early=False)
    assert found.iterations.tolist() == [9]


def test_no_gradient_passes() -> None:
    batch, start, _ = random_case("clustering", 1)
    model = JointScanCRF(config(clusters=4, iterations=1)).double()
    assert not model(batch, start).log_cluster.requires_grad
