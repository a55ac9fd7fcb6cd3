"""Trains the model on simulated or recorded scan pairs and evaluates it on pairs of other sequences.

    python train.py
    python train.py --config configs/real.yaml --data.train 'PAIRS/datmo_overtakes_*.npz' --data.test 'PAIRS/kitti0001_*.npz'
    python train.py --config configs/unrolled.yaml
    python train.py --config configs/unrolled.yaml --resume
    torchrun --nproc-per-node 2 train.py --config configs/unrolled.yaml
    python train.py --help

The run folder (`--output`) holds the resolved config, versions, model, metrics, tables, pictures and TensorBoard events, and, for
first-order training (`--gradient.objective`, `--learning.objective unrolled`), a checkpoint: `--resume` continues an interrupted
run with the same result as an uninterrupted one.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence

from torchcrf_scan.commands.parser import CommandParser
from torchcrf_scan.evaluation.report import report
from torchcrf_scan.experiment.parser import config_of, settings_parser
from torchcrf_scan.learning.trainer import train
from torchcrf_scan.safe_names import one_line


def main(argv: Sequence[str] | None = None) -> int:
    """Parses the settings, trains and prints the tables. Returns 0, or 1 for bad input; bad settings exit with code 2."""
    parser = settings_parser(CommandParser, description=__doc__)
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the run folder")
    settings = parser.parse_args(argv)
    try:
        config = config_of(parser.instantiate(settings))
    except ValueError as error:
        parser.error(one_line(error))

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        scores = train(config, resume=settings.resume)
    except (ValueError, OSError) as error:
        print(f"train.py: error: {one_line(error)}", file=sys.stderr)
        return 1
    if int(os.environ.get("RANK", 0)) == 0:  # the first process of torchrun
        for table in report(scores) if any(scores.values()) else ():  # without test pairs there is nothing to tell
            print(table.to_markdown(), end="\n\n")
        print(f"run folder: {config.output}  (tensorboard --logdir {config.output})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
