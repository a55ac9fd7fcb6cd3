"""A first-order run of seconds, for tests that kill it or share it out."""

import argparse
import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import torch

from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning import checkpoint
from torchcrf_scan.learning.checkpoint import Store
from torchcrf_scan.learning.gradient import Learner, Report, train_by_gradient
from torchcrf_scan.learning.ranks import ALONE, Ranks, join
from torchcrf_scan.learning.settings import Config, GradientConfig, UnrolledConfig
from torchcrf_scan.learning.trainer import settings_of
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

GRADIENT = GradientConfig(
    objective="pseudo_likelihood", steps=6, batch_size=4, part=2, workers=0, warmup=2, fresh=0.0, validate_every=2, patience=0,
    checkpoint_every=2, graph=False, learning_rate=0.05, clip=0.5,
)  # fmt: skip


def small_config(**gradient: object) -> Config:
    return Config(
        model=ModelConfig(features=FeatureConfig(stumps=4), inference=InferenceConfig(clusters=4, iterations=2, backend="eager")),
        gradient=replace(GRADIENT, **gradient),  # type: ignore[arg-type]
        unrolled=UnrolledConfig(iterations=2),
    )


def small_pairs() -> tuple[list[ScanPair], list[ScanPair]]:
    """Four pairs of two sequences to train on, two of another to validate."""
    pairs = simulate_pairs(SimulatorConfig(beams=31), 6, 3, 3)
    return pairs[:4], pairs[4:]


class Watcher:
    """Keeps every report; kills its process after a step where it is told to."""

    def __init__(self, kill_after: int | None = None) -> None:
        self.kill_after = kill_after
        self.reports: list[Report] = []
        self.validations: list[tuple[int, float]] = []

    def stepped(self, model: JointScanCRF, report: Report) -> None:
        self.reports.append(report)
        if report.step == self.kill_after:
            os.kill(os.getpid(), signal.SIGKILL)

    def validated(self, step: int, model: JointScanCRF, losses: dict[str, float], answers: object) -> None:
        self.validations.append((step, losses["total"]))


def run(
    folder: Path, config: Config, ranks: Ranks = ALONE, *, resume: bool = False, kill_after: int | None = None
) -> tuple[Learner, Watcher]:
    torch.manual_seed(0)
    model = JointScanCRF(config.model)
    store, watcher = Store(folder, settings_of(config)), Watcher(kill_after)
    train, held_out = small_pairs()
    held_out = held_out if config.gradient.validation else []
    state = store.read() if resume else None
    return train_by_gradient(model, config, train, held_out, store, ranks, watcher, state=state), watcher


def kill_in_write(step: int) -> None:
    """From now on, the process is killed when the checkpoint of that step is written but has not got its place yet."""
    replace_file, path = os.replace, checkpoint.NAME
    count = {"left": step // GRADIENT.checkpoint_every}

    def replace_or_die(old: Path, new: Path) -> None:
        if Path(new).name == path:
            if count["left"] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            count["left"] -= 1
        replace_file(old, new)

    os.replace = replace_or_die  # type: ignore[assignment]


def main(arguments: list[str]) -> None:
    """A run that writes its losses: FOLDER [--kill-after STEP] [--kill-in-write STEP] [--GRADIENT_SETTING VALUE ...]."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kill-after", type=int)
    parser.add_argument("--kill-in-write", type=int)
    known, rest = parser.parse_known_args(arguments)
    names = [name.removeprefix("--") for name in rest[::2]]
    changes = {name: type(getattr(GRADIENT, name))(value) for name, value in zip(names, rest[1::2], strict=True)}
    known.folder.mkdir(parents=True, exist_ok=True)
    if known.kill_in_write is not None:
        kill_in_write(known.kill_in_write)
    with join("cpu") as ranks:
        _, watcher = run(known.folder, small_config(**changes), ranks, kill_after=known.kill_after)
        if ranks.is_first:
            curve = {"loss": [report.terms["total"] for report in watcher.reports], "validation": watcher.validations}
            (known.folder / "curve.json").write_text(json.dumps(curve))
