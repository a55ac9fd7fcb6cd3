"""Fits a saved model to one laser on a few annotated pairs: weights, distance of outliers, scales, movers' worth, confidences.

Few pairs must not make a model worse. Every part is fitted on some of the pairs and measured on those left out, in turn, at
several shares of the way from the model's own values to the fitted ones; it is kept, at the best share, only where the pairs left
out gain by more than one standard error and no more points of movers are lost. The parts are fitted one after the other, each on
the model with those before it. For the distance, one number with a sharp optimum, any gain suffices.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.calibration import rightness
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.uncertainty import WITHIN
from torchcrf_scan.learning.calibration_fit import Judged, fit_confidence, judge
from torchcrf_scan.learning.fit import refit
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.scales_fit import fit_scales
from torchcrf_scan.learning.selection_fit import fit_potential, judge_clusters
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.scan import Floats, ScanPair

FOLDS = 5  # at most
FEWEST_MOVERS = 10  # true ones, and false ones, to fit their worth on
SHARES = (0.25, 0.5, 1.0)  # of the way to the fitted values
DISTANCES = tuple(0.02 * 1.2**k for k in range(28))  # metres, up to 2.7
AGAIN = (0.25, 0.5, 0.25)  # weights of a distance's errors and its neighbours': one pair must not pick a lucky one
IN_LOGARITHMS = ("local", "pairwise", "cluster_distance", "outlier_threshold", "gate", "neighbour_weight", "neighbour_distance")

FitPart = Callable[[JointScanCRF, "Given"], tuple[JointScanCRF, "Part"]]
Values = Mapping[str, Tensor]  # by their name in the model's state
Fit = Callable[[JointScanCRF, Sequence[ScanPair]], Values | None]  # a part's fitted values; None: too little to fit on


@dataclass(frozen=True, slots=True)
class Part:
    """What the pairs left out say of one part of the calibration.

    Attributes:
        name: of the part. measure: what `before` and `after` are sums of, over all pairs, each left out once.
        value: the fitted values in words. is_kept: whether the model has them now.
    """

    name: str
    measure: str
    before: float
    after: float
    value: str
    is_kept: bool


@dataclass(frozen=True, slots=True)
class Given:
    """Pairs to fit on.

    Attributes:
        pairs: those that are measured, left out in turn. folds: (F,) rows of them, one list a turn.
        also: pairs with uncertain labels, never left out and never measured.
    """

    pairs: Sequence[ScanPair]
    folds: Sequence[list[int]]
    also: Sequence[ScanPair] = ()

    @property
    def every(self) -> list[ScanPair]:
        """All pairs."""
        return [*self.pairs, *self.also]

    def without(self, fold: Sequence[int]) -> list[ScanPair]:
        """All but those of a fold."""
        return [*(pair for k, pair in enumerate(self.pairs) if k not in fold), *self.also]


def calibrate_on(
    model: JointScanCRF, pairs: Sequence[ScanPair], learning: LearningConfig | None = None, also: Sequence[ScanPair] = ()
) -> tuple[JointScanCRF, list[Part]]:
    """The model fitted to the laser of annotated pairs, and what each part gains on pairs left out.

    Args:
        learning: settings of a fit of the weights around the model's own, before everything else; None: they stay.
        also: pairs with uncertain labels to fit on too. Without others these are left out in turn and measured; then the distance
            of outliers and the confidences stay, about which the model cannot learn from its own labels.

    Raises:
        TorchCRFScanError: fewer than two pairs, one without annotation, or a model of one chain.
    """
    is_certain = len(pairs) > 0
    pairs, also = (pairs, also) if is_certain else (also, ())
    if len(pairs) < 2 or any(pair.annotation is None for pair in pairs):
        raise TorchCRFScanError(f"pairs: expected two or more annotated pairs, got {len(pairs)}, or one without annotation")
    if not (model.config.has_association and model.config.has_clusters):
        raise TorchCRFScanError(f"chains: expected joint for a model to calibrate, got {model.config.chains}")
    given = Given(pairs, folds_of(pairs), also)
    fits: list[FitPart] = [] if learning is None else [partial(fit_own_weights, learning=learning)]
    fits += [fit_distance, fit_own_scales, fit_worth, fit_confidences] if is_certain else [fit_own_scales, fit_worth]
    found = []
    for fit in fits:
        model, part = fit(model, given)
        found.append(part)
    return model, found


def folds_of(pairs: Sequence[ScanPair]) -> list[list[int]]:
    """The pairs in up to five parts left out in turn: whole sequences if there are that many, else neighbours together."""
    sequences = sorted({pair.sequence for pair in pairs})
    if len(sequences) >= FOLDS:
        return [[k for k, pair in enumerate(pairs) if sequences.index(pair.sequence) % FOLDS == fold] for fold in range(FOLDS)]
    return [part.tolist() for part in np.array_split(np.arange(len(pairs)), min(FOLDS, len(pairs)))]


@torch.no_grad()
def errors(model: JointScanCRF, pairs: Sequence[ScanPair]) -> Floats:
    """(P, 3) wrong annotated points of every pair: by association or cluster, by outlier decision, movers' points called static."""
    found = []
    for pair, answer in zip(pairs, model.match_pairs(pairs), strict=True):
        right, truth, beam = rightness(pair, answer, WITHIN), annotation_of(pair), pair.source.beam
        is_confused = (truth.association[beam] < 0) != (answer.association[beam] < 0)
        is_wrong = ~(right.within & right.cluster)
        is_lost = (truth.body[beam] > 0) & (answer.cluster[beam] <= 0)
        found.append([(right.known & mistake).sum() for mistake in (is_wrong, is_confused, is_lost)])
    return np.array(found, dtype=np.float64)


