"""Fits the calibration of confidences and covariances on annotated pairs and the predictions of a fitted model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import chi2

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.calibration import MOTION_FREEDOM, background_nees, rightness
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.inference.uncertainty import WITHIN, Calibration, association_log_odds, cluster_log_odds
from torchcrf_scan.learning.material import Material
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import Bools, Floats, ScanPair

DOMINATED = 1 / 3  # share of moving points in a scan above which movers dominate it
FEWEST_PAIRS = 10  # minimum number of pairs to fit the factor of the covariances
FIT_QUANTILE = 0.9  # at which the covariances' factor is fitted: up to a tenth of the pairs may have a wrong background


@dataclass(frozen=True, slots=True)
class Judged:
    """Predictions for annotated pairs compared with the truth: P returns and Q pairs with a known background motion.

    Attributes:
        association_log_odds, cluster_log_odds: (P,).
        association_right, cluster_right: (P,) bool; an association is right within `WITHIN` target beams.
        nees: (Q,) normalised estimation errors squared of the background's motion.
    """

    association_log_odds: Floats
    association_right: Bools
    cluster_log_odds: Floats
    cluster_right: Bools
    nees: Floats

    @classmethod
    def nothing(cls) -> Judged:
        """An instance without returns and pairs."""
        number, flag = np.zeros(0), np.zeros(0, dtype=bool)
        return cls(number, flag, number, flag, number)

    @classmethod
    def joined(cls, parts: Sequence[Judged]) -> Judged:
        """Concatenates all parts. Raises TorchCRFScanError for none."""
        if not parts:
            raise TorchCRFScanError("parts: expected at least one, got none")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__))


@torch.no_grad()
def calibrate(model: JointScanCRF, material: Sequence[Material]) -> None:
    """Fits the calibration of a fitted model in place, on the pairs and from the starts that it was fitted on.

    The undisturbed scans are used: disturbance moves whole scans, and covariances that account for it would be four to six times
    too large otherwise. Scans dominated by movers are left out if there are others: they are right or wrong as a whole, which the
    belief of a single point does not reflect; so are pairs with uncertain labels, which the model itself may have given. An
    earlier calibration has no influence. A model of one chain keeps the default.
    """
    model.calibration.load_state_dict(Calibration().state_dict())
    if not (model.config.has_association and model.config.has_clusters):
        return
    pairs = [pair for part in material for pair in part.pairs]
    certain = [pair for pair in pairs if pair.annotation is not None and pair.annotation.weight >= 1] or pairs
    plain = [pair for pair in certain if moving_share(pair) <= DOMINATED] or certain
    chosen = {id(pair) for pair in plain}
    parts = []
    for part in material:
        batch = ScanPairBatch.collate(part.pairs).without_truth()
        parts.append(judge(part.pairs, model(batch, part.start), [id(pair) in chosen for pair in part.pairs]))
    model.calibration.load_state_dict(fit_calibration(Judged.joined(parts)).state_dict())


def moving_share(pair: ScanPair) -> float:
    """Share of the returns with a known body that belong to movers; 0 without known bodies."""
    truth = annotation_of(pair)
    body = truth.body[~truth.ignore]
    return float((body > 0).sum() / max((body >= 0).sum(), 1))


@torch.no_grad()
def judge(pairs: Sequence[ScanPair], prediction: Prediction, counts: Sequence[bool] | None = None) -> Judged:
    """Compares the prediction of a batch with the annotation of its B pairs.

    Args:
        counts: (B,) pairs to include; None: all.

    Raises:
        TorchCRFScanError: a pair without annotation.
    """
    association, cluster = association_log_odds(prediction), cluster_log_odds(prediction)
    parts = [Judged.nothing()]
    for b, pair in enumerate(pairs):
        if counts is not None and not counts[b]:
            continue
        answer = prediction.pair(b, pair)
        right, nees = rightness(pair, answer, WITHIN), np.array([background_nees(pair, answer)])
        known, n = right.known, len(pair.source)
        parts.append(
            Judged(
                association_log_odds=association[b, :n].double().cpu().numpy()[known],
                association_right=right.within[known],
                cluster_log_odds=cluster[b, :n].double().cpu().numpy()[known],
                cluster_right=right.cluster[known],
                nees=nees[np.isfinite(nees)],
            )
        )
    return Judged.joined(parts)


def fit_calibration(judged: Judged) -> Calibration:
    """Both chains' slopes and offsets, and the factor of the covariances; the default is kept where there is too little data.

    Args:
        judged: with covariances from `motion_covariance`, before multiplication by a factor.
    """
    calibration = Calibration()
    if not len(judged.association_right):
        return calibration
    calibration.association.copy_(torch.from_numpy(fit_confidence(judged.association_log_odds, judged.association_right)))
    calibration.cluster.copy_(torch.from_numpy(fit_confidence(judged.cluster_log_odds, judged.cluster_right)))
    if len(judged.nees) >= FEWEST_PAIRS:
        calibration.covariance_factor.fill_(fit_covariance_factor(judged.nees))
    return calibration


def fit_confidence(log_odds: ArrayLike, is_right: ArrayLike) -> Floats:
    """(2,) slope >= 0 and offset of the confidence sigmoid(slope * log-odds + offset) by least negative log-likelihood (Platt).

    With Platt's targets (n + 1) / (n + 2) and 1 / (n + 2) instead of 1 and 0, so that it is finite even if all labels are right.

    Args:
        log_odds: (P,). is_right: (P,) bool.

    Raises:
        TorchCRFScanError: empty input.
    """
    values, right = np.asarray(log_odds, dtype=np.float64), np.asarray(is_right, dtype=bool)
    if not len(values) or values.shape != right.shape:
        raise TorchCRFScanError(f"log_odds: expected one or more (P,) and is_right as many, got {values.shape} and {right.shape}")
    yes, no = int(right.sum()), int((~right).sum())
    target = np.where(right, (yes + 1) / (yes + 2), 1 / (no + 2))

    def loss(parameters: Floats) -> tuple[float, Floats]:
        score = parameters[0] * values + parameters[1]
        excess = (expit(score) - target) / len(values)
        return float((np.logaddexp(0, score) - target * score).mean()), np.array([excess @ values, excess.sum()])

    found = minimize(loss, np.array([0.5, 0.0]), jac=True, method="L-BFGS-B", bounds=[(0.0, None), (None, None)])
    return np.asarray(found.x, dtype=np.float64)


def fit_covariance_factor(nees: ArrayLike, quantile: float = FIT_QUANTILE, freedom: int = MOTION_FREEDOM) -> float:
    """The covariances' factor that matches a quantile of the normalised errors to the chi-square's; robust against wrong motions.

    Args:
        nees: (Q,) with the factor 1.
        quantile: in (0, 1); 0.5 is the most robust, but errors are heavy-tailed, and covariances are then too small.
        freedom: degrees of freedom of the chi-square.

    Raises:
        TorchCRFScanError: empty input.
    """
    values = np.asarray(nees, dtype=np.float64)
    if not len(values):
        raise TorchCRFScanError("nees: expected at least one number, got none")
    return float(np.quantile(values, quantile) / chi2.ppf(quantile, freedom))
