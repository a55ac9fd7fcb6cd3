"""One training run: data, fit, evaluation, run folder. Called by `train.py`."""

from __future__ import annotations

import json
import logging
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.baselines.cascade import Cascade
from torchcrf_scan.baselines.start import match_start
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.evaluation.metrics import PairScore, score_pairs
from torchcrf_scan.evaluation.report import report
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.cascade_fit import fit_cascade
from torchcrf_scan.learning.checkpoint import Store, load_weights
from torchcrf_scan.learning.fit import fit
from torchcrf_scan.learning.gradient import train_by_gradient
from torchcrf_scan.learning.material import Material, collect
from torchcrf_scan.learning.monitor import TrainingMonitor
from torchcrf_scan.learning.own_laser import calibrate_on
from torchcrf_scan.learning.own_start import own_starts, start_anew
from torchcrf_scan.learning.ranks import ALONE, Ranks, join
from torchcrf_scan.learning.run_data import RunData, load
from torchcrf_scan.learning.run_log import WATCHED, RunLog, one_error
from torchcrf_scan.learning.selection_fit import fit_potential
from torchcrf_scan.learning.settings import AugmentConfig, Config
from torchcrf_scan.learning.staged_watch import StagedWatch
from torchcrf_scan.learning.weights_fit import Watch
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.whole_file import make_folder, write_whole

log = logging.getLogger(__name__)

Decoder = Callable[[ScanPairBatch, Start], Prediction]


def train(config: Config, *, resume: bool = False) -> dict[str, list[PairScore]]:
    """Runs a training run and writes its run folder. Returns every method's scores on the test pairs.

    Under `torchrun` the first process does the staged fit and writes; all of them share the steps of first-order training and the
    test pairs.

    Args:
        resume: continue from the checkpoint in the run folder if there is one; else start anew.
    """
    with one_error(Path(config.output)), join(config.gradient.device if config.has_steps else "cpu") as ranks:
        return train_together(config, ranks, resume=resume)


def train_together(config: Config, ranks: Ranks, *, resume: bool = False) -> dict[str, list[PairScore]]:
    """This process's share of `train`."""
    folder, resolved = make_folder("output", config.output), yaml.safe_dump(asdict(config), sort_keys=False)
    data = load(config, ranks)
    if config.overfit:
        config = replace(config, gradient=replace(config.gradient, fresh=0.0, augment=AugmentConfig.nothing()))

    began = time.perf_counter()
    store = Store(folder, settings_of(config))
    state = ranks.share(store.read() if resume and ranks.is_first else None)
    if ranks.is_first:
        if not resume:
            store.path.unlink(missing_ok=True)  # of an earlier run, which is not to be resumed
        write_whole(folder / "config.yaml", resolved)  # after the check of the settings of a resumed run
    if resume:
        log.info("going on from step %d" if state else "no checkpoint yet, beginning anew", *([state["step"]] if state else []))
    with RunLog(folder) if ranks.is_first else nullcontext() as run:
        model = JointScanCRF(config.model)
        watch = StagedWatch(run) if run is not None else None
        material = prepare(model, data.learned, config, watch, state) if watch is not None and not config.fits_init else []
        if config.has_steps:
            ranks.share_weights(model)
            first_step = state["step"] + 1 if state else None
            with TrainingMonitor(folder, config, first_step) if ranks.is_first else nullcontext() as monitor:
                train_by_gradient(model, config, data.learned, data.held_out, store, ranks, monitor, state=state)
        cascade = None
        if run is not None:
            if config.has_steps and config.gradient.refit_potential and model.config.has_association and model.config.has_clusters:
                model.cluster_potential.load_state_dict(fit_potential(model, material).state_dict())
            if config.fits_init:
                model = fit_own(model, data, config)
            else:
                calibrate(model, material)
                cascade = fit_baselines(material, config, run)
            model.save_pretrained(folder / "model")
            data.trained_on.write(folder / "model")
            log.info("fitted in %.0f s", time.perf_counter() - began)
        model.config = ranks.share(model.config)  # calibration may have set a distance of outliers
        ranks.share_weights(model)
        decoders = decoders_of(model, ranks.share(cascade))
        scores, answers = evaluate(model, decoders, data.test, config.learning.batch_size, ranks)
        if run is None:
            return scores
        tables = report(scores) if scores["joint"] else []
        show(run, watch, model, data.test, answers["joint"], config)
        run.tables("final", tables)
    if config.has_steps and scores["joint"]:
        with TrainingMonitor(folder, config, config.gradient.steps + 1) as monitor:
            monitor.finished(flatten(config))
    write_results(folder, scores, tables)
    return scores


def show(
    run: RunLog,
    watch: StagedWatch | None,
    model: JointScanCRF,
    pairs: Sequence[ScanPair],
    answers: Sequence[PairPrediction],
    config: Config,
) -> None:
    """Pictures of some pairs before and after learning, and of a staged fit its curves and its settings."""
    last = config.gradient.steps if config.has_steps else max(1, watch.last if watch is not None else 1)
    for number, k in enumerate(pairs_to_draw(pairs)):
        run.picture(pairs[k], match_start(model, [pairs[k]])[0], 0)
        run.picture(pairs[k], answers[k], last, f"{number:02d}_{pairs[k].name}")
    if watch is not None and not config.has_steps:
        watch.look_back(model, pairs)
        run.settings(flatten(config), [f"accuracy/{name}" for name in WATCHED] if pairs and watch.paths else [])