def gains(before: Floats, after: Floats) -> bool:
    """Whether the sum over pairs (P,) falls by more than its standard error."""
    change = before - after
    return bool(change.sum() > change.std() * len(change) ** 0.5 and change.sum() > 0)


def with_distance(model: JointScanCRF, metres: float) -> JointScanCRF:
    """A copy of the model with this distance of outliers."""
    return with_config(model, model.config.with_limit(metres))


def fit_distance(model: JointScanCRF, given: Given) -> tuple[JointScanCRF, Part]:
    """The distance with the fewest errors about outliers, kept if the pairs left out have fewer, and not more of any other kind."""
    pairs = given.pairs
    before = errors(model, pairs)
    tried = np.stack([errors(with_distance(model, metres), pairs) for metres in DISTANCES])  # (distances, P, 3)

    def best(rows: Sequence[int]) -> int:
        padded = np.pad(tried[:, rows, 1].sum(1), 1, mode="edge")
        return int(np.convolve(padded, AGAIN, mode="valid").argmin())

    every = range(len(pairs))
    after = before.copy()
    for fold in given.folds:
        after[fold] = tried[best([k for k in every if k not in fold]), fold]
    metres = DISTANCES[best(every)]
    is_kept = bool((after.sum(0) <= before.sum(0)).all() and after[:, 1].sum() < before[:, 1].sum())
    part = Part("outlier distance", "outlier errors", before[:, 1].sum(), after[:, 1].sum(), f"{metres:.2f} m", is_kept)
    return (with_distance(model, metres) if is_kept else model), part


def fit_own_weights(model: JointScanCRF, given: Given, learning: LearningConfig) -> tuple[JointScanCRF, Part]:
    """The weights of both chains by `fit.refit`, around the model's own."""

    def fit(of: JointScanCRF, some: Sequence[ScanPair]) -> Values | None:
        batch, other = ScanPairBatch.collate(some), copy.deepcopy(of)
        refit(other, [Material(batch, of.initialise(batch.without_truth()), 0, tuple(some))], learning)
        return named("association_weights", other.association_weights) | named("clustering_weights", other.clustering_weights)

    return fit_by_share(model, given, "weights", fit)


def fit_own_scales(model: JointScanCRF, given: Given) -> tuple[JointScanCRF, Part]:
    """The features' scales by `scales_fit`."""

    def fit(of: JointScanCRF, some: Sequence[ScanPair]) -> Values | None:
        view = of.view(ScanPairBatch.collate(some))
        plugins = true_plugins(view.batch, of.config.motions)
        has_pairs = view.batch.truth is not None and bool((view.batch.truth.association >= 0).any())
        return named("scales", fit_scales([view], [plugins])) if has_pairs else None

    return fit_by_share(model, given, "scales", fit)


def fit_worth(model: JointScanCRF, given: Given) -> tuple[JointScanCRF, Part]:
    """The movers' worth by `selection_fit`."""

    def fit(of: JointScanCRF, some: Sequence[ScanPair]) -> Values | None:
        batch = ScanPairBatch.collate(some)
        start = of.initialise(batch.without_truth())
        material = Material(batch, start, 0, tuple(some))
        is_true = judge_clusters(of, material)[1] if start.log_odds is not None else torch.zeros(0)
        has_both = min(int((is_true == label).sum()) for label in (0, 1)) >= FEWEST_MOVERS
        return named("cluster_potential", fit_potential(of, [material])) if has_both else None

    return fit_by_share(model, given, "movers' worth", fit)


