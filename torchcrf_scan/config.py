"""Settings of the model as frozen dataclasses, filled from `configs/*.yaml` and the command line (jsonargparse)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from torchcrf_scan.checks import Amount, AtMost, OneOf, Within, check_fields
from torchcrf_scan.choices import (
    CANDIDATE_SEARCHES,
    CHAINS,
    COUPLINGS,
    MOTION_METRICS,
    MOTION_WEIGHTS,
    MOVERS,
    OF_INFERENCE,
    OF_ROUNDS,
    SCHEDULES,
    STARTS,
    with_ability,
)
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.names import WEIGHTS

LEFT_OUT = (
    *("association.pairwise_distance", "association.pairwise_translation"),
    *("clustering.gate", "clustering.outlier_bias"),
)  # by default


@dataclass(frozen=True)
class InferenceConfig:
    """Settings of inference (spec 7).

    Attributes:
        clusters: D, states of the clustering chain: background, movers, outlier.
        candidates: K inlier states of a point; 0 = every target point (dense).
        iterations: maximum number of rounds.
        stop_early: stop at convergence; off, exactly `iterations` rounds are unrolled.
        temperature: 0 = max-product, 1 = sum-product.
        motion_metric: `point` (Kabsch, the paper's), `line` (robust point-to-line step) or `given`: the motions stay those of
            the start (`sweep` only).
        motion_weights: `hard` (labels, the paper's) or `soft` (beliefs; gradients then reach the weights through motions). With
            `hard` only the last round has a gradient by the weights, so that the rounds before it cost no more than an answer.
        movers: `joint`: hypothesised movers are selected by their score and the clustering chain; `threshold`: by their score alone
            (always so in `flooding`).
        schedule: `sweep` (exact passes over each chain, motions between) or `flooding` (Algorithm 1 node by node).
        flooding_order: `alternate` or `ascending` (A-20), for flooding only.
        candidate_search: the K nearest under the present motions (`motion`), in raw position (`position`), or the K most similar
            in shape (`shape`).
        min_extent: metres (scaled as by `length_unit: spacing`); a smaller cluster takes the background's rotation.
        detach_motion: no gradient passes through a motion into the features of the next pass; motions keep their own.
        backend: engine of the rounds: `compiled` (loops in machine code, on a CPU, with gradients by weights and extra potentials)
            or `eager` (tensors); `auto`: compiled where that is possible.
        rotation_tolerance: radians; a motion whose rotation changes by less has converged.
        translation_tolerance: metres; a motion whose translation changes by less has converged.
        outlier_distance: metres; a point is an outlier where its nearest target point under its own motion is farther, and only
            there; null: as learned, in units of spacing.
    """

    clusters: Annotated[int, Within(2, 32)] = 8
    candidates: Annotated[int, Within(0, 256)] = 8
    iterations: Annotated[int, Within(0, 10_000)] = 10
    stop_early: bool = True
    temperature: Amount = 0.0
    motion_metric: Annotated[str, OneOf(*MOTION_METRICS)] = "line"
    motion_weights: Annotated[str, OneOf(*MOTION_WEIGHTS)] = "hard"
    movers: Annotated[str, OneOf(*MOVERS)] = "joint"
    schedule: Annotated[str, OneOf(*SCHEDULES)] = "sweep"
    flooding_order: Annotated[str, OneOf("alternate", "ascending")] = "alternate"
    candidate_search: Annotated[str, OneOf(*CANDIDATE_SEARCHES)] = "motion"
    min_extent: Amount = 0.1
    detach_motion: bool = False
    backend: Annotated[str, OneOf("auto", "compiled", "eager")] = "auto"
    rotation_tolerance: Amount = 1e-4
    translation_tolerance: Amount = 1e-3
    outlier_distance: Annotated[float | None, Within(0, above=True)] = None

    def __post_init__(self) -> None:
        check_fields(self)


RUN_TIME = ("stop_early", "detach_motion", "backend", "rotation_tolerance", "translation_tolerance")
"""Fields of `InferenceConfig` that do not affect the meaning of the weights and are not saved with them."""


@dataclass(frozen=True)
class FeatureConfig:
    """Settings of the features.

    Attributes:
        free_space: free-space and occlusion features, as extension weights of both chains (design finding 13).
        decisions: features for the inlier/outlier decision and for the nearest target point, as extension weights of both chains:
            a gate on the residual, a constant, the excess over the nearest. This and `free_space` off: 30.
        reach: how a point's distance from the segment that a mover was found by (`Start.reach`) bears on its cluster: `soft`, an
            extension weight of the clustering chain; `hard`, a mover is impossible beyond the segment's reach; `off` (in YAML with
            quotes), not at all.
        left_out: features left out of the model, as `association.NAME` or `clustering.NAME` of a weight; a local channel is
            then hidden from the boosters too. By default the two that compare an edge's length, which reject sparsely sampled
            surfaces as outliers, and the decisions of the clustering chain, which cost it movers.
        length_unit: unit of lengths in the features: `spacing` (from the point spacing of each pair's scans, so one set of weights
            serves a street and a table top) or `metre`, the paper's.
        embedding: `dot` (scaled dot product) or `cosine`: the similarity of embeddings given to `forward` scores associations
            (`features.learned`), with two additional weights; or `none`.
        raw_channels: the 12 local channels enter the potentials beside the boosted scores (W-A); off, they only feed the boosters
            (W-B, the literal text).
        wrap_closed: neighbours wrap round a closed scan (A-06); off, they clamp as in the paper.
        stumps: decision stumps in each booster.
        smooth: width of the stumps' sigmoids, in units of the boosted features (robust squares, 0 to -9); 0: steps. As the width
            goes to 0 the margins approach those of the fitted steps; 0.1 leaves almost all labels unchanged. Above 0, gradients
            reach points and motions through them.
        learn_stumps: thresholds and tables of the boosters are parameters, learned with the weights; needs `smooth` above 0.
    """

    free_space: bool = True
    decisions: bool = True
    reach: Annotated[str, OneOf("hard", "soft", "off")] = "hard"
    left_out: tuple[Annotated[str, OneOf(*WEIGHTS)], ...] = LEFT_OUT
    length_unit: Annotated[str, OneOf("spacing", "metre")] = "spacing"
    embedding: Annotated[str, OneOf("none", "dot", "cosine")] = "none"
    raw_channels: bool = True
    wrap_closed: bool = True
    stumps: Annotated[int, Within(1, 10_000)] = 50
    smooth: Amount = 0.0
    learn_stumps: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if self.learn_stumps and self.smooth == 0:
            raise TorchCRFScanError("learn_stumps: expected smooth above 0 (steps have no gradient), got smooth 0")


@dataclass(frozen=True)
class EncoderConfig:
    """A convolutional encoder of the scans' points (`torchcrf_scan.encoder`), part of the model and learned with it.

    Attributes:
        width: channels of its layers; 0: the model has no encoder.
        dilations: points between the taps of each layer; twice their sum is the receptive field along a scan.
        embedding: channels of its embeddings, in addition to its log potentials; needs `features.embedding`; 0: none.
    """

    width: Annotated[int, Within(0, 1024)] = 0
    dilations: Annotated[tuple[Annotated[int, Within(1, 10_000)], ...], AtMost(16)] = (1, 2, 4, 8, 16)
    embedding: Annotated[int, Within(0, 1024)] = 0

    def __post_init__(self) -> None:
        check_fields(self, "encoder.")


@dataclass(frozen=True)
class ModelConfig:
    """Settings saved with the weights by `save_pretrained`.

    Attributes:
        chains: `joint`, or one chain alone: `matching`, `clustering`.
        coupling: of the joint chains: `motions` (the paper's) or `lattice`: both labels of a point are decided jointly (spec 7.7).
        start: `search` (hypotheses over the whole scene), `paper` (spec 7.3: association chain, then runs of residuals) or `points`
            (the same chain, then one cluster a point, of which the vacuous ones are discarded).
        encoder: of the scans' points; none by default.
    """

    chains: Annotated[str, OneOf(*CHAINS)] = "joint"
    coupling: Annotated[str, OneOf(*COUPLINGS)] = "motions"
    start: Annotated[str, OneOf(*STARTS)] = "search"
    features: FeatureConfig = field(default_factory=FeatureConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.encoder.width > 0:
            self.require("takes_extras", "for a model with an encoder")
        if self.encoder.embedding > 0 and self.features.embedding == "none":
            raise TorchCRFScanError("features.embedding: expected dot or cosine for an encoder that makes embeddings, got none")
        schedule, is_one_chain = self.inference.schedule, bool(COUPLINGS[self.coupling].chain)
        two_chains = " or ".join(name for name, coupling in COUPLINGS.items() if not coupling.chain)
        if is_one_chain and not (self.has_association and self.has_clusters):
            raise TorchCRFScanError(f"coupling: expected {two_chains} for the {self.chains} chain alone, got {self.coupling}")
        if self.inference.outlier_distance is not None:
            self.require("takes_limit", "with outlier_distance")
        if is_one_chain and not SCHEDULES[schedule].takes_couplings:
            raise TorchCRFScanError(f"coupling: expected {two_chains} with schedule {schedule}, got {self.coupling}")

    def with_limit(self, outlier_distance: float | None) -> ModelConfig:
        """The settings with this `outlier_distance`; None: the same. Raises TorchCRFScanError for one that they do not take."""
        if outlier_distance is None:
            return self
        return replace(self, inference=replace(self.inference, outlier_distance=outlier_distance))

    @property
    def has_association(self) -> bool:
        """Whether the model has the association chain."""
        return CHAINS[self.chains].has_association

    @property
    def has_clusters(self) -> bool:
        """Whether the model has the clustering chain."""
        return CHAINS[self.chains].has_clusters

    @property
    def motions(self) -> int:
        """C: number of motions, the background and the maximum number of movers."""
        return self.inference.clusters - 1 if self.has_clusters else 1

    def without(self, ability: str) -> dict[str, str]:
        """The settings of the rounds whose variant lacks an ability (`choices.Variant`), with their values."""
        chosen = {name: getattr(self.inference if name in OF_INFERENCE else self, name) for name in OF_ROUNDS}
        return {name: value for name, value in chosen.items() if not getattr(OF_ROUNDS[name][value], ability)}

    def require(self, ability: str, purpose: str) -> None:
        """Raises TorchCRFScanError if a variant lacks an ability that a purpose needs."""
        for name, value in self.without(ability).items():
            raise TorchCRFScanError(
                f"{name}: expected {' or '.join(with_ability(OF_ROUNDS[name], ability))} {purpose}, got {value}"
            )
