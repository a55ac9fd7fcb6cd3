"""The pairs of a training run: read, simulated, or labelled by a stream; and the check that none is both learned and tested."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.data.dataset import PairFiles, split_by_sequence
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.learning.leaks import TrainedOn
from torchcrf_scan.learning.ranks import Ranks
from torchcrf_scan.learning.self_labelled import label_recordings
from torchcrf_scan.learning.settings import Config, DataConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.stream.config import StreamConfig

log = logging.getLogger(__name__)

TEST_SEED = 10_000  # first seed of simulated test worlds, far from those of training


@dataclass(frozen=True, slots=True)
class RunData:
    """The pairs of a run.

    Attributes:
        train: annotated ones. uncertain: those of recordings that nobody annotated. held_out: for validation. test: others.
        trained_on: sequences of all that the model learns from, that of `init` included.
    """

    train: list[ScanPair]
    uncertain: list[ScanPair]
    held_out: list[ScanPair]
    test: list[ScanPair]
    trained_on: TrainedOn

    @property
    def learned(self) -> list[ScanPair]:
        """All pairs that are learned from."""
        return self.train + self.uncertain


def load(config: Config, ranks: Ranks) -> RunData:
    """The pairs of a run, the same in every process.

    Raises:
        TorchCRFScanError: none to learn from, a sequence both learned from and tested, or too few sequences to hold one out.
    """
    trained_on = TrainedOn.of_model(config.init)  # fails early if there is no such model
    train, test = load_annotated(config.data)
    if config.overfit:
        return RunData(train[:1], [], [], train[:1], trained_on.plus(train[:1]))
    TrainedOn().plus(train).refuse(test, "data")
    trained_on.refuse(test, f"init {config.init}")
    uncertain = ranks.share(label_unlabelled(config, train) if ranks.is_first else [])
    TrainedOn().plus(uncertain).refuse(test, "data.unlabelled")
    kept, held_out = hold_out(train, config)
    log.info("%d training pairs, %d validation pairs, %d test pairs", len(kept) + len(uncertain), len(held_out), len(test))
    return RunData(kept, uncertain, held_out, test, trained_on.plus([*train, *uncertain]))


def load_annotated(config: DataConfig) -> tuple[list[ScanPair], list[ScanPair]]:
    """Training and test pairs with annotation: files, then simulated worlds."""
    if not (config.train or config.simulate_train or config.unlabelled):
        raise TorchCRFScanError("data.simulate_train: expected a world at least where data.train names no files, got none")

    def read(patterns: tuple[str, ...] | str, worlds: tuple[str, ...], seed: int) -> list[ScanPair]:
        pairs = read_files(patterns)
        for k, world in enumerate(worlds):
            pairs += simulate_pairs(NAMED_WORLDS[world], config.pairs, config.sequences, seed + k)
        return pairs

    return (
        read(config.train, config.simulate_train, config.seed),
        read(config.test, config.simulate_test, config.seed + TEST_SEED),
    )


def read_files(patterns: tuple[str, ...] | str) -> list[ScanPair]:
    """The pairs of files, folders or glob patterns; none without a pattern."""
    patterns = (patterns,) if isinstance(patterns, str) else patterns
    return list(PairFiles(*patterns)) if patterns else []


def label_unlabelled(config: Config, annotated: Sequence[ScanPair]) -> list[ScanPair]:
    """Pairs of `data.unlabelled` with the labels of a stream, by the model of `init` or the default one.

    Their scans are as far apart as those of the annotated pairs usually are, or as the stream matches them.
    """
    paths = (config.data.unlabelled,) if isinstance(config.data.unlabelled, str) else config.data.unlabelled
    if not any(paths):
        return []
    seconds = float(np.median([pair.dt for pair in annotated])) if annotated else StreamConfig().lag
    model = JointScanCRF.from_pretrained(config.init or PRETRAINED)
    pairs = label_recordings(model, [path for path in paths if path], config.data.unlabelled_pairs, seconds)
    log.info("%d pairs of recordings that nobody annotated", len(pairs))
    return pairs


def hold_out(pairs: list[ScanPair], config: Config) -> tuple[list[ScanPair], list[ScanPair]]:
    """Training and validation pairs, sequences whole; all for training without first-order training.

    Raises:
        TorchCRFScanError: too few sequences to hold one out.
    """
    if not config.has_steps or config.gradient.validation == 0:
        return pairs, []
    try:
        return split_by_sequence(pairs, config.gradient.validation, config.gradient.seed)
    except ValueError as error:
        raise TorchCRFScanError(f"gradient.validation: {error}") from error
