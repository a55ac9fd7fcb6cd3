"""Fits the score that accepts movers (design finding 14) by logistic regression on annotated pairs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import SimulatorConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import background_pool, unit_length
from torchcrf_scan.inference.hypotheses import Hypotheses, hypothesise, point_units
from torchcrf_scan.inference.hypothesis_features import FEATURES, hypothesis_features
from torchcrf_scan.inference.movers import HypothesisScore, select
from torchcrf_scan.inference.surface import Surface
from torchcrf_scan.learning.disturb import bump, skew
from torchcrf_scan.scan import ScanPair

log = logging.getLogger(__name__)

MOST_MOVERS = 6
IGNORED = -2  # body of a point that nobody annotated
FOUND_SHARE = 0.15  # of the views start from the background that is found, as in use; the others, cheaper, from the disturbed truth
BACKGROUND_ERROR = 0.5  # units
BUMP = 0.5  # units of range error that neighbouring beams share: a tilted sensor hits other heights
SKEW = 0.3  # units that a scan's ends are displaced by: the sensor moves while it turns
KEPT_BEAMS = (0.5, 1.0)
PURE = 0.7  # share of a mover's points in the members of a hypothesis that is taken as its
TOLERANCE, TOLERANCE_SHARE = 1.0, 0.12  # units and share of the displacement up to which a motion is right
THRESHOLDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)
FALSE_COST = 2.0  # a false mover is as bad as that many missed ones
VIEWS = 3  # of every pair
REGULARISATION = 0.03  # inverse; looser weights fit the simulator, not the world
MODEL_CAR = SimulatorConfig(scale=0.1, fov=360.0, beams=360, range_max=9.0, dropout=0.3, dt=0.24)
MIXTURE = (  # share and world
    (0.30, SimulatorConfig()),
    (0.20, MODEL_CAR),
    (0.20, replace(MODEL_CAR, range_max=8.0, ego_translation=3.0)),
    (0.10, SimulatorConfig(scene="indoor", beams=360, fov=270.0)),
    (0.05, SimulatorConfig(dominant_mover=1.0)),
    (0.05, SimulatorConfig(aperture=1.0)),
    (0.10, SimulatorConfig(ego_translation=4.0, range_noise=0.03, dt=0.1)),
)


@dataclass(frozen=True, slots=True)
class HypothesisView:
    """One pair as the fit sees it: its surfaces, a background, the hypotheses, their features (H, F) and labels.

    Attributes:
        body: (P,) true mover of every source point, motions: (K+1, 3) true motions.
        label: (H,) 1 right, 0 wrong, -1 neither.
    """

    source: Surface
    target: Surface
    hypotheses: Hypotheses
    features: Tensor
    label: Tensor
    body: Tensor
    motions: Tensor


def simulate_mixture(count: int, seed: int) -> list[ScanPair]:
    """About `count` pairs of unrelated scenes: streets, model cars, rooms, and the two hard kinds of mover."""
    pairs: list[ScanPair] = []
    for index, (share, config) in enumerate(MIXTURE):
        number = max(1, round(share * count))
        pairs += simulate_pairs(config, number, number, seed + index)
    return pairs


def fit_mixture(count: int = 110, seed: int = 0) -> HypothesisScore:
    """The score fitted on simulated pairs alone; the defaults give what `HypothesisScore` begins with. Takes minutes."""
    pairs = simulate_mixture(count, seed)
    return fit_hypothesis_score([view for k, pair in enumerate(pairs) for view in view_pair(pair, seed + k, views=2)])


def view_pair(pair: ScanPair, seed: int, views: int = VIEWS) -> list[HypothesisView]:
    """The annotated pair seen `views` times with other noise, beams and background error. Takes about 0.15 s a view."""
    generator = torch.Generator().manual_seed(seed)
    return [view for _ in range(views) if (view := _view(pair, generator)) is not None]


def fit_hypothesis_score(seen: Sequence[HypothesisView]) -> HypothesisScore:
    """Fits weights and threshold.

    Returns:
        The fitted score, or the default one where the pairs hold no mover, or nothing else.
    """
    features = torch.cat([view.features for view in seen]) if seen else torch.zeros(0, len(FEATURES))
    label = torch.cat([view.label for view in seen]) if seen else torch.zeros(0)
    if not ((label == 0).any() and (label == 1).any()):
        log.warning("no hypotheses of one kind to learn from: keeping the default score of movers")
        return HypothesisScore()
    score = fit_logistic(features[label >= 0], label[label >= 0])
    score.threshold.fill_(_best_threshold(score, seen))
    return score


def fit_logistic(features: Tensor, label: Tensor) -> HypothesisScore:
    """features: (H, F); label: (H,) 0 or 1."""
    from sklearn.linear_model import LogisticRegression

    score = HypothesisScore()
    score.mean.copy_(features.mean(0))
    score.scale.copy_(features.std(0).clamp(min=1e-3))
    regression = LogisticRegression(C=REGULARISATION, max_iter=1000).fit(score.terms(features).double().numpy(), label.numpy())
    score.weight.copy_(torch.from_numpy(regression.coef_[0]))
    score.bias.fill_(float(regression.intercept_[0]))
    return score


def _view(pair: ScanPair, generator: torch.Generator) -> HypothesisView | None:
    """The pair disturbed as real recordings are; None where a scan is left without points."""
    assert pair.annotation is not None
    batch = ScanPairBatch.collate([pair])
    kept = _thin(len(pair.source), generator), _thin(len(pair.target), generator)
    if min(len(k) for k in kept) < 2:
        return None
    noise = batch.range_noise[0]
    source = Surface.of(batch.source[0][kept[0]], noise, pair.source.is_closed)
    target = Surface.of(batch.target[0][kept[1]], noise, pair.target.is_closed)
    unit = unit_length(source, target)
    points = skew(source.points[None], torch.ones(1, len(source), dtype=torch.bool), SKEW * unit[None], generator)
    source = Surface.of(bump(points, BUMP * unit[None], generator)[0], noise, pair.source.is_closed)
    motions = torch.from_numpy(pair.annotation.motions).to(source.points)
    known = np.where(pair.annotation.ignore, IGNORED, pair.annotation.body)
    body = torch.from_numpy(known[pair.source.beam])[kept[0]]
    background = _background(source, target, motions[0], unit, generator)
    hypotheses = hypothesise(source, target, background, pair.dt)
    features = hypothesis_features(hypotheses, source, target, background)
    label = label_hypotheses(hypotheses, source, body, motions, unit)
    return HypothesisView(source, target, hypotheses, features, label, body, motions)


def _thin(count: int, generator: torch.Generator) -> Tensor:
    """Index of the beams that are kept; every other time all are."""
    share = torch.empty(()).uniform_(*KEPT_BEAMS, generator=generator)
    share = torch.where(torch.rand((), generator=generator) < 0.5, share, torch.ones(()))
    return (torch.rand(count, generator=generator) < share).nonzero()[:, 0]


def _background(source: Surface, target: Surface, truth: Tensor, unit: Tensor, generator: torch.Generator) -> Tensor:
    """(3,) the background's motion as it may be found."""
    error = BACKGROUND_ERROR * unit * torch.randn(3, generator=generator)
    error = torch.cat([error[:1] / source.ranges.median(), error[1:]])
    if torch.rand((), generator=generator) < FOUND_SHARE:
        return background_pool(source, target, truth)[0]
    return se2.compose(error, truth)


