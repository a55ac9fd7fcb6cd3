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
        surveys: of InitialiseRT in its pairs, empty if not needed. seed: of further random draws.
    """

    batch: ScanPairBatch
    surveys: tuple[Survey | None, ...] = ()
    seed: int = 0

    def to(self, device: torch.device) -> Portion:
        """The batch on another device. Surveys stay on the CPU."""
        return self if device.type == "cpu" else replace(self, batch=self.batch.to(device))


@dataclass(frozen=True)
class Collate:
    """Makes a batch of samples in the worker: displaces frames, disturbs scans, and surveys them if the loss needs a start.

    Attributes:
        disturbance: see `learning.disturbance`. seed: of all random draws. surveys: whether to run the search for motions.
    """

    disturbance: float = 0.0
    seed: int = 0
    surveys: bool = False

    def __call__(self, samples: Sequence[Sample]) -> Portion:
        """The portion of the samples; the index of the first one seeds the disturbance."""
        batch = ScanPairBatch.collate([sample.pair for sample in samples])
        offset = torch.from_numpy(np.stack([sample.offset for sample in samples])).to(batch.source)
        batch = batch.displaced(offset) if bool(offset.any()) else batch
        if self.disturbance > 0:
            generator = torch.Generator().manual_seed(seed_of(self.seed, samples[0].index, 2))
            batch = disturb(batch, self.disturbance, generator)
        surveys = tuple(survey(batch)) if self.surveys else ()
        return Portion(batch, surveys, seed_of(self.seed, samples[0].index, 3))


def load_portions(stream: PairStream, parts: Parts, collate: Collate, workers: int) -> Iterator[Portion]:
    """The parts in their order, generated ahead by `workers` processes, or in this one for 0."""
    if not workers:
        return (collate([stream[k] for k in part]) for part in parts)
    loader: DataLoader[Portion] = DataLoader(
        stream,  # type: ignore[arg-type]  # samples go in, portions come out
        batch_sampler=parts,
        collate_fn=collate,
        num_workers=workers,
        multiprocessing_context="spawn",  # a fork would copy locks held by threads that do not exist in it
        worker_init_fn=calm_worker,
    )
    return iter(loader)


def calm_worker(worker: int) -> None:
    """Limits a worker to one thread; its random state has no effect, as every sample is seeded. It ends with its parent.

    Otherwise a worker whose parent was killed would wait for ever for its results to be fetched.
    """
    torch.set_num_threads(1)
    threading.Thread(target=leave_with, args=(os.getppid(),), daemon=True).start()


def leave_with(parent: int) -> None:
    """Ends this process immediately once its parent has ended."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def as_portion(pairs: Sequence[ScanPair]) -> Portion:
    """A portion of undisturbed pairs, surveyed."""
    batch = ScanPairBatch.collate(pairs)
    return Portion(batch, tuple(survey(batch)))
