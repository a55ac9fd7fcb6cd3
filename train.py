"""Trains the model on simulated or recorded scan pairs and evaluates it on pairs of other sequences.

    python train.py
    python train.py --config configs/real.yaml --data.train 'PAIRS/datmo_overtakes_*.npz' --data.test 'PAIRS/kitti0001_*.npz'
    python train.py --config configs/unrolled.yaml
    python train.py --config configs/unrolled.yaml --resume
    torchrun --nproc-per-node 2 train.py --config configs/unrolled.yaml
    python train.py --help

The run folder (`--output`) holds the resolved config, versions, model, metrics, tables, pictures and TensorBoard events, and where
there are first-order steps (`--gradient.objective`, `--learning.objective unrolled`) a checkpoint: a run that was killed goes on
with `--resume` and ends as it would have.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

from jsonargparse import ArgumentParser

from torchcrf_scan.evaluation.report import report
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.learning.trainer import train


def main(argv: Sequence[str] | None = None) -> None:
    """Parses the settings, trains, prints the tables."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--config", action="config", help="YAML file of settings")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the run folder")
    parser.add_class_arguments(RunConfig)
    settings = parser.parse_args(argv)
    resume = settings.pop("resume")
    try:
        config = RunConfig(**{k: v for k, v in parser.instantiate(settings).items() if k not in ("config", "resume")})
    except ValueError as error:
        parser.error(str(error))

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = Path(config.output)
    is_first = int(os.environ.get("RANK", 0)) == 0  # of the processes that torchrun started
    if is_first:
        folder.mkdir(parents=True, exist_ok=True)
        parser.save(settings, folder / "config.yaml", overwrite=True, skip_validation=True)

    scores = train(config, resume=resume)
    if not is_first:
        return
    for table in report(scores):
        print(table.to_markdown(), end="\n\n")
    print(f"run folder: {folder}  (tensorboard --logdir {folder})")


if __name__ == "__main__":
    main()
