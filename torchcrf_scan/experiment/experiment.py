"""The paper's experiment: leave-one-out over annotated pairs, tables with intervals, figures, and ablations (spec 6.6, 8, 9)."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from torchcrf_scan.baselines.register import BASELINES, installed
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.bootstrap import by_blocks, by_sequence
from torchcrf_scan.evaluation.metrics import PairScore, score_pairs
from torchcrf_scan.evaluation.report import Scores, differences_table, report, sequences_table
from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.experiment.ablation import ablation_table
from torchcrf_scan.experiment.cross_validation import Results, cores, make_folds, rank_and_world, read_folds, run_folds
from torchcrf_scan.experiment.models import ENCODED, EXACT, JOINT
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.learning.leaks import TrainedOn
from torchcrf_scan.learning.run_data import read_files
from torchcrf_scan.learning.run_log import RunLog, one_error
from torchcrf_scan.safe_names import file_name, slug
from torchcrf_scan.scan import Ints, PairPrediction, ScanPair
from torchcrf_scan.viz.plots import plot_associations, save_figure
from torchcrf_scan.viz.sequences import consecutive, plot_association_sequence, plot_cluster_sequence
from torchcrf_scan.whole_file import write_whole

log = logging.getLogger(__name__)

SETTINGS = "experiment.json"
ALSO_TRAIN_SEED = 5_000  # of the worlds that every fold trains on, far from those of the tested worlds
ASSOCIATION_FIGURE = ("ICP, tuned", "CRF-Matching", "start + gated NN", JOINT)  # the paper's Fig. 3, and the start
CLUSTER_FIGURE = ("K-Means (ICP)", "K-Means (CRF-Matching)", "CRF-Clustering", JOINT)  # the paper's Fig. 4
RIVAL = "start + gated NN"
APART = ("CRF-Matching", RIVAL, JOINT, ENCODED)  # rows of the table by sequence
SEQUENTIAL = 4  # scans of such a figure, as in the paper
DRAWN = 3  # sequences whose first pair is drawn by default
LOSSES = 3  # number of pictures of pairs where the joint model loses most against its start
ABLATED = "leave_one_sequence_out"


def run_experiment(config: RunConfig) -> dict[str, list[Table]]:
    """Runs the missing folds, then makes all tables and figures.

    Returns:
        The tables of every protocol; none on ranks of `torchrun` other than 0.

    Raises:
        TorchCRFScanError: nothing to leave out, a tested sequence that is trained on too, an unknown pair to draw, or a folder of
            another experiment.
    """
    folder = Path(config.output)
    pairs, tested = load_pairs(config)
    refuse_leaks([config], pairs, tested)
    figures = find_pairs(config.experiment.figures, pairs[:tested])
    folds = {
        protocol: make_folds(protocol, pairs, tested, config.experiment.test_every) for protocol in config.experiment.protocols
    }
    claim(folder, config, pairs)
    for name in sorted(set(BASELINES) - set(installed())):
        log.info("row left out, not installed: %s (pip install torchcrf-scan[bench])", name)
    run_folds(lambda jobs: Study.of(pairs, config, jobs), folds, config, folder / "folds", cores(config.experiment.jobs))
    if rank_and_world()[0] != 0:
        return {}
    tables = {}
    with one_error(folder), RunLog(folder) as run:
        for protocol, of_protocol in folds.items():
            results = read_folds(folder / "folds" / protocol, pairs, of_protocol)
            scores = score(results)
            tables[protocol] = tabulate(scores, results.seconds, protocol, config, run)
            write_tables(folder / "tables", protocol, tables[protocol])
            draw(results, scores, figures, folder / "figures" / protocol, run)
    return tables


def run_ablations(config: RunConfig, variants: Mapping[str, RunConfig]) -> list[Table]:
    """The joint model under every variant of `config`, sequences left out in turn, compared with the model of `config` itself.

    Args:
        variants: name -> its config.

    Returns:
        One table; none on ranks other than 0.

    Raises:
        TorchCRFScanError: as `run_experiment`.
    """
    pairs, tested = load_pairs(config)
    refuse_leaks([config, *variants.values()], pairs, tested)
    scores, seconds = {}, {}
    with TemporaryDirectory() as kept:
        studies = Studies(pairs, Path(kept))
        for name, variant in {"as configured": config, **variants}.items():
            log.info("%s", name)
            found = run_variant(config, ablated(config, variant, name), studies, tested)
            if found is not None:
                scores[name], seconds[name] = score(found)[JOINT], found.seconds[JOINT]
    if rank_and_world()[0] != 0:
        return []
    tables = [ablation_table(scores, seconds, lambda of: resample(of, config))]
    write_tables(Path(config.output) / "tables", "ablations", tables)
    return tables


@dataclass(frozen=True, slots=True)
class Studies:
    """The studies of the same pairs, made on demand. kept: folder of results shared by variants."""

    pairs: Sequence[ScanPair]
    kept: Path
    made: dict[str, Study] = field(default_factory=dict)

    def study(self, config: RunConfig, jobs: int) -> Study:
        """The study of a variant, shared by variants with the same preprocessing."""
        key = json.dumps([config.learning.seed, config.learning.disturbance])
        if key not in self.made:
            self.made[key] = replace(Study.of(self.pairs, config, jobs), kept=self.kept)
        return self.made[key]


def ablated(config: RunConfig, variant: RunConfig, name: str) -> RunConfig:
    """A variant as run by the ablations: the joint model alone, on the pairs that the model of `config` is tested on."""
    every = math.lcm(config.experiment.test_every, variant.experiment.test_every)
    experiment = replace(variant.experiment, joint_alone=True, protocols=(ABLATED,), test_every=every)
    return replace(variant, experiment=experiment, output=str(Path(config.output) / "ablations" / file_name(name)))


def run_variant(config: RunConfig, variant: RunConfig, studies: Studies, tested: int) -> Results | None:
    """Runs the folds of one variant; None on ranks other than 0."""
    pairs, folder = studies.pairs, Path(variant.output)
    folds = make_folds(ABLATED, pairs, tested, variant.experiment.test_every)
    claim(folder, variant, pairs)
    jobs = cores(config.experiment.jobs)
    run_folds(lambda jobs: studies.study(variant, jobs), {ABLATED: folds}, variant, folder / "folds", jobs)
    return read_folds(folder / "folds" / ABLATED, pairs, folds) if rank_and_world()[0] == 0 else None


def load_pairs(config: RunConfig) -> tuple[list[ScanPair], int]:
    """The annotated pairs, the tested ones first, and the number of tested ones."""
    experiment, data = config.experiment, config.data
    tested = read_files(experiment.pairs) or simulate(experiment.worlds, config, data.seed)
    bare = [pair.name for pair in tested if pair.annotation is None]
    if bare or not tested:
        raise TorchCRFScanError(f"experiment.pairs: expected annotated pairs, got {bare[:3] or 'none'}")
    return [*tested, *simulate(experiment.also_train, config, data.seed + ALSO_TRAIN_SEED)], len(tested)


def refuse_leaks(configs: Sequence[RunConfig], pairs: Sequence[ScanPair], tested: int) -> None:
    """Raises TorchCRFScanError if a tested sequence is always trained on, or was for the initial weights of an encoder."""
    TrainedOn().plus(pairs[tested:]).refuse(pairs[:tested], "experiment.also_train")
    for init in sorted({config.init for config in configs if config.model.encoder.width > 0}):
        TrainedOn.of_model(init).refuse(pairs[:tested], f"init {init}")


def simulate(worlds: Sequence[str], config: RunConfig, seed: int) -> list[ScanPair]:
    """Pairs of every named world, with the world's number in their names."""
    data = config.data
    found = [simulate_pairs(NAMED_WORLDS[world], data.pairs, data.sequences, seed + k) for k, world in enumerate(worlds)]
    return [replace(pair, name=f"{seed + k}_{pair.name}") for k, of_world in enumerate(found) for pair in of_world]