def fit_by_share(model: JointScanCRF, given: Given, name: str, fit: Fit) -> tuple[JointScanCRF, Part]:
    """A part of the model fitted on all pairs, at the share of the way that leaves the fewest wrong points on those left out."""
    before = errors(model, given.pairs)
    after = np.tile(before, (len(SHARES), 1, 1))
    for fold in given.folds:
        fitted = fit(model, given.without(fold))
        for row, share in enumerate(SHARES):
            if fitted is not None:
                after[row, fold] = errors(moved_towards(model, fitted, share), [given.pairs[k] for k in fold])
    best = int(after[..., 0].sum(1).argmin())
    fitted = fit(model, given.every)
    is_safe = bool(after[best, :, 2].sum() <= before[:, 2].sum())
    is_kept = fitted is not None and is_safe and gains(before[:, 0], after[best, :, 0])
    told = "too few examples" if fitted is None else f"{100 * SHARES[best]:.0f} % of the way"
    part = Part(name, "wrong points", before[:, 0].sum(), after[best, :, 0].sum(), told, is_kept)
    return (moved_towards(model, fitted, SHARES[best]) if fitted is not None and is_kept else model), part


def named(module: str, fitted: nn.Module) -> dict[str, Tensor]:
    """The state of a module of a model, by the names that it has there."""
    return {f"{module}.{name}": value for name, value in fitted.state_dict().items()}


@torch.no_grad()
def moved_towards(model: JointScanCRF, fitted: Values, share: float) -> JointScanCRF:
    """A copy of the model with some values a share of the way to the fitted ones; scales in logarithms."""
    other = copy.deepcopy(model)
    own = other.state_dict()
    for name, value in fitted.items():
        target = value.to(own[name])
        if name.removeprefix("scales.") in IN_LOGARITHMS:
            own[name].copy_((own[name].log() * (1 - share) + target.log() * share).exp())
        else:
            own[name].copy_(own[name] * (1 - share) + target * share)
    return other


@torch.no_grad()
def fit_confidences(model: JointScanCRF, given: Given) -> tuple[JointScanCRF, Part]:
    """Slopes and offsets of both confidences by `calibration_fit`, at the share of the way with the least surprise left out."""
    judged = [judge([pair], model(ScanPairBatch.collate([pair]).without_truth())) for pair in given.pairs]
    own = np.stack([of.double().cpu().numpy() for of in (model.calibration.association, model.calibration.cluster)])  # (2, 2)
    before = np.array([surprise(of, own) for of in judged])
    after = np.tile(before, (len(SHARES), 1))
    for fold in given.folds:
        fitted = slopes_of([of for k, of in enumerate(judged) if k not in fold])
        for row, share in enumerate(SHARES if fitted is not None else ()):
            after[row, fold] = [surprise(judged[k], own + share * (fitted - own)) for k in fold]
    best = int(after.sum(1).argmin())
    fitted = slopes_of(judged)
    is_kept = fitted is not None and gains(before, after[best])
    part = Part("confidences", "nats", before.sum(), after[best].sum(), f"{100 * SHARES[best]:.0f} % of the way", is_kept)
    if not is_kept or fitted is None:
        return model, part
    other, values = copy.deepcopy(model), torch.from_numpy(own + SHARES[best] * (fitted - own))
    other.calibration.association.copy_(values[0])
    other.calibration.cluster.copy_(values[1])
    return other, part


def slopes_of(judged: Sequence[Judged]) -> Floats | None:
    """(2, 2) slope and offset of the association's and the cluster's confidence; None without an annotated point."""
    every = Judged.joined(judged)
    if not len(every.association_right):
        return None
    association = fit_confidence(every.association_log_odds, every.association_right)
    return np.stack([association, fit_confidence(every.cluster_log_odds, every.cluster_right)])


def surprise(judged: Judged, slopes: Floats) -> float:
    """Negative log-likelihood of the labels' rightness by the confidences, nats in all points. slopes: (2, 2)."""
    total = 0.0
    chains = (judged.association_log_odds, judged.association_right), (judged.cluster_log_odds, judged.cluster_right)
    for (log_odds, right), (slope, offset) in zip(chains, slopes, strict=True):
        score = slope * log_odds + offset
        total += float(np.logaddexp(0, np.where(right, -score, score)).sum())
    return total
