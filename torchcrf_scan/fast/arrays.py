"""Arrays and numbers of the rounds of one pair: fitted weights, settings, scene, state and result."""

from __future__ import annotations

from typing import NamedTuple

from torchcrf_scan.config import ModelConfig
from torchcrf_scan.fast.boosting import double_array
from torchcrf_scan.fast.clustering import ClusteringModel, clustering_model
from torchcrf_scan.fast.free_space import Sweep
from torchcrf_scan.fast.limit import Limit
from torchcrf_scan.fast.motion import METRICS
from torchcrf_scan.fast.selection import Worth, worth_of
from torchcrf_scan.fast.static_features import AssociationModel, AssociationPair, association_model
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.jit import Array, Booleans, Integers
from torchcrf_scan.loops.nearest import Boxes


class Fitted(NamedTuple):
    """Fitted weights, scales and calibration as arrays and numbers; `inference.state.Parameters`.

    Attributes:
        association_calibration, cluster_calibration: (2,) slope and offset of the confidences.
        covariance_factor: of all covariances.
    """

    association: AssociationModel
    clustering: ClusteringModel
    worth: Worth
    association_calibration: Array
    cluster_calibration: Array
    covariance_factor: float


class Settings(NamedTuple):
    """The settings used by the rounds; `metric` is an index of `motion.METRICS`.

    Attributes:
        is_soft: motions are fitted to beliefs, not to labels. detaches: no gradient passes through motions to features.
        outlier_distance: metres; 0: as learned.
    """

    candidates: int
    iterations: int
    stop_early: bool
    is_joint: bool
    metric: int
    is_soft: bool
    detaches: bool
    min_extent: float
    rotation_tolerance: float
    translation_tolerance: float
    wrap_closed: bool
    is_metre: bool
    is_reach_hard: bool
    outlier_distance: float


class Decoded(NamedTuple):
    """The result, metres; the attributes are those of `prediction.Prediction`.

    Attributes:
        association, cluster: (N,). motions: (C, 3). active: (C,). candidates: (N, K).
        log_association: (N, K+1). log_cluster: (N, D). association_confidence, cluster_confidence: (N,).
        covariance: (C, 3, 3). information: (C, 3). directions: (C, 3, 3); see `inference.uncertainty.Uncertainty`.
    """

    association: Integers
    cluster: Integers
    motions: Array
    active: Booleans
    candidates: Integers
    log_association: Array
    log_cluster: Array
    converged: bool
    iterations: int
    association_confidence: Array
    cluster_confidence: Array
    covariance: Array
    information: Array
    directions: Array


class Scene(NamedTuple):
    """A pair in the features' unit of length, with the quantities that stay constant over the rounds.

    Attributes:
        factor: units in a metre. source: (N, 2), target: (M, 2). noise: of a return.
        tangents: (M, 2) of the target. reach: (N, C) of `Start`; inf where `features.reach` hard rules a cluster out.
        outlier, moving: (N,) log potentials of `features.learned.ExtraLogUnary`.
        limit: of outliers.
    """

    factor: float
    source: Array
    target: Array
    noise: float
    boxes: Boxes
    source_sweep: Sweep
    target_sweep: Sweep
    descriptors: AssociationPair
    tangents: Array
    reach: Array
    outlier: Array
    moving: Array
    limit: Limit


class State(NamedTuple):
    """State of one pair after a round; `inference.state.State`.

    Attributes:
        motions: (C, 3). active: (C,). empty_for: (C,). association, cluster: (N,).
        candidates: (N, K). log_association: (N, K+1). log_cluster: (N, D).
    """

    motions: Array
    active: Booleans
    empty_for: Integers
    association: Integers
    cluster: Integers
    candidates: Integers
    log_association: Array
    log_cluster: Array


def fitted_of(parameters: Parameters) -> Fitted:
    """The fitted parameters as arrays and numbers, once for all pairs."""
    calibration = parameters.calibration
    return Fitted(
        association_model(parameters),
        clustering_model(parameters),
        worth_of(parameters),
        double_array(calibration.association),
        double_array(calibration.cluster),
        float(calibration.covariance_factor),
    )


def settings_of(model: ModelConfig) -> Settings:
    """The settings that `decode_pair` needs."""
    config, features = model.inference, model.features
    return Settings(
        config.candidates,
        config.iterations,
        config.stop_early,
        config.movers == "joint",
        METRICS.index(config.motion_metric),
        config.motion_weights == "soft",
        config.detach_motion,
        config.min_extent,
        config.rotation_tolerance,
        config.translation_tolerance,
        features.wrap_closed,
        features.length_unit == "metre",
        features.reach == "hard",
        config.outlier_distance or 0.0,
    )
