"""Every setting of the package as frozen dataclasses; `configs/*.yaml` and the command line fill them in (jsonargparse)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torchcrf_scan.checks import choose, within
from torchcrf_scan.choices import CHAINS, COUPLINGS, OF_INFERENCE, OF_MODEL, OF_ROUNDS, SCHEDULES, with_ability
from torchcrf_scan.names import WEIGHTS

LEFT_OUT = (
    *("association.pairwise_distance", "association.pairwise_translation"),
    *("clustering.gate", "clustering.outlier_bias"),
)  # by default


@dataclass(frozen=True)
class InferenceConfig:
    """How the model is decoded (spec 7).

    Attributes:
        clusters: D, states of the clustering chain: background, movers, outlier.
        candidates: K inlier states of a point; 0 = every target point (dense).
        candidate_search: the K nearest under the present motions (`motion`), in raw position (`position`), or the K most alike in
            shape (`shape`).
        schedule: `sweep` (exact passes over each chain, motions between) or `flooding` (Algorithm 1 node by node).
        flooding_order: `alternate` or `ascending` (A-20), for flooding only.
        iterations: rounds at most.
        stop_early: stop when everything has settled; off, exactly `iterations` rounds are unrolled.
        temperature: 0 = max-product, 1 = sum-product.
        motion_weights: `hard` (labels, the paper's) or `soft` (beliefs; lets gradients reach the weights).
        motion_metric: `point` (Kabsch, the paper's) or `line` (robust point-to-line step); or `given`: the motions stay those of
            the start (in the `sweep`).
        movers: `joint`: the clustering chain has its say in which hypothesised movers there are; `threshold`: their score decides
            (so in `flooding`).
        detach_motion: no gradient passes through a motion into the features of the next pass; motions keep their own.
        backend: `compiled` (numba, extra `fast`: on a CPU, without gradients) or `eager`; `auto`: compiled where that is possible.
        min_extent: metres (in the unit `spacing`, those of a street scanner); a smaller cluster takes the background's rotation.
        rotation_tolerance: radians below which a motion has settled.
        translation_tolerance: metres below which a motion has settled.
    """

    clusters: int = 8
    candidates: int = 8
    candidate_search: str = "motion"
    schedule: str = "sweep"
    flooding_order: str = "alternate"
    iterations: int = 10
    stop_early: bool = True
    temperature: float = 0.0
    motion_weights: str = "hard"
    motion_metric: str = "line"
    movers: str = "joint"
    detach_motion: bool = False
    backend: str = "auto"
    min_extent: float = 0.1
    rotation_tolerance: float = 1e-4
    translation_tolerance: float = 1e-3

    def __post_init__(self) -> None:
        for name, register in OF_INFERENCE.items():
            choose(name, getattr(self, name), tuple(register))
        choose("flooding_order", self.flooding_order, ("alternate", "ascending"))
        choose("backend", self.backend, ("auto", "compiled", "eager"))
        if self.clusters < 2:
            raise ValueError(f"clusters: expected at least 2 (background and outlier), got {self.clusters}")
        for name in ("candidates", "iterations", "temperature"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True)
class FeatureConfig:
    """Which features the model has.

    Attributes:
        raw_channels: the 12 local channels enter the potentials beside the boosted scores (W-A); off, they only feed the boosters
            (W-B, the literal text).
        wrap_closed: neighbours wrap round a closed scan (A-06); off, they clamp as in the paper.
        length_unit: what lengths are measured in: `spacing` (what each pair's own scans resolve, so one set of weights serves a
            street and a table top) or `metre`, the paper's.
        stumps: decision stumps in each booster.
        free_space: what beams see through and what hides from them, as extension weights of both chains (design finding 13).
        decisions: what parts inliers from outliers and the nearest target point from others, as extension weights of both chains:
            a gate on the residual, a constant, the lead of the nearest. This and `free_space` off: the paper's 30.
        smooth: width of the stumps' sigmoids, in units of the boosted features (robust squares, 0 to -9); 0: steps. As the width
            goes to 0 the margins become those of the steps that were fitted; a tenth changes hardly an answer. Above 0, gradients
            reach points and motions through them.
        learn_stumps: thresholds and tables of the boosters are parameters, learned with the weights; needs `smooth` above 0.
        embedding: `dot` (scaled dot product) or `cosine`: the similarity of embeddings given to `forward` scores associations
            (`features.learned`), with two named weights more; or `none`.
        left_out: features that the model does without, as `association.NAME` or `clustering.NAME` of a weight; a local channel is
            then hidden from the boosters too. By default the two that compare an edge's length, which call sparsely sampled
            surfaces outliers, and the decisions of the clustering chain, which cost it movers.
    """

    raw_channels: bool = True
    wrap_closed: bool = True
    length_unit: str = "spacing"
    stumps: int = 50
    free_space: bool = True
    decisions: bool = True
    smooth: float = 0.0
    learn_stumps: bool = False
    embedding: str = "none"
    left_out: tuple[str, ...] = LEFT_OUT

    def __post_init__(self) -> None:
        for name in self.left_out:
            choose("left_out", name, WEIGHTS)
        choose("length_unit", self.length_unit, ("spacing", "metre"))
        choose("embedding", self.embedding, ("none", "dot", "cosine"))
        if not 0 <= self.smooth < math.inf:
            raise ValueError(f"smooth: expected a finite width of 0 or more, got {self.smooth}")
        if self.learn_stumps and self.smooth == 0:
            raise ValueError("learn_stumps: expected smooth above 0 (steps have no gradient), got smooth 0")


@dataclass(frozen=True)
class EncoderConfig:
    """A convolutional encoder of the scans' points (`torchcrf_scan.encoder`), part of the model and learned with it.

    Attributes:
        width: channels of its layers; 0: the model has no encoder.
        dilations: points between the taps of each layer; twice their sum is how far it sees along a scan.
        embedding: channels of the embeddings it makes beside its log potentials, which needs `features.embedding`; 0: none.
    """

    width: int = 0
    dilations: tuple[int, ...] = (1, 2, 4, 8, 16)
    embedding: int = 0

    def __post_init__(self) -> None:
        for name in ("width", "embedding"):
            within(f"encoder.{name}", getattr(self, name), 0, math.inf)
        for dilation in self.dilations:
            within("encoder.dilations", dilation, 1, math.inf)


@dataclass(frozen=True)
class ModelConfig:
    """Everything that `save_pretrained` writes beside the weights.

    Attributes:
        chains: `joint`, or one chain alone: `matching`, `clustering`.
        coupling: of the joint chains: `motions` (the paper's) or `lattice`: both labels of a point are decided at once (spec 7.7).
        start: `search` (hypotheses over the whole scene), `paper` (spec 7.3: association chain, then runs of residuals) or `points`
            (the same chain, then one cluster a point, of which the vacuous ones are discarded).
        encoder: of the scans' points; by default there is none.
    """

    chains: str = "joint"
    coupling: str = "motions"
    start: str = "search"
    features: FeatureConfig = field(default_factory=FeatureConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)

    def __post_init__(self) -> None:
        for name, register in OF_MODEL.items():
            choose(name, getattr(self, name), tuple(register))
        if self.encoder.width > 0:
            self.require("takes_extras", "for a model with an encoder")
        if self.encoder.embedding > 0 and self.features.embedding == "none":
            raise ValueError("features.embedding: expected dot or cosine for an encoder that makes embeddings, got none")
        schedule, is_one_chain = self.inference.schedule, bool(COUPLINGS[self.coupling].chain)
        two_chains = " or ".join(name for name, coupling in COUPLINGS.items() if not coupling.chain)
        if is_one_chain and not (self.has_association and self.has_clusters):
            raise ValueError(f"coupling: expected {two_chains} for the {self.chains} chain alone, got {self.coupling}")
        if is_one_chain and not SCHEDULES[schedule].takes_couplings:
            raise ValueError(f"coupling: expected {two_chains} with schedule {schedule}, got {self.coupling}")

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
        """C: motions of the background and of as many movers as there may be."""
        return self.inference.clusters - 1 if self.has_clusters else 1

    def without(self, ability: str) -> dict[str, str]:
        """The settings of the rounds, with their values, whose variant lacks an ability (`choices.Variant`)."""
        chosen = {name: getattr(self.inference if name in OF_INFERENCE else self, name) for name in OF_ROUNDS}
        return {name: value for name, value in chosen.items() if not getattr(OF_ROUNDS[name][value], ability)}

    def require(self, ability: str, purpose: str) -> None:
        """Raises ValueError where a variant lacks an ability that a purpose needs."""
        for name, value in self.without(ability).items():
            raise ValueError(f"{name}: expected {' or '.join(with_ability(OF_ROUNDS[name], ability))} {purpose}, got {value}")