def label_hypotheses(hypotheses: Hypotheses, source: Surface, body: Tensor, motions: Tensor, unit: Tensor) -> Tensor:
    """(H,) 1: moves mostly one true mover, and as it moved; 0: neither; -1: between, a mover that hardly moved, or not annotated.

    Args:
        body: (P,) true cluster of every point, -1 none, `IGNORED`. motions: (K+1, 3) of every cluster, NaN where unknown.
        unit: () metres.
    """
    if not len(hypotheses):
        return torch.zeros(0, dtype=torch.int64)
    count = torch.stack([(hypotheses.members & (body == k)).sum(-1) for k in range(len(motions))], dim=-1)  # (H, K+1)
    most, which = count.max(-1)
    pure = most / hypotheses.members.sum(-1)
    error = _apart(hypotheses.motions, motions[which], source.points, hypotheses.members)
    travel = _apart(motions[:1].expand(len(which), -1), motions[which], source.points, hypotheses.members)
    local = (hypotheses.members * point_units(source)).sum(-1) / hypotheses.members.sum(-1)  # far away, points tell less
    tolerance = torch.maximum(TOLERANCE * torch.maximum(local, unit), TOLERANCE_SHARE * travel)
    right = (pure >= PURE) & (which > 0) & (travel > unit) & (error < tolerance)
    between = (pure >= 0.5) & (which > 0) & (error < 1.5 * tolerance) & (travel > 0.5 * unit)
    between |= error.isnan() | ((hypotheses.members & (body == IGNORED)).sum(-1) > hypotheses.members.sum(-1) / 2)
    return torch.where(between & ~right, -1, right.long())


def _apart(one: Tensor, other: Tensor, points: Tensor, members: Tensor) -> Tensor:
    """(H,) mean distance of the members carried by two motions (H, 3) each."""
    gap = torch.linalg.vector_norm(se2.apply(one, points) - se2.apply(other, points), dim=-1)
    return (gap * members).sum(-1) / members.sum(-1)


def _best_threshold(score: HypothesisScore, views: Sequence[HypothesisView]) -> float:
    """The probability at which accepted movers have the best F score: false ones cost more than missed ones."""
    results = np.array([_count_accepted(score, view) for view in views]).sum(0)  # (T, 3)
    right, accepted, true = results.T
    return THRESHOLDS[int(((1 + FALSE_COST) * right / np.maximum(FALSE_COST * accepted + true, 1)).argmax())]


def _count_accepted(score: HypothesisScore, view: HypothesisView) -> list[tuple[int, int, int]]:
    """For every threshold: right acceptances (each mover once), acceptances, and movers that some hypothesis got right.

    The choice is greedy, so a higher threshold accepts the first of those that a lower one accepts.
    """
    findable = len(_bodies(view, view.hypotheses.members[view.label == 1]))
    probabilities = score(view.features)
    movers = select(view.hypotheses, probabilities, view.source, view.target, threshold=THRESHOLDS[0], most=MOST_MOVERS)
    chosen = Hypotheses(movers.motions, movers.members)
    label = label_hypotheses(chosen, view.source, view.body, view.motions, unit_length(view.source, view.target))
    rows = []
    for threshold in THRESHOLDS:
        is_sure = movers.probabilities >= threshold
        found = _bodies(view, movers.members[is_sure & (label == 1)])
        rows.append((len(found), int((is_sure & (label >= 0)).sum()), findable))
    return rows


def _bodies(view: HypothesisView, members: Tensor) -> set[int]:
    return {int(view.body[row].mode().values) for row in members}