def claim(folder: Path, config: RunConfig, pairs: Sequence[ScanPair]) -> None:
    """Marks the folder as this experiment's; raises TorchCRFScanError if its folds were made with other settings or pairs."""
    values = asdict(config)
    for name in ("output", "overfit", "compare_chains"):
        values.pop(name)
    for name in ("figures", "resamples", "jobs", "leave_out", "protocols"):  # these may change between runs
        values["experiment"].pop(name)
    ours = json.loads(json.dumps({**values, "tested": [pair.name for pair in pairs]}))
    path = folder / SETTINGS
    if path.is_file():
        theirs = json.loads(path.read_text())
        differ = sorted(differing(ours, theirs))
        if differ:
            names = ", ".join(differ[:5])
            raise TorchCRFScanError(f"--output {folder}: expected the folder of the same experiment, got one with another {names}")
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(ours, indent=1) + "\n")


def differing(ours: Mapping[str, object], theirs: Mapping[str, object], prefix: str = "") -> list[str]:
    """Dotted names of the settings in which two nested dictionaries differ."""
    names = []
    for key in {*ours, *theirs}:
        one, other = ours.get(key), theirs.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            names += differing(one, other, f"{prefix}{key}.")
        elif one != other:
            names.append(f"{prefix}{key}")
    return names


