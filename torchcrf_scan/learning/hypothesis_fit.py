"""Fits the score of hypothesised movers (design finding 14) by logistic regression on annotated pairs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.disturb import bump, skew
from torchcrf_scan.loops.pair import Pair, array_of, pair_of
from torchcrf_scan.scan import Bools, Floats, Ints, ScanPair
from torchcrf_scan.search.accept import probabilities_of, score_of, select
from torchcrf_scan.search.background import unit_length
from torchcrf_scan.search.hypotheses import members_of
from torchcrf_scan.search.pool import background_pool
from torchcrf_scan.search.score import FEATURES, HypothesisScore
from torchcrf_scan.search.survey import Survey, grids_of, survey_at

log = logging.getLogger(__name__)

MOST_MOVERS = 6
IGNORED = -2  # body of an unannotated point
FOUND_SHARE = 0.15  # of the views start from the estimated background, as in use; the others, cheaper, from the disturbed truth
BACKGROUND_ERROR = 0.5  # units
BUMP = 0.5  # units of range error shared by neighbouring beams: a tilted sensor hits other heights
SKEW = 0.3  # units by which a scan's ends are displaced: the sensor moves while it turns
KEPT_BEAMS = (0.5, 1.0)
PURE = 0.7  # share of one mover's points among the members above which a hypothesis is that mover's
TOLERANCE, TOLERANCE_SHARE = 1.0, 0.12  # units and share of the displacement up to which a motion is right
THRESHOLDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)
FALSE_COST = 2.0  # weight of a false mover relative to a missed one
VIEWS = 3  # per pair
REGULARISATION = 0.03  # inverse strength; weaker regularisation overfits the simulator
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
    """One annotated pair as seen by the fit: hypotheses for the points unexplained by a background, their features and labels.

    Attributes:
        survey: of the disturbed pair at a background as the search may find it.
        label: (H,) 1 right, 0 wrong, -1 undecided.
        body: (P,) true mover of every source point.
    """

    survey: Survey
    label: Ints
    body: Ints

    def members(self, which: Ints) -> Bools:
        """(G, P) the source points moved by the hypotheses (G,)."""
        return members_of(self.survey.hypotheses, which, len(self.body))


def simulate_mixture(count: int, seed: int) -> list[ScanPair]:
    """About `count` pairs of unrelated scenes: streets, model cars, rooms, and the two hard kinds of mover."""
    pairs: list[ScanPair] = []
    for index, (share, config) in enumerate(MIXTURE):
        number = max(1, round(share * count))
        pairs += simulate_pairs(config, number, number, seed + index)
    return pairs


def fit_mixture(count: int = 110, seed: int = 0) -> HypothesisScore:
    """The score fitted on simulated pairs alone; default arguments give the initial `HypothesisScore`. Takes minutes."""
    pairs = simulate_mixture(count, seed)
    return fit_hypothesis_score([view for k, pair in enumerate(pairs) for view in view_pair(pair, seed + k, views=2)])


def view_pair(pair: ScanPair, seed: int, views: int = VIEWS) -> list[HypothesisView]:
    """`views` views of the annotated pair with different noise, beams and background errors."""
    generator = torch.Generator().manual_seed(seed)
    return [view for _ in range(views) if (view := _view(pair, generator)) is not None]


def fit_hypothesis_score(seen: Sequence[HypothesisView]) -> HypothesisScore:
    """Fits weights and threshold.

    Returns:
        The fitted score; the default one unless the pairs hold both right and wrong hypotheses.
    """
    features = np.concatenate([np.zeros((0, len(FEATURES))), *(view.survey.features for view in seen)])
    label = np.concatenate([np.zeros(0, np.int64), *(view.label for view in seen)])
    if not ((label == 0).any() and (label == 1).any()):
        log.warning("no hypotheses of one kind to learn from: keeping the default score of movers")
        return HypothesisScore()
    score = fit_logistic(torch.from_numpy(features[label >= 0]).float(), torch.from_numpy(label[label >= 0]))
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
    """The pair disturbed like real recordings; None if a scan is left with fewer than two points."""
    truth = annotation_of(pair)
    whole = pair_of(ScanPairBatch.collate([pair]), 0)
    kept = _thin(len(pair.source), generator), _thin(len(pair.target), generator)
    if min(len(k) for k in kept) < 2:
        return None
    thin = whole._replace(source=whole.source[kept[0]], target=whole.target[kept[1]])
    source, target = grids_of(thin)
    unit = unit_length(source.scan, target.scan)
    source, _ = grids_of(thin._replace(source=_disturb(thin, unit, generator)))
    motions = truth.motions
    body = np.where(truth.ignore, IGNORED, truth.body)[pair.source.beam][kept[0]]
    error = BACKGROUND_ERROR * unit * torch.randn(3, generator=generator).double().numpy()
    error[0] /= np.median(source.scan.ranges)
    if torch.rand((), generator=generator) < FOUND_SHARE:
        background = background_pool(source, target, motions[0], np.zeros((0, 3)))[0]
    else:
        background = array_of(se2.compose(torch.from_numpy(error), torch.from_numpy(motions[0])))
    survey = survey_at(source, target, background, pair.dt)
    every = np.arange(len(survey.hypotheses.motions))
    members = members_of(survey.hypotheses, every, len(body))
    return HypothesisView(survey, label_hypotheses(survey, members, body, motions), body)


def _disturb(pair: Pair, unit: float, generator: torch.Generator) -> Floats:
    """(P, 2) source points with the distortions of a moving and tilting sensor. unit: metres."""
    points, metres = torch.from_numpy(pair.source)[None], torch.tensor([unit], dtype=torch.float64)
    skewed = skew(points, torch.ones(points.shape[:2], dtype=torch.bool), SKEW * metres, generator)
    return array_of(bump(skewed, BUMP * metres, generator)[0])


def _thin(count: int, generator: torch.Generator) -> Ints:
    """Index of the beams kept by random thinning; every other time all are kept."""
    share = torch.empty(()).uniform_(*KEPT_BEAMS, generator=generator)
    share = torch.where(torch.rand((), generator=generator) < 0.5, share, torch.ones(()))
    return (torch.rand(count, generator=generator) < share).nonzero()[:, 0].numpy()


def label_hypotheses(survey: Survey, members: Bools, body: Ints, motions: Floats) -> Ints:
    """(H,) 1: moves mostly one true mover, by its motion; 0: neither; -1: undecided, a mover that hardly moved, or unannotated.

    Args:
        members: (H, P) source points moved by every hypothesis.
        body: (P,) true cluster of every point, -1 none, `IGNORED`. motions: (K+1, 3) of every cluster, NaN where unknown.
    """
    leftover, found = survey.leftover, survey.hypotheses.motions
    if not len(found):
        return np.zeros(0, np.int64)
    points, unit, count = leftover.source.grid.scan.points, leftover.unit, members.sum(-1)
    of_body = np.stack([(members & (body == k)).sum(-1) for k in range(len(motions))], axis=-1)  # (H, K+1)
    which = of_body.argmax(-1)
    pure = of_body.max(-1) / count
    error = _apart(found, motions[which], points, members)
    travel = _apart(np.broadcast_to(motions[0], found.shape), motions[which], points, members)
    local = (members * leftover.source.units).sum(-1) / count  # distant points carry less information
    with np.errstate(invalid="ignore"):  # NaN for unknown motions: all comparisons are False
        tolerance = np.maximum(TOLERANCE * np.maximum(local, unit), TOLERANCE_SHARE * travel)
        right = (pure >= PURE) & (which > 0) & (travel > unit) & (error < tolerance)
        between = (pure >= 0.5) & (which > 0) & (error < 1.5 * tolerance) & (travel > 0.5 * unit)
    between |= np.isnan(error) | ((members & (body == IGNORED)).sum(-1) > count / 2)
    return np.where(between & ~right, -1, right.astype(np.int64))


def _apart(one: Floats, other: Floats, points: Floats, members: Bools) -> Floats:
    """(H,) mean distance of the members under two motions (H, 3) each."""
    here, there = (se2.apply(torch.tensor(motions), torch.from_numpy(points)).numpy() for motions in (one, other))  # (H, P, 2)
    gap = np.linalg.norm(here - there, axis=-1)
    return np.where(members, gap, 0.0).sum(-1) / members.sum(-1)


def _best_threshold(score: HypothesisScore, views: Sequence[HypothesisView]) -> float:
    """The probability threshold with the best F score of accepted movers, where false ones cost more than missed ones."""
    results = np.array([_count_accepted(score, view) for view in views]).sum(0)  # (T, 3)
    right, accepted, true = results.T
    return THRESHOLDS[int(((1 + FALSE_COST) * right / np.maximum(FALSE_COST * accepted + true, 1)).argmax())]


def _count_accepted(score: HypothesisScore, view: HypothesisView) -> list[tuple[int, int, int]]:
    """For every threshold: right acceptances (each mover once), acceptances, and movers with a right hypothesis.

    The choice is greedy, so a higher threshold accepts a prefix of those accepted at a lower one.
    """
    survey = view.survey
    findable = len(_bodies(view, np.flatnonzero(view.label == 1)))
    probabilities = probabilities_of(score_of(score), survey.features)
    chosen = select(survey.leftover, survey.hypotheses, probabilities, THRESHOLDS[0], MOST_MOVERS)
    rows = []
    for threshold in THRESHOLDS:
        sure = chosen[probabilities[chosen] >= threshold]
        found = _bodies(view, sure[view.label[sure] == 1])
        rows.append((len(found), int((view.label[sure] >= 0).sum()), findable))
    return rows


def _bodies(view: HypothesisView, which: Ints) -> set[int]:
    """The movers to which most members of each of the hypotheses (G,) belong."""
    values = (np.unique(view.body[row], return_counts=True) for row in view.members(which))
    return {int(bodies[counts.argmax()]) for bodies, counts in values}
