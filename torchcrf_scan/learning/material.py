"""Annotated pairs prepared for learning: surveyed once, then reused by any number of folds and models."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from joblib import Parallel, delayed
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.disturb import disturb
from torchcrf_scan.learning.hypothesis_fit import HypothesisView, fit_hypothesis_score, view_pair
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import choose, survey
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.survey import Survey

PART = 4  # pairs per job


@dataclass(frozen=True, slots=True)
class Material:
    """A batch of annotated pairs with its start; `fold` is its fold for out-of-fold margins, `pairs` are undisturbed."""

    batch: ScanPairBatch
    start: Start
    fold: int
    pairs: tuple[ScanPair, ...]

    @property
    def counts(self) -> Tensor:
        """(B,) how much every pair counts."""
        return torch.tensor([1.0 if pair.annotation is None else pair.annotation.weight for pair in self.pairs])


@dataclass(frozen=True, slots=True)
class Collection:
    """Annotated pairs with expensive results that depend neither on other pairs nor on learned parameters.

    Attributes:
        pairs: all P pairs, undisturbed. batch: the same, disturbed as by moving sensors.
        surveys: P results of the search of InitialiseRT in the disturbed pairs.
        views: P lists of examples for the movers' score.
    """

    pairs: tuple[ScanPair, ...]
    batch: ScanPairBatch
    surveys: tuple[Survey | None, ...]
    views: tuple[list[HypothesisView], ...]

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pairs."""
        return tuple(pair.name for pair in self.pairs)

    @property
    def sequences(self) -> tuple[str, ...]:
        """Sequences of the pairs."""
        return tuple(pair.sequence for pair in self.pairs)

    def fit_score(self, index: Iterable[int]) -> HypothesisScore:
        """The score of movers' hypotheses, fitted on some of the pairs."""
        return fit_hypothesis_score([view for k in index for view in self.views[k]])

    def material(self, index: Sequence[int], score: HypothesisScore, clusters: int, config: LearningConfig) -> list[Material]:
        """Batches of some of the pairs, each within one fold, with the start selected by the score.

        clusters: C, background included.
        """
        folds = assign_folds([self.pairs[k].sequence for k in index], config.folds)
        material = []
        for fold in sorted(set(folds)):
            part = [k for k, of in zip(index, folds, strict=True) if of == fold]
            for begin in range(0, len(part), config.batch_size):
                rows = part[begin : begin + config.batch_size]
                batch = self.batch.select(torch.tensor(rows))
                start = choose(batch, [self.surveys[k] for k in rows], score_of(score), clusters)
                material.append(Material(batch, start, fold, tuple(self.pairs[k] for k in rows)))
        return material


def collect(pairs: Sequence[ScanPair], config: LearningConfig, jobs: int = 1) -> Collection:
    """Surveys the pairs on `jobs` cores (-1: all); random draws for a pair do not depend on `jobs`.

    Raises:
        TorchCRFScanError: a pair without annotation, or no pair.
    """
    bare = [pair.name for pair in pairs if pair.annotation is None]
    if bare or not pairs:
        raise TorchCRFScanError(f"pairs: expected annotated pairs, got {bare[:3] or 'none'}")
    batch = ScanPairBatch.collate(pairs)
    if config.disturbance > 0:
        batch = disturb(batch, config.disturbance, torch.Generator().manual_seed(config.seed))
    parts = [range(k, min(k + PART, len(pairs))) for k in range(0, len(pairs), PART)]
    tasks = (
        delayed(_look)(batch.select(torch.tensor(part)), [pairs[k] for k in part], [config.seed + k for k in part])
        for part in parts
    )
    found = Parallel(n_jobs=jobs, return_as="generator")(tasks)
    surveys: list[Survey | None] = []
    views: list[list[HypothesisView]] = []
    for of_surveys, of_views in tqdm(found, total=len(parts), desc="InitialiseRT", unit="batch", leave=False):
        surveys += of_surveys
        views += of_views
    return Collection(tuple(pairs), batch, tuple(surveys), tuple(views))


def _look(
    batch: ScanPairBatch, pairs: Sequence[ScanPair], seeds: Sequence[int]
) -> tuple[list[Survey | None], list[list[HypothesisView]]]:
    return survey(batch), [view_pair(pair, seed) for pair, seed in zip(pairs, seeds, strict=True)]


def assign_folds(sequences: Sequence[str], folds: int) -> list[int]:
    """A fold for every pair, given its sequence; sequences stay whole and are distributed by size; a single one gives one fold."""
    sizes: dict[str, int] = {}
    for sequence in sequences:
        sizes[sequence] = sizes.get(sequence, 0) + 1
    load = [0] * max(1, min(folds, len(sizes)))
    fold_of = {}
    for sequence in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold_of[sequence] = load.index(min(load))
        load[fold_of[sequence]] += sizes[sequence]
    return [fold_of[sequence] for sequence in sequences]
