"""The joint objective, and the linear programming relaxation of each chain, which the decoded labels attain at fixed motions."""

from dataclasses import replace

import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import MOTIONS, make_batch, make_start, scene
from support import assert_close, generator, make_points, normal, paper_weights

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.features.candidates import Candidates
from torchcrf_scan.features.potentials import Boosters, PairView, find_candidates
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.objective import Watched, chain_bound, chain_scores, dual_bound
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.model import JointScanCRF

MODEL = JointScanCRF().double()


def padded_round(seed: int, candidates: int = 3) -> tuple[PairView, Start, State, Candidates, Parameters]:
    """Two pairs of 7 and 4 points at random weights: everything that a round begins with."""
    source, target = (torch.stack([make_points(n, seed), make_points(n, seed + 9)]) for n in (7, 6))
    batch = make_batch(source, target, ([7, 4], [6, 5]))
    parameters = Parameters(*paper_weights(seed, seed + 1), Scales().double(), Boosters(1).double())
    view, start = PairView.of(batch), make_start(batch, MOTIONS)
    settings = InferenceConfig(clusters=4, candidates=candidates)
    state = joint.first_state(view, start, settings)
    return view, start, state, find_candidates(view, start.motions, start.active, settings), parameters


def states_of(labels: torch.Tensor, index: torch.Tensor) -> list[int]:
    """The association states of one pair's labels."""
    return [list(row).index(label) if label >= 0 else len(row) for label, row in zip(labels.tolist(), index.tolist(), strict=True)]


def assert_tight(view: PairView, start: Start, state: State, found: Candidates, parameters: Parameters, tolerance: float) -> None:
    """A pass over each chain, at the state's motions and the other chain's labels, reaches the value of its linear program."""
    settings = InferenceConfig()
    clustered = joint.update_clusters(view, start, state, found, parameters, settings)
    associated = joint.update_association(view, clustered, found, parameters, settings)
    passes = {  # before and after the pass; the chain's place in `chain_scores`
        0: (joint.association_at(view, clustered, found, parameters), associated),
        1: (joint.clustering_at(view, start, state, found, parameters), clustered),
    }
    for place, ((unary, pairwise), after) in passes.items():
        scores = chain_scores(view, start, after, found, parameters)[:, place].tolist()
        for b, n in enumerate(view.batch.source_mask.sum(-1).tolist()):
            nodes, edges = unary[b, :n].double().numpy(), pairwise[b, : n - 1].double().numpy()
            assert scores[b] == pytest.approx(oracles.relaxed_best(list(nodes), oracles.chain_edges(edges)), abs=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_both_chains_reach_the_value_of_their_relaxation(seed: int) -> None:
    assert_tight(*padded_round(seed), tolerance=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_the_objective_is_the_sum_of_all_potentials(seed: int) -> None:
    view, start, state, found, parameters = padded_round(seed, candidates=0)
    scores = chain_scores(view, start, state, found, parameters)
    unary, pairwise = joint.association_at(view, state, found, parameters)
    of_clusters = joint.clustering_at(view, start, state, found, parameters)
    for b, n in enumerate((7, 4)):
        association = states_of(state.association[b, :n], found.index[b, :n])
        cluster = [k % 4 for k in state.cluster[b, :n].tolist()]  # -1 is the outlier, the last state
        own = (pairwise[b, : n - 1].numpy(), of_clusters[1][b, : n - 1].numpy())
        assert_close(scores[b, 0], oracles.score(unary[b, :n].numpy(), own[0], association))
        assert_close(scores[b, 1], oracles.score(of_clusters[0][b, :n].numpy(), own[1], cluster))


def test_impossible_labels_have_no_score_and_associations_need_not_be_candidates() -> None:
    view, start, state, found, parameters = padded_round(1, candidates=0)
    few = padded_round(1, candidates=2)[3]
    is_found = (few.index == state.association[..., None]).any(-1)
    farthest = (state.association + 3) % 5  # of the five targets of the second pair
    moved = replace(state, association=torch.where(view.batch.source_mask, farthest, -1))
    assert not bool((is_found & (moved.association == state.association)).any())
    every, some = (chain_scores(view, start, moved, of, parameters) for of in (found, few))
    assert_close(some, every)
    active = torch.ones_like(state.motions.active).index_fill(1, state.cluster.max(), False)
    gone = replace(state, motions=replace(state.motions, active=active))
    lost = chain_scores(view, start, gone, found, parameters)[:, 1]
    has_lost = (state.cluster == state.cluster.max()).any(-1)
    assert has_lost.any()
    assert torch.equal(torch.isneginf(lost), has_lost)


@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 4))
def test_whatever_the_messages_no_labels_exceed_the_bound_and_the_best_reach_it(seed: int, nodes: int, states: int) -> None:
    unary, pairwise, messages = (
        normal(1, *shape, seed=seed + k) for k, shape in enumerate([(nodes, states), (nodes - 1, states, states), (nodes, states)])
    )
    impossible = torch.rand(unary.shape, generator=generator(seed)) < 0.3
    unary = unary.masked_fill(impossible & (torch.arange(states) > 0), -torch.inf)
    arrays = unary[0].numpy(), pairwise[0].numpy()
    best = oracles.log_partition(*arrays, temperature=0.0)
    messages[:, 0] = 0
    assert float(dual_bound(unary, pairwise.unbind(1), messages)) > best - 1e-9
    assert_close(chain_bound(unary, pairwise), [best])
    assert oracles.relaxed_best(list(arrays[0]), oracles.chain_edges(arrays[1])) == pytest.approx(best, abs=1e-7)


@pytest.mark.parametrize("metric", ["line", "point"])
def test_the_watched_rounds_are_the_rounds(metric: str) -> None:
    batch, _ = scene(30, seed=3)
    model = ModelConfig(inference=InferenceConfig(clusters=4, motion_metric=metric, candidates=4))
    view, start, seen = PairView.of(batch), make_start(batch, MOTIONS + 0.05), Watched()
    with torch.no_grad():
        plain, watched = (joint.rounds(view, start, MODEL.fitted, model, update) for update in (joint.update_in_turns, seen))
    assert len(plain) == len(watched) == len(seen.scores) + 1
    for one, other in zip(plain, watched, strict=True):
        assert torch.equal(one.state.association, other.state.association)
        assert torch.equal(one.state.cluster, other.state.cluster)
        assert torch.equal(one.state.motions.value, other.state.motions.value)


def test_on_scans_of_real_size_both_relaxations_are_tight() -> None:
    model = JointScanCRF.from_pretrained()
    batch = ScanPairBatch.collate(simulate_pairs(NAMED_WORLDS["street"], 2, 2, 0), torch.float32).without_truth()
    with torch.no_grad():
        start, seen = model.initialise(batch), Watched()
        view = model.view(batch, model.learned_inputs(batch, start))
        start = view.in_unit(start)
        last = joint.rounds(view, start, model.fitted, model.config, seen)[-1].state
        found = find_candidates(view, last.motions.value, last.motions.active, model.config.inference)
        assert_tight(view, start, last, found, model.fitted, tolerance=1e-3)  # labels are decoded in float32
    scores, gaps = torch.stack(seen.scores), torch.stack(seen.gaps)  # (R, B, 5, 2), (R, B, 2)
    assert len(scores) > 2
    assert float(gaps.abs().amax()) < 1e-3
    assert float((scores[:, :, 1, 1] - scores[:, :, 0, 1]).amin()) > -1e-3  # no pass over the clusters lowers their score
