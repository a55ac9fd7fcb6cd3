"""Leave-one-out: folds run in parallel over cores and machines, each saved when it is done, so that a run can be resumed.

A finished fold is a folder `PROTOCOL/FOLD/` with `METHOD/PAIR.npz` predictions and `seconds.json`, written atomically.
"""

from __future__ import annotations

import json
import os
import pickle
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from pathlib import Path

import torch
import torch.distributed as dist
from joblib import Parallel, cpu_count, delayed
from tqdm import tqdm

from torchcrf_scan.data.pair_file import read_prediction, write_prediction
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.experiment.methods import METHODS, Answer, answer
from torchcrf_scan.experiment.models import fit_models
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.safe_names import file_name, printable, slug
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.whole_file import whole_path

SECONDS = "seconds.json"
PATIENCE = timedelta(days=7)  # waiting time for the folds of other machines


@dataclass(frozen=True, slots=True)
class Fold:
    """Indices of the pairs that a fold trains on and tests on."""

    name: str
    train: tuple[int, ...]
    test: tuple[int, ...]


def make_folds(protocol: str, pairs: Sequence[ScanPair], tested: int, every: int = 1) -> list[Fold]:
    """The folds of a protocol.

    Args:
        protocol: `leave_one_pair_out` or `leave_one_sequence_out`.
        pairs: the first `tested` are left out in turn, the others are always trained on.
        every: only every so-many-th of the tested pairs is tested.

    Raises:
        TorchCRFScanError: fewer than two things to leave out, or two of the same name.
    """
    by_pair = protocol == "leave_one_pair_out"
    groups: dict[str, list[int]] = {}
    for k, pair in enumerate(pairs[:tested]):
        groups.setdefault(pair.name if by_pair else pair.sequence, []).append(k)
    if len(groups) < 2:
        raise TorchCRFScanError(f"{protocol}: expected at least 2 to leave out in turn, got {len(groups)}: {list(groups)}")
    counts = Counter(pair.name for pair in pairs[:tested])
    if twins := [name for name, count in counts.items() if count > 1]:
        raise TorchCRFScanError(f"{protocol}: expected pair names that differ, got twice {', '.join(map(printable, twins[:5]))}")
    folds = []
    for name, members in groups.items():
        left_out = set(members)
        train = tuple(k for k in range(len(pairs)) if k not in left_out)
        test = tuple(k for k in members if k % every == 0)
        if test:
            folds.append(Fold(file_name(name), train, test))
    return folds


def run_folds(
    make_study: Callable[[int], Study], folds: Mapping[str, Sequence[Fold]], config: RunConfig, folder: Path, jobs: int
) -> None:
    """Runs the folds missing in `folder`; under `torchrun` every rank takes its share and rank 0 ends up with all of them.

    Args:
        make_study: surveys the pairs on a number of cores; called only if there are folds to run.
        folds: protocol -> its folds.
        jobs: processes.
    """
    rank, world = rank_and_world()
    everything = [(protocol, fold) for protocol, of_protocol in folds.items() for fold in of_protocol]
    mine = everything[rank::world]
    missing = [(protocol, fold) for protocol, fold in mine if not (folder / protocol / fold.name / SECONDS).is_file()]
    if missing:
        with tempfile.TemporaryDirectory() as shared:
            place = Path(shared) / "study"
            place.write_bytes(pickle.dumps((make_study(jobs), config)))
            tasks = (delayed(run_fold)(place, protocol, fold, folder / protocol / fold.name) for protocol, fold in missing)
            done = Parallel(n_jobs=min(jobs, len(missing)), return_as="generator_unordered")(tasks)
            for _ in tqdm(done, total=len(missing), desc="folds", unit="fold", disable=None if rank == 0 else True):
                pass
    if world > 1:
        gather(folder, [Path(protocol) / fold.name for protocol, fold in mine])