def find_pairs(wanted: Sequence[str], pairs: Sequence[ScanPair]) -> list[ScanPair]:
    """The pairs named SEQUENCE:NUMBER (TorchCRFScanError for an unknown one); by default the first of the first sequences."""
    by_sequence: dict[str, list[ScanPair]] = {}
    for pair in pairs:
        by_sequence.setdefault(pair.sequence, []).append(pair)
    if not wanted:
        return [of_sequence[0] for of_sequence in by_sequence.values()][:DRAWN]
    found = []
    for name in wanted:
        sequence, _, number = name.rpartition(":")
        members = by_sequence.get(sequence, [])
        if not (number.isdigit() and int(number) < len(members)):
            known = ", ".join(f"{key}:0..{len(of) - 1}" for key, of in by_sequence.items())
            raise TorchCRFScanError(f"experiment.figures: expected SEQUENCE:NUMBER out of {known}, got {name}")
        found.append(members[int(number)])
    return found


def score(results: Results) -> dict[str, list[PairScore]]:
    """Every method's scores, in the order of the pairs."""
    return {method: score_pairs(results.pairs, predictions) for method, predictions in results.predictions.items()}


def resample(scores: Sequence[PairScore], config: RunConfig) -> Ints:
    """(R, P) bootstrap weights: over sequences for simulated pairs, over blocks of consecutive pairs for recorded ones."""
    draw = by_blocks if config.experiment.pairs else by_sequence
    return draw([one.sequence for one in scores], resamples=config.experiment.resamples)


def tabulate(scores: Scores, seconds: Mapping[str, Sequence[float]], protocol: str, config: RunConfig, run: RunLog) -> list[Table]:
    """Overview, by sequence too, Tables I to III, calibration and differences of one protocol, logged as well."""
    weights = resample(scores[JOINT], config)
    tables = report(scores, seconds=seconds, published=True, weights=weights)
    tables.insert(1, sequences_table({name: scores[name] for name in APART if name in scores}))
    tables += [differences_table(name, scores, weights) for name in (JOINT, ENCODED, EXACT) if name in scores and len(scores) > 1]
    tables = [replace(table, title=f"{table.title} ({protocol.replace('_', ' ')})") for table in tables]
    run.tables(protocol, tables)
    return tables


def draw(results: Results, scores: Scores, pairs: Sequence[ScanPair], folder: Path, run: RunLog) -> None:
    """The paper's Figures 3 and 4 of the chosen pairs, and the pairs where the joint model loses most against its start."""
    index = {pair.name: k for k, pair in enumerate(results.pairs)}

    def answers(methods: Sequence[str], numbers: Sequence[int]) -> dict[str, list[PairPrediction]]:
        return {method: [results.predictions[method][k] for k in numbers] for method in methods if method in results.predictions}

    for pair in pairs:
        if pair.name in index:
            numbers = consecutive(results.pairs, index[pair.name], SEQUENTIAL - 1)
            chosen = [results.pairs[k] for k in numbers]
            figures = {
                "associations": plot_association_sequence(chosen, answers(ASSOCIATION_FIGURE, numbers)),
                "clusters": plot_cluster_sequence(chosen, answers(CLUSTER_FIGURE, numbers)),
            }
            for kind, figure in figures.items():
                save_figure(figure, folder / f"{kind}_{file_name(pair.name)}.png")
                run.figure(f"{folder.name}/{kind}/{file_name(pair.name)}", figure)
    if RIVAL in results.predictions:
        for k in worst_pairs(scores):
            both = {method: results.predictions[method][k] for method in (RIVAL, JOINT)}
            figure = plot_associations(results.pairs[k], both)
            save_figure(figure, folder / f"loss_{file_name(results.pairs[k].name)}.png")


def worst_pairs(scores: Scores) -> list[int]:
    """The pairs where the joint model has most labels less right than its start has, both chains together."""
    right = {name: np.array([one.association.right + one.cluster.right for one in scores[name]]) for name in (JOINT, RIVAL)}
    loss = right[RIVAL] - right[JOINT]
    return [int(k) for k in np.argsort(-loss, kind="stable")[:LOSSES] if loss[k] > 0]


def write_tables(folder: Path, name: str, tables: Sequence[Table]) -> None:
    """`NAME.md` with all tables, and a CSV file of each."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / f"{name}.md", "\n\n".join(table.to_markdown() for table in tables) + "\n")
    for table in tables:
        write_whole(folder / f"{name}_{slug(table.title.split(' (')[0].split(':')[0])}.csv".lower(), table.to_csv())