def fit_own(model: JointScanCRF, data: RunData, config: Config) -> JointScanCRF:
    """The model of `config.init` fitted to the pairs: what is kept is what helps on those left out in turn."""
    load_weights(model, config.init)
    fitted, parts = calibrate_on(model, data.train, config.staged, data.uncertain)
    for part in parts:
        told = "kept" if part.is_kept else "not kept, as pairs left out do not gain"
        log.info("%s (%s): %.0f %s left out, then %.0f: %s", part.name, part.value, part.before, part.measure, part.after, told)
    return fitted


def prepare(
    model: JointScanCRF, pairs: Sequence[ScanPair], config: Config, watch: StagedWatch, state: dict[str, Any] | None
) -> list[Material]:
    """Material from the pairs, and the initial model of first-order training: staged fit, `config.init`, or a checkpoint."""
    collection = collect(pairs, config.learning, jobs=-1)
    everything = range(len(collection))
    if state is not None:
        model.load_state_dict(state["best"] or state["model"])
    elif config.init:
        load_weights(model, config.init)
    else:
        model.hypothesis_score = collection.fit_score(everything)
    clusters = config.model.inference.clusters - 1
    material = collection.material(everything, model.hypothesis_score, clusters, config.learning)
    if state is not None or config.init:
        return start_anew(model, material, {})
    material = own_starts(model, material, config.staged)
    fit(model, material, config.staged, watch.watches())
    return material


def settings_of(config: Config) -> dict[str, str]:
    """Settings, by name, that must be equal when a run is resumed."""
    free = (
        "output",
        "compare_chains",
        "experiment.",
        *(f"gradient.{name}" for name in ("workers", "checkpoint_every", "device", "graph")),
    )
    return {name: json.dumps(value) for name, value in flatten(config).items() if not name.startswith(free)}


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Every setting by its full name."""
    found: dict[str, Any] = {}
    for of in fields(config):
        value, name = getattr(config, of.name), prefix + of.name
        found |= flatten(value, f"{name}.") if is_dataclass(value) else {name: value}
    return found


def fit_baselines(material: list[Material], config: Config, run: RunLog) -> Cascade | None:
    """Fits each chain alone if enabled, from the same start."""
    if not (config.compare_chains and config.model.has_association and config.model.has_clusters):
        return None
    learning = replace(config, learning=config.staged)
    return fit_cascade(material, learning, {method: watches(run, method) for method in ("matching", "clustering")})


def decoders_of(model: JointScanCRF, cascade: Cascade | None) -> dict[str, Decoder]:
    """The methods to evaluate: the model and, if fitted, each chain alone."""
    decoders: dict[str, Decoder] = {"joint": model}
    if cascade is not None:
        matching = cascade.matching
        decoders["CRF-Matching"] = lambda batch, start: matching(batch, start.background_alone())
        decoders["CRF-Clustering"] = cascade
    return decoders


def watches(run: RunLog, method: str) -> dict[str, Watch]:
    """Callbacks that log the weight fits of one chain alone under the method's name."""

    def watch(chain: str) -> Watch:
        def look(step: int, loss: float, slope: float, weights: Tensor) -> None:
            run.objective(f"{method}/{chain}", step, loss, slope)

        return look

    return {chain: watch(chain) for chain in ("association", "clustering")}


@torch.no_grad()
def evaluate(
    model: JointScanCRF, decoders: dict[str, Decoder], pairs: Sequence[ScanPair], batch_size: int, ranks: Ranks = ALONE
) -> tuple[dict[str, list[PairScore]], dict[str, list[PairPrediction]]]:
    """Scores and predictions of every method on the pairs, all from the start found by `model`.

    Batches are distributed to the processes; each of them returns everything.
    """
    found: dict[str, dict[int, PairPrediction]] = {method: {} for method in decoders}
    model.eval()
    begins = range(0, len(pairs), batch_size)[ranks.rank :: ranks.world]
    for k in tqdm(begins, desc="test", unit="batch", leave=False, disable=not ranks.is_first):
        part = pairs[k : k + batch_size]
        batch = ScanPairBatch.collate(part).without_truth()
        start = model.initialise(batch)
        for method, decode in decoders.items():
            prediction = decode(batch, start)
            found[method] |= {k + b: prediction.pair(b, pair) for b, pair in enumerate(part)}
    answers: dict[str, list[PairPrediction]] = {}
    everyone = ranks.gather(found)
    for method in decoders:
        together = {k: answer for of_rank in everyone for k, answer in of_rank[method].items()}
        answers[method] = [together[k] for k in range(len(pairs))]
    scores = {method: score_pairs(pairs, of_method) for method, of_method in answers.items()}
    return scores, answers


def pairs_to_draw(pairs: Sequence[ScanPair], most: int = 4) -> list[int]:
    """The first pair of each of the first sequences."""
    first: dict[str, int] = {}
    for k, pair in enumerate(pairs):
        first.setdefault(pair.sequence, k)
    return list(first.values())[:most]


def write_results(folder: Path, scores: dict[str, list[PairScore]], tables: Sequence[Table]) -> None:
    """Writes `metrics.json`, `tables.md` and `versions.json`, each atomically."""
    metrics = {method: summarise(of_method) for method, of_method in scores.items() if of_method}
    contents = {
        "metrics.json": json.dumps(metrics, indent=2) + "\n",
        "tables.md": "\n\n".join(table.to_markdown() for table in tables) + "\n",
        "versions.json": json.dumps(versions(), indent=2) + "\n",
    }
    for name, content in contents.items():
        write_whole(folder / name, content)


def versions() -> dict[str, str]:
    """Versions of the packages used and of the code."""
    found = {name: version(name) for name in ("torchcrf-scan", "torch", "numpy", "scikit-learn", "scipy")}
    return {"python": platform.python_version(), **found, "git": commit() or "unknown"}


def commit() -> str:
    """The commit of the code; empty without git, or outside of a repository."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent, check=False).stdout.strip()
    except OSError:
        return ""
