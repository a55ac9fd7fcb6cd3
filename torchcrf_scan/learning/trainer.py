"""One training run: data, fit, evaluation, run folder. `train.py` is its entry."""

from __future__ import annotations

import json
import logging
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.batch import Prediction, ScanPairBatch
from torchcrf_scan.config import WORLDS, Config, DataConfig
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.evaluation.metrics import PairScore, score_pair
from torchcrf_scan.evaluation.report import Table, report
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.inference.initialise import Start
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.cascade_fit import fit_cascade
from torchcrf_scan.learning.fit import fit
from torchcrf_scan.learning.material import Material, collect
from torchcrf_scan.learning.weights_fit import Watch
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.viz.tensorboard import RunLog

log = logging.getLogger(__name__)

TEST_SEED = 10_000  # simulated test worlds start here, far from those of training
Decoder = Callable[[ScanPairBatch, Start], Prediction]


def train(config: Config) -> dict[str, list[PairScore]]:
    """Runs the whole of `config` and leaves the run folder behind. Returns every method's scores on the test pairs."""
    folder = Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    train_pairs, test_pairs = load_data(config.data)
    if config.overfit:
        train_pairs = test_pairs = train_pairs[:1]
    else:
        refuse_leaks(train_pairs, test_pairs)
    log.info("%d training pairs, %d test pairs", len(train_pairs), len(test_pairs))

    began = time.perf_counter()
    with RunLog(folder) as run:
        model = JointScanCRF(config.model)
        collection = collect(train_pairs, config.learning, jobs=-1, backend=config.model.inference.backend)
        everything = range(len(collection))
        model.hypothesis_score = collection.fit_score(everything)
        clusters = config.model.inference.clusters - 1
        material = collection.material(everything, model.hypothesis_score, clusters, config.learning)
        decoders = fit_methods(model, material, config, run)
        model.save_pretrained(folder / "model")
        log.info("fitted in %.0f s", time.perf_counter() - began)

        scores, answers = evaluate(model, decoders, test_pairs, config.learning.batch_size)
        for step, k in enumerate(pairs_to_draw(test_pairs)):
            run.picture(test_pairs[k], answers["joint"][k], step)
        for method, of_method in scores.items():
            run.metrics(method, summarise(of_method))
    tables = report(scores) if scores["joint"] else []
    write_results(folder, scores, tables)
    return scores


def load_data(config: DataConfig) -> tuple[list[ScanPair], list[ScanPair]]:
    """Training and test pairs: files, then simulated worlds."""

    def load(patterns: tuple[str, ...] | str, worlds: tuple[str, ...], seed: int) -> list[ScanPair]:
        patterns = (patterns,) if isinstance(patterns, str) else patterns
        pairs = list(PairFiles(*patterns)) if patterns else []
        for k, world in enumerate(worlds):
            pairs += simulate_pairs(WORLDS[world], config.pairs, config.sequences, seed + k)
        return pairs

    return (
        load(config.train, config.simulate_train, config.seed),
        load(config.test, config.simulate_test, config.seed + TEST_SEED),
    )


def refuse_leaks(train_pairs: Sequence[ScanPair], test_pairs: Sequence[ScanPair]) -> None:
    """Raises ValueError where a sequence is on both sides: its pairs overlap in time."""
    both = sorted({pair.sequence for pair in train_pairs} & {pair.sequence for pair in test_pairs})
    if both:
        raise ValueError(f"data: expected no sequence in both training and test pairs, got {', '.join(both[:5])}")


def fit_methods(model: JointScanCRF, material: list[Material], config: Config, run: RunLog) -> dict[str, Decoder]:
    """Fits the joint model and how sure it is, and each chain alone where asked for, from the same start."""
    fit(model, material, config.learning, watches(run, "joint"))
    calibrate(model, material)
    decoders: dict[str, Decoder] = {"joint": model}
    if config.compare_chains and config.model.chains == "joint":
        cascade = fit_cascade(material, config, {method: watches(run, method) for method in ("matching", "clustering")})
        decoders["CRF-Matching"] = lambda batch, start: cascade.matching(batch, start.background_alone())
        decoders["CRF-Clustering"] = cascade
    return decoders


def watches(run: RunLog, method: str) -> dict[str, Watch]:
    """Callbacks that log the weight fits under the method's name."""

    def watch(chain: str) -> Watch:
        def look(step: int, loss: float, slope: float, weights: Tensor) -> None:
            run.objective(f"{method}/{chain}", step, loss, slope, weights)

        return look

    return {chain: watch(chain) for chain in ("association", "clustering", "lattice")}


@torch.no_grad()
def evaluate(
    model: JointScanCRF, decoders: dict[str, Decoder], pairs: Sequence[ScanPair], batch_size: int
) -> tuple[dict[str, list[PairScore]], dict[str, list[PairPrediction]]]:
    """Scores and answers of every method on the pairs, all from the start that `model` finds."""
    answers: dict[str, list[PairPrediction]] = {method: [] for method in decoders}
    model.eval()
    for k in tqdm(range(0, len(pairs), batch_size), desc="test", unit="batch", leave=False):
        part = pairs[k : k + batch_size]
        batch = ScanPairBatch.collate(part).without_truth()
        start = model.initialise(batch)
        for method, decode in decoders.items():
            prediction = decode(batch, start)
            answers[method] += [prediction.pair(b, pair) for b, pair in enumerate(part)]
    scores = {
        method: [score_pair(pair, answer) for pair, answer in zip(pairs, of_method, strict=True)]
        for method, of_method in answers.items()
    }
    return scores, answers


def pairs_to_draw(pairs: Sequence[ScanPair], most: int = 4) -> list[int]:
    """The first pair of each of the first sequences."""
    first: dict[str, int] = {}
    for k, pair in enumerate(pairs):
        first.setdefault(pair.sequence, k)
    return list(first.values())[:most]


def write_results(folder: Path, scores: dict[str, list[PairScore]], tables: Sequence[Table]) -> None:
    """`metrics.json`, `tables.md`, `versions.json`; each whole or not at all."""
    metrics = {method: summarise(of_method) for method, of_method in scores.items()}
    contents = {
        "metrics.json": json.dumps(metrics, indent=2) + "\n",
        "tables.md": "\n\n".join(table.to_markdown() for table in tables) + "\n",
        "versions.json": json.dumps(versions(), indent=2) + "\n",
    }
    for name, content in contents.items():
        temporary = folder / f".{name}.{os.getpid()}"
        temporary.write_text(content)
        os.replace(temporary, folder / name)


def versions() -> dict[str, str]:
    """What the run was made with."""
    found = {name: version(name) for name in ("torchcrf-scan", "torch", "numpy", "scikit-learn", "scipy")}
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    ).stdout.strip()
    return {"python": platform.python_version(), **found, "git": commit or "unknown"}
