"""Annotated pairs made from a seed or by hand, and predictions of them, good and bad."""

import dataclasses
from collections.abc import Callable

import numpy as np

from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair


def make_scan(n: int, rng: np.random.Generator, drop: float = 0.0) -> Scan:
    ranges = rng.uniform(2.0, 20.0, n)
    ranges[rng.random(n) < drop] = np.nan
    return Scan.from_ranges(ranges, np.linspace(-1.5, 1.5, n))


def make_pair(n: int, m: int, movers: int, rng: np.random.Generator, drop: float = 0.0) -> ScanPair:
    """A pair with runs of labels, outliers, ignored beams and, if `drop` > 0, beams without a return."""
    source, target = make_scan(n, rng, drop), make_scan(m, rng, drop)
    is_return = source.to_beams(np.ones(len(source), bool), False)
    body = np.repeat(rng.integers(0, movers + 1, n // 6 + 1), 6)[:n]
    is_outlier = (rng.random(n) < 0.2) | ~is_return | (len(target) == 0)
    nearest = target.beam[rng.integers(0, max(len(target), 1), n)] if len(target) else np.full(n, -1)
    motions = rng.normal(0.0, 0.3, (movers + 1, 3))
    cluster = np.where(is_outlier, -1, body)
    annotation = Annotation(np.where(is_outlier, -1, nearest), cluster, motions, body, rng.random(n) < 0.1)
    return ScanPair(source, target, annotation=annotation, sequence="made up", name="pair")


def make_prediction(association: np.ndarray, cluster: np.ndarray, motions: np.ndarray) -> PairPrediction:
    return PairPrediction(association, cluster, motions, np.ones(len(association)), np.ones(len(cluster)), True)


def perfect(pair: ScanPair) -> PairPrediction:
    truth = annotation_of(pair)
    return make_prediction(truth.association, truth.cluster, truth.motions)


def perturbed(pair: ScanPair, rng: np.random.Generator, flips: float = 0.2) -> PairPrediction:
    """The truth with shifted and lost associations, wrong clusters, other mover numbers and noise on the motions."""
    truth, n, m = annotation_of(pair), pair.source.n_beams, pair.target.n_beams
    shifted = np.clip(truth.association + rng.integers(-3, 4, n) * (rng.random(n) < 0.5), -1, m - 1)
    association = np.where(truth.association < 0, -1, shifted)
    association = np.where(rng.random(n) < flips / 2, rng.integers(-1, m, n), association)
    cluster = np.where(rng.random(n) < flips, rng.integers(-1, 4, n), truth.cluster)
    order = np.append(0, 1 + rng.permutation(max(3, len(truth.motions) - 1)))
    motions = np.full((len(order), 3), np.nan)
    motions[order[: len(truth.motions)]] = truth.motions + rng.normal(0.0, 0.01, truth.motions.shape)
    return make_prediction(association, np.where(cluster < 0, -1, order[cluster]), motions)


def no_movers(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    truth = annotation_of(pair)
    return make_prediction(truth.association, np.minimum(truth.cluster, 0), truth.motions[:1] + 0.02)


def motion_rows_missing(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    whole = perturbed(pair, rng, flips=0.05)
    return dataclasses.replace(whole, motions=whole.motions[:1])


def all_outliers(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    n = pair.source.n_beams
    return make_prediction(np.full(n, -1), np.full(n, -1), np.zeros((1, 3)))


def random_labels(pair: ScanPair, rng: np.random.Generator) -> PairPrediction:
    n = pair.source.n_beams
    return make_prediction(rng.integers(-1, pair.target.n_beams, n), rng.integers(-1, 5, n), rng.normal(0, 0.1, (5, 3)))


PREDICTORS: tuple[Callable[[ScanPair, np.random.Generator], PairPrediction], ...] = (
    perturbed,
    no_movers,
    motion_rows_missing,
    all_outliers,
    random_labels,
)


def make_small() -> ScanPair:
    """Twelve points: five of the background, five of a mover, two outliers; the last is ignored."""
    scan = Scan.from_ranges(np.full(12, 2.0), np.linspace(-1.0, 1.0, 12))
    association = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, -1, -1])
    cluster = np.array([0] * 5 + [1] * 5 + [-1] * 2)
    body = np.where(cluster < 0, 1, cluster)
    motions = np.array([[0.0, 0.1, 0.0], [0.0, 1.0, 0.0]])
    return ScanPair(scan, scan, annotation=Annotation(association, cluster, motions, body, np.arange(12) == 11))
