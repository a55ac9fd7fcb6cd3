"""`torchcrf-scan evaluate --rounds`: the course of the joint objective over the rounds, and whether relaxations could better it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import COUPLINGS, SCHEDULES
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.features.candidates import Candidates, with_targets
from torchcrf_scan.features.potentials import PairView, find_candidates
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.objective import Watched, chain_scores
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, Round, State
from torchcrf_scan.inputs import full_precision
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.variants.lattice import lattice_at, lattice_bound, lattice_score, update_labels

if TYPE_CHECKING:
    from torchcrf_scan.evaluation.convergence import Course
    from torchcrf_scan.evaluation.report import Table


def tell_rounds(model: JointScanCRF, pairs: Sequence[ScanPair]) -> tuple[list[Table], dict[str, Any]]:
    """Tables and entries of `--json`; raises TorchCRFScanError as `check` does."""
    from torchcrf_scan.evaluation.convergence import convergence_figures, convergence_tables

    check(model)
    courses = [watch(model, pair) for pair in tqdm(pairs, unit="pair", disable=None)]
    return convergence_tables(courses), {"rounds": convergence_figures(courses)}


def check(model: JointScanCRF) -> None:
    """Raises TorchCRFScanError for a model without rounds, or whose rounds do not decode two chains in turns."""
    config = model.config
    in_turns = not COUPLINGS[config.coupling].chain and SCHEDULES[config.inference.schedule].takes_couplings
    if not (config.has_association and config.has_clusters and in_turns and config.inference.iterations > 0):
        raise TorchCRFScanError("--rounds: expected a model with rounds over two chains in turns (coupling motions), got another")


@torch.no_grad()
def watch(model: JointScanCRF, pair: ScanPair) -> Course:
    """The course of one pair, by the rounds in tensors."""
    from torchcrf_scan.evaluation.convergence import Course

    config, parameters = model.config, model.fitted
    reference = model.association_weights["sequence"]
    batch = ScanPairBatch.collate([pair], reference.dtype).without_truth().to(reference.device)
    start = model.initialise(batch)
    learned = model.learned_inputs(batch, start)
    with full_precision(reference.device.type):
        view, seen = model.view(batch, learned), Watched()
        rounds = joint.rounds(view, view.in_unit(start), parameters, config, seen)
        beside = beside_lattice(view, view.in_unit(start), rounds[-1].state, parameters, config)
    scores, gaps = (torch.cat(of).cpu().numpy() for of in (seen.scores, seen.gaps))
    return Course(pair.name, scores, gaps, bool(rounds[-1].converged), damped(rounds), *beside[:, 0].tolist())


def damped(rounds: Sequence[Round]) -> int:
    """Number of rounds of one pair that `joint.damp` has damped."""
    states = [done.state for done in rounds]
    return sum(bool(joint.swings(*of)) for of in zip(states[2:], states[1:], states, strict=False))


def beside_lattice(view: PairView, start: Start, state: State, parameters: Parameters, config: ModelConfig) -> Tensor:
    """(3, B) of `Course`: `lattice_gap`, `gain`, `lattice_gain`."""
    found = find_candidates(view, state.motions.value, state.motions.active, config.inference)
    index, mask, _ = with_targets(found.index, found.mask, state.association)
    found = Candidates(index, mask, found.nearest)  # with the labels that the lattice is compared to
    best = update_labels(view, start, state, found, parameters, replace(config.inference, temperature=0.0))
    potentials = lattice_at(view, start, state, found, parameters).cut(view.batch.source_mask).double()
    outlier = potentials.log_cluster.shape[-1] - 1

    def own_score(of: State) -> Tensor:
        states = with_targets(index, mask, of.association)[2], of.cluster.masked_fill(of.cluster < 0, outlier)
        return lattice_score(potentials, *states)

    def objective(of: State) -> Tensor:
        return chain_scores(view, start, of, found, parameters).sum(-1)

    own = own_score(best)
    return torch.stack([lattice_bound(potentials) - own, objective(best) - objective(state), own - own_score(state)])
