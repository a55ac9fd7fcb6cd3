"""Batches for first-order training, made by worker processes: collated, displaced, disturbed and surveyed."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.utils.data import DataLoader

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.learning.disturb import disturb
from torchcrf_scan.learning.stream import PairStream, Parts, Sample, seed_of
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.pairs import survey
from torchcrf_scan.search.survey import Survey


@dataclass(frozen=True, slots=True)
class Portion:
    """A batch to learn from.

    Attributes:
        surveys: what InitialiseRT looks at in its pairs, none where nobody needs it. seed: of what is drawn beside it.
    """

    batch: ScanPairBatch
    surveys: tuple[Survey | None, ...] = ()
    seed: int = 0

    def to(self, device: torch.device) -> Portion:
        """The batch on another device. Surveys stay, they are looked at where they were made."""
        return self if device.type == "cpu" else replace(self, batch=self.batch.to(device))


@dataclass(frozen=True)
class Collate:
    """Makes a batch of samples, in the worker: frames displaced, scans disturbed, surveyed where the loss needs a start.

    Attributes:
        disturbance: see `learning.disturbance`. seed: of all that is drawn. surveys: whether to look for motions.
    """

    disturbance: float = 0.0
    seed: int = 0
    surveys: bool = False

    def __call__(self, samples: Sequence[Sample]) -> Portion:
        """The portion of the samples, of which the first one's index decides how they are disturbed."""
        batch = ScanPairBatch.collate([sample.pair for sample in samples])
        offset = torch.from_numpy(np.stack([sample.offset for sample in samples])).to(batch.source)
        batch = batch.displaced(offset) if bool(offset.any()) else batch
        if self.disturbance > 0:
            generator = torch.Generator().manual_seed(seed_of(self.seed, samples[0].index, 2))
            batch = disturb(batch, self.disturbance, generator)
        surveys = tuple(survey(batch)) if self.surveys else ()
        return Portion(batch, surveys, seed_of(self.seed, samples[0].index, 3))


def load_portions(stream: PairStream, parts: Parts, collate: Collate, workers: int) -> Iterator[Portion]:
    """The parts in their order, generated ahead by `workers` processes, or here where there are none."""
    if not workers:
        return (collate([stream[k] for k in part]) for part in parts)
    loader: DataLoader[Portion] = DataLoader(
        stream,  # type: ignore[arg-type]  # samples go in, portions come out
        batch_sampler=parts,
        collate_fn=collate,
        num_workers=workers,
        multiprocessing_context="spawn",  # a fork takes over the locks of threads that it does not have
        worker_init_fn=calm_worker,
    )
    return iter(loader)


def calm_worker(worker: int) -> None:
    """One thread a worker; its random state decides nothing, since every sample brings its own. It ends with its parent.

    A worker whose parent was killed would wait for ever for somebody to take what it has made.
    """
    torch.set_num_threads(1)
    threading.Thread(target=leave_with, args=(os.getppid(),), daemon=True).start()


def leave_with(parent: int) -> None:
    """Ends this process, at once and whatever it does, when its parent has gone."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def as_portion(pairs: Sequence[ScanPair]) -> Portion:
    """Pairs as they are, surveyed."""
    batch = ScanPairBatch.collate(pairs)
    return Portion(batch, tuple(survey(batch)))