def run_fold(study_file: Path, protocol: str, fold: Fold, folder: Path) -> None:
    """Fits on the fold's training pairs, predicts its test pairs and writes the fold's folder."""
    torch.set_num_threads(1)
    study, config = load_study(study_file)
    variants = config.experiment.joint_variants and protocol == "leave_one_sequence_out"
    models = fit_models(study, fold.train, config, variants)
    answers = {study.pairs[k].name: answer(models, study.pairs[k]) for k in fold.test}
    write_fold(folder, answers)


@lru_cache(maxsize=1)
def load_study(place: Path) -> tuple[Study, RunConfig]:
    """The study of this run, written by the parent process; a worker reads it once."""
    study, config = pickle.loads(place.read_bytes())
    return study, config


def write_fold(folder: Path, answers: Mapping[str, Mapping[str, Answer]]) -> None:
    """answers: pair name -> method -> answer."""
    seconds = {pair: {method: one.seconds for method, one in by_method.items()} for pair, by_method in answers.items()}
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_path(folder) as temporary:
        temporary.mkdir()
        for pair, by_method in answers.items():
            for method, one in by_method.items():
                path = temporary / slug(method) / f"{file_name(pair)}.npz"
                path.parent.mkdir(exist_ok=True)
                write_prediction(path, one.prediction)
        (temporary / SECONDS).write_text(json.dumps(seconds, indent=1) + "\n")


@dataclass(frozen=True, slots=True)
class Results:
    """A protocol's results: the tested pairs, and by method their predictions and seconds, in the order of the pairs."""

    pairs: tuple[ScanPair, ...]
    predictions: dict[str, list[PairPrediction]]
    seconds: dict[str, list[float]]


def read_folds(folder: Path, pairs: Sequence[ScanPair], folds: Sequence[Fold]) -> Results:
    """The results of a protocol's finished folds in `folder`, without methods missing in a fold. pairs: of the folds."""
    tested = sorted((k, fold) for fold in folds for k in fold.test)
    seconds = {fold.name: json.loads((folder / fold.name / SECONDS).read_text()) for fold in folds}
    of_pair = [seconds[fold.name][pairs[k].name] for k, fold in tested]
    methods = [method for method in METHODS if all(method in of for of in of_pair)]
    predictions = {
        method: [read_prediction(folder / fold.name / slug(method) / f"{file_name(pairs[k].name)}.npz") for k, fold in tested]
        for method in methods
    }
    return Results(tuple(pairs[k] for k, _ in tested), predictions, {method: [of[method] for of in of_pair] for method in methods})


def rank_and_world() -> tuple[int, int]:
    """This process's rank and the number of processes, as set by `torchrun`; (0, 1) without it."""
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def cores(jobs: int) -> int:
    """Number of processes: `jobs`, or with 0 this rank's share of the machine's cores."""
    return jobs or max(1, cpu_count() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def gather(folder: Path, mine: Sequence[Path]) -> None:
    """Sends this rank's folds to rank 0, which writes the missing ones: the machines need not share a disk."""
    dist.init_process_group("gloo", timeout=PATIENCE)
    try:
        files = {fold: read_files(folder / fold) for fold in mine}
        boxes: list[dict[Path, dict[Path, bytes]]] | None = None
        if dist.get_rank() == 0:
            boxes = [{} for _ in range(dist.get_world_size())]
        dist.gather_object(files, boxes)
        for fold, content in ((fold, content) for box in boxes or [] for fold, content in box.items()):
            if not (folder / fold / SECONDS).is_file():
                folder.mkdir(parents=True, exist_ok=True)
                with whole_path(folder / fold) as temporary:
                    temporary.mkdir()
                    for name, data in content.items():
                        (temporary / name).parent.mkdir(exist_ok=True)
                        (temporary / name).write_bytes(data)
    finally:
        dist.destroy_process_group()


def read_files(folder: Path) -> dict[Path, bytes]:
    """Contents of all files below a folder, by relative path."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
