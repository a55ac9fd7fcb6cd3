"""Every setting of the package as frozen dataclasses; `configs/*.yaml` and the command line fill them in (jsonargparse)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from torchcrf_scan.features.scales import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS

LEFT_OUT = (
    *("association.pairwise_distance", "association.pairwise_translation"),
    *("clustering.gate", "clustering.outlier_bias"),
)  # by default
WEIGHTS = (*(f"association.{name}" for name in ASSOCIATION_WEIGHTS), *(f"clustering.{name}" for name in CLUSTERING_WEIGHTS))


@dataclass(frozen=True)
class SimulatorConfig:
    """The simulated world, its sensor and its traffic (lengths in metres, speeds in m/s).

    Attributes:
        scene: `street` (a car among facades, trees and traffic) or `indoor` (a robot among walls, furniture and people).
        beams: beams of the sensor.
        fov: field of view, degrees; 360 is a closed scan.
        range_min: nearest return.
        range_max: farthest return.
        range_noise: standard deviation of a return.
        dropout: share of beams that return nothing although they hit something.
        mixed_pixels: share of the depth edges where a beam returns a range between the near and the far surface.
        vibration: standard deviation of the sensor's pitch and jolts, seen as extra range noise common to neighbouring beams.
        dt: seconds between the scans of a pair.
        ego_translation: largest travel of the sensor per pair, before `scale`; indoors never more than 1.5 m/s.
        ego_rotation: largest turn of the sensor per pair, radians.
        movers_min: least number of moving objects; a pair has fewer where some are out of sight.
        movers_max: largest number of moving objects.
        clutter: amount of hedges, bushes and low crowns, whose returns are not repeatable; 2 is an ordinary street.
        dominant_mover: probability that a truck drives beside the sensor and fills 40 to 50 % of the returns of a sequence.
        aperture: probability that a car is seen along one side only and slides along it.
        scale: factor on the whole world and on every motion, but not on the sensor; 0.1 imitates 1:10 model cars.
    """

    scene: str = "street"
    beams: int = 361
    fov: float = 180.0
    range_min: float = 0.1
    range_max: float = 80.0
    range_noise: float = 0.015
    dropout: float = 0.02
    mixed_pixels: float = 0.12
    vibration: float = 0.005
    dt: float = 0.2
    ego_translation: float = 2.0
    ego_rotation: float = 0.15
    movers_min: int = 1
    movers_max: int = 4
    clutter: float = 2.0
    dominant_mover: float = 0.0
    aperture: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        shares = ("dropout", "mixed_pixels", "dominant_mover", "aperture")
        amounts = ("range_min", "range_noise", "vibration", "ego_translation", "clutter")
        rules = {
            "scene": (self.scene in ("street", "indoor"), "street or indoor"),
            "beams": (self.beams >= 1, "at least 1"),
            "fov": (0 < self.fov <= 360, "above 0 and at most 360 degrees"),
            "range_max": (self.range_min < self.range_max < math.inf, f"a finite range above range_min = {self.range_min}"),
            "dt": (0 < self.dt < math.inf, "a finite time above 0"),
            "ego_rotation": (0 <= self.ego_rotation <= math.pi, "radians between 0 and pi"),
            "movers_min": (self.movers_min >= 0, "at least 0"),
            "movers_max": (self.movers_max >= self.movers_min, f"at least movers_min = {self.movers_min}"),
            "scale": (0 < self.scale < math.inf, "a finite factor above 0"),
        }
        rules |= {name: (0 <= getattr(self, name) <= 1, "a share between 0 and 1") for name in shares}
        rules |= {name: (0 <= getattr(self, name) < math.inf, "a finite number of at least 0") for name in amounts}
        for name, (is_met, expected) in rules.items():
            if not is_met:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")


MODEL_CARS = SimulatorConfig(beams=360, fov=360.0, range_max=9.0, dropout=0.3, scale=0.1, ego_translation=4.0, ego_rotation=0.25)
WORLDS = {
    "street": SimulatorConfig(),
    "fast_street": SimulatorConfig(ego_translation=4.0, range_noise=0.03, clutter=3.0),
    "model_cars": MODEL_CARS,
    "model_cars_dominant": replace(MODEL_CARS, dominant_mover=0.5, aperture=0.5),
    "indoor": SimulatorConfig(scene="indoor", range_max=30.0, ego_translation=0.4),
    "street_dominant": SimulatorConfig(dominant_mover=0.5, aperture=0.5),
    "still_street": SimulatorConfig(movers_min=0, movers_max=0),
    "still_indoor": SimulatorConfig(scene="indoor", range_max=30.0, ego_translation=0.4, movers_min=0, movers_max=0),
}


def _choose(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value}")


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:  # NaN is not
        expected = f"{least} or more" if most == math.inf else f"a number in [{least}, {most:g}]"
        raise ValueError(f"{name}: expected {expected}, got {value}")


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
        _choose("candidate_search", self.candidate_search, ("motion", "position", "shape"))
        _choose("schedule", self.schedule, ("sweep", "flooding"))
        _choose("flooding_order", self.flooding_order, ("alternate", "ascending"))
        _choose("motion_weights", self.motion_weights, ("hard", "soft"))
        _choose("movers", self.movers, ("joint", "threshold"))
        _choose("backend", self.backend, ("auto", "compiled", "eager"))
        _choose("motion_metric", self.motion_metric, ("point", "line", "given"))
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
            _choose("left_out", name, WEIGHTS)
        _choose("length_unit", self.length_unit, ("spacing", "metre"))
        _choose("embedding", self.embedding, ("none", "dot", "cosine"))
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
            _within(f"encoder.{name}", getattr(self, name), 0, math.inf)
        for dilation in self.dilations:
            _within("encoder.dilations", dilation, 1, math.inf)


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
        if self.encoder.width > 0 and self.inference.schedule == "flooding":
            raise ValueError("schedule: expected sweep for a model with an encoder, got flooding")
        if self.encoder.embedding > 0 and self.features.embedding == "none":
            raise ValueError("features.embedding: expected dot or cosine for an encoder that makes embeddings, got none")
        _choose("chains", self.chains, ("joint", "matching", "clustering"))
        _choose("coupling", self.coupling, ("motions", "lattice"))
        _choose("start", self.start, ("search", "paper", "points"))
        if self.coupling == "lattice" and self.chains != "joint":
            raise ValueError(f"coupling: expected motions for the {self.chains} chain alone, got lattice")
        if self.coupling == "lattice" and self.inference.schedule != "sweep":
            raise ValueError(f"coupling: expected motions with schedule {self.inference.schedule}, got lattice")


@dataclass(frozen=True)
class UnrolledConfig:
    """The objective `unrolled`: losses on soft read-outs after a fixed number of rounds, at inferred motions.

    Attributes:
        iterations: rounds, always all of them.
        temperature: of the read-out: log-beliefs (max-marginals, where `inference.temperature` is 0) are divided by it.
        association: weight of the associations' cross-entropy.
        cluster: weight of the clusters' cross-entropy.
        rotation: weight of the motions' robust geodesic loss.
        translation: weight of the motions' robust loss of where a cluster's centroid lands.
        rotation_scale: radians; smaller errors count squared, larger ones by their logarithm.
        translation_scale: metres (in the unit `spacing`, those of a street scanner), likewise.
        detach_motion: no gradient passes through a motion into the features of the next pass.
        deep_supervision: earlier rounds count too, each by this factor less than the next; 0: the last alone, 1: all alike.
    """

    iterations: int = 4
    temperature: float = 1.0
    association: float = 1.0
    cluster: float = 1.0
    rotation: float = 0.2
    translation: float = 0.2
    rotation_scale: float = 0.02
    translation_scale: float = 0.1
    detach_motion: bool = False
    deep_supervision: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {self.iterations}")
        for name in ("temperature", "rotation_scale", "translation_scale"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number above 0, got {getattr(self, name)}")
        for name in ("association", "cluster", "rotation", "translation"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite weight of 0 or more, got {getattr(self, name)}")
        if not 0 <= self.deep_supervision <= 1:
            raise ValueError(f"deep_supervision: expected a factor between 0 and 1, got {self.deep_supervision}")


@dataclass(frozen=True)
class LearningConfig:
    """How the model is learned (spec 2, 6).

    Attributes:
        rotation_noise: radians of noise on the true motions.
        translation_noise: metres of noise on the true motions.
        objective: `pseudo_likelihood` (the paper's), or `likelihood`: the exact likelihood of each chain, without the former's
            over-strong pairwise weights (spec 6.5); or `unrolled`: from the weights of pseudo-likelihood on through the unrolled
            iterations, step by step (`gradient`).
        disturbance: units of resolution by which training scans are skewed and bumped, as moving sensors do; 0: as they are.
        start_share: share of the pairs whose features see InitialiseRT's motions instead.
        predicted_share: share of the pairs whose clustering features see predicted associations (A-28). 0, the true ones, for
            pseudo-likelihood: given its neighbours' true clusters a point learns little else, and movers then fade; a half suits
            `likelihood`. CRF-Clustering alone always sees predicted ones.
        folds: parts of the training pairs for out-of-fold margins; sequences stay whole. 0: margins on the same pairs (faithful).
        negatives: wrong pairs per true one for the data booster.
        booster_examples: examples that a booster sees at most, drawn at random; 0: all.
        prior: standard deviation s_w of the weights' Gaussian prior, on standardised features.
        max_steps: L-BFGS steps at most.
        tolerance: gradient per node at which L-BFGS stops.
        batch_size: pairs that are looked at at once.
        seed: of everything drawn while learning.
    """

    objective: str = "pseudo_likelihood"
    rotation_noise: float = 0.005
    translation_noise: float = 0.02
    disturbance: float = 0.7
    start_share: float = 0.5
    predicted_share: float = 0.0
    folds: int = 4
    negatives: int = 4
    booster_examples: int = 5_000
    prior: float = 10.0
    max_steps: int = 200
    tolerance: float = 1e-4
    batch_size: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        _choose("objective", self.objective, ("pseudo_likelihood", "likelihood", "unrolled"))


@dataclass(frozen=True)
class AugmentConfig:
    """How training pairs are varied as they are generated; 0 leaves a pair as it is.

    Attributes:
        mirror: share of the pairs that are mirrored, left for right.
        dropout: largest share of the returns of a scan that are lost.
        noise: largest noise that is added to the returns, in units of the sensor's own.
        frame_rotation: radians by which the target's frame is turned, at most.
        frame_translation: how far the target's frame is moved along x and y, at most; in units of the usual range of the target.
    """

    mirror: float = 0.5
    dropout: float = 0.1
    noise: float = 1.0
    frame_rotation: float = 0.05
    frame_translation: float = 0.02

    def __post_init__(self) -> None:
        for name, most in (("mirror", 1.0), ("dropout", 0.9), ("noise", math.inf), ("frame_rotation", math.pi)):
            _within(f"gradient.augment.{name}", getattr(self, name), 0.0, most)
        _within("gradient.augment.frame_translation", self.frame_translation, 0.0, math.inf)

    @classmethod
    def nothing(cls) -> AugmentConfig:
        """Pairs stay as they are."""
        return cls(mirror=0.0, dropout=0.0, noise=0.0, frame_rotation=0.0, frame_translation=0.0)


@dataclass(frozen=True)
class GradientConfig:
    """First-order training, which goes on from the staged fit or from `init`: AdamW on pairs that are generated on the fly.

    Attributes:
        objective: loss of the steps: `pseudo_likelihood`, `likelihood` (exact, of each chain at the start's motions) or
            `unrolled`; `none`: no steps, the staged fit is all. With `learning.objective` unrolled it is `unrolled`.
        steps: optimiser's steps at most.
        batch_size: pairs of a step, of all processes together.
        part: pairs that are looked at at once; a step's parts are shared out among the processes. Divides `batch_size`.
        workers: processes that generate pairs, of every training process; 0: none beside it.
        learning_rate: at its highest.
        weight_decay: of AdamW.
        warmup: steps until the learning rate is at its highest; after that it falls along a cosine.
        final_rate: share of the highest learning rate that is left in the end.
        clip: norm that gradients are cut to; 0: never.
        amp: bfloat16 where the device is a GPU that has it (torch.autocast); a CPU always calculates in full precision.
        device: `auto` (a GPU where there is one), `cpu` or `cuda`.
        worlds: names of the simulated `WORLDS` that pairs are drawn from.
        fresh: share of the pairs that are simulated on the fly; the others are drawn from the training pairs.
        validation: share of the training pairs, in whole sequences, that nothing is fitted on; 0: no validation, and the last
            weights are kept instead of the best.
        validate_every: steps between two looks at the validation pairs.
        patience: looks without a better loss after which training stops early; 0: never.
        checkpoint_every: steps between two checkpoints.
        graph: draw the module's graph in TensorBoard, which takes some seconds.
        seed: of everything drawn: pair k of a run is a function of (seed, k) alone.
    """

    objective: str = "none"
    steps: int = 200
    batch_size: int = 8
    part: int = 4
    workers: int = 1
    learning_rate: float = 0.01
    weight_decay: float = 0.0
    warmup: int = 10
    final_rate: float = 0.05
    clip: float = 1.0
    amp: bool = False
    device: str = "auto"
    worlds: tuple[str, ...] = ("street",)
    fresh: float = 1.0
    validation: float = 0.25
    validate_every: int = 20
    patience: int = 5
    checkpoint_every: int = 20
    graph: bool = True
    seed: int = 0
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        _choose("gradient.objective", self.objective, ("none", "pseudo_likelihood", "likelihood", "unrolled"))
        _choose("gradient.device", self.device, ("auto", "cpu", "cuda"))
        for world in self.worlds:
            _choose("gradient.worlds", world, tuple(WORLDS))
        for name in ("steps", "batch_size", "part", "validate_every", "checkpoint_every"):
            _within(f"gradient.{name}", getattr(self, name), 1, math.inf)
        for name in ("workers", "weight_decay", "warmup", "clip", "patience", "seed"):
            _within(f"gradient.{name}", getattr(self, name), 0, math.inf)
        for name in ("final_rate", "fresh"):
            _within(f"gradient.{name}", getattr(self, name), 0.0, 1.0)
        if not 0 < self.learning_rate < math.inf:
            raise ValueError(f"gradient.learning_rate: expected more than 0, got {self.learning_rate}")
        if not 0 <= self.validation < 1:
            raise ValueError(f"gradient.validation: expected a share in [0, 1), got {self.validation}")
        if self.batch_size % self.part:
            raise ValueError(f"gradient.part: expected a divisor of batch_size = {self.batch_size}, got {self.part}")
        if self.fresh > 0 and not self.worlds:
            raise ValueError(f"gradient.worlds: expected at least one with gradient.fresh = {self.fresh}, got none")


@dataclass(frozen=True)
class DataConfig:
    """Where annotated pairs come from: files, the simulator, or both.

    Attributes:
        train: a file, folder or glob pattern of training pairs, or a list of them.
        test: the same for test pairs.
        simulate_train: names of simulated `WORLDS` to train on too, `pairs` pairs each. For other worlds, `torchcrf-scan simulate`
            writes files.
        simulate_test: names of simulated `WORLDS` to test on too; train and test never share a seed.
        pairs: pairs of every simulated world.
        sequences: sequences of every simulated world.
        seed: of the simulator.
    """

    train: tuple[str, ...] | str = ()
    test: tuple[str, ...] | str = ()
    simulate_train: tuple[str, ...] = ("street",)
    simulate_test: tuple[str, ...] = ("street",)
    pairs: int = 31
    sequences: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("simulate_train", "simulate_test"):
            for world in getattr(self, name):
                _choose(name, world, tuple(WORLDS))


@dataclass(frozen=True)
class ExperimentConfig:
    """The paper's experiment, `torchcrf-scan experiment`: every pair is tested by models that have not seen it.

    Attributes:
        pairs: a file, folder or glob pattern of the annotated pairs, or a list of them; none: the simulated `worlds`.
        worlds: names of simulated `WORLDS`, `data.pairs` pairs each, where no files are given.
        also_train: names of simulated `WORLDS` that every fold trains on besides, `data.pairs` pairs each.
        protocols: `leave_one_pair_out` (the paper's; consecutive pairs share a scan, so it leaks) and `leave_one_sequence_out`.
        joint_alone: of all the methods, only the joint model (for ablations).
        test_every: test every so many pairs only, for models that are slow to decode.
        leave_out: features, named as in `FeatureConfig.left_out`: a variant without each of them (for ablations).
        joint_variants: in leave_one_sequence_out, the joint model by exact likelihood and as a lattice too (half of a fold's time).
        figures: pairs to draw, as SEQUENCE:NUMBER, the number counting from 0; none: one of each of the first three.
        resamples: of the bootstrap.
        jobs: processes; 0: one a core.
    """

    pairs: tuple[str, ...] | str = ()
    worlds: tuple[str, ...] = ("street",)
    also_train: tuple[str, ...] = ()
    protocols: tuple[str, ...] = ("leave_one_pair_out", "leave_one_sequence_out")
    joint_alone: bool = False
    test_every: int = 1
    leave_out: tuple[str, ...] = ()
    joint_variants: bool = True
    figures: tuple[str, ...] = ()
    resamples: int = 2000
    jobs: int = 0

    def __post_init__(self) -> None:
        for world in (*self.worlds, *self.also_train):
            _choose("worlds", world, tuple(WORLDS))
        for protocol in self.protocols:
            _choose("protocols", protocol, ("leave_one_pair_out", "leave_one_sequence_out"))
        for name, least in (("test_every", 1), ("resamples", 1), ("jobs", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more, got {getattr(self, name)}")


@dataclass(frozen=True)
class Config:
    """One run of `train.py` or of `torchcrf-scan experiment`.

    Attributes:
        experiment: what `torchcrf-scan experiment` does; `train.py` does not look at it.
        output: run folder; resolved config, versions, model, metrics, events and pictures go there.
        overfit: train and test on the first training pair alone, a quick check that everything can learn.
        compare_chains: also fit and evaluate CRF-Matching and CRF-Clustering alone.
        init: a model, as a folder or by the name of a shipped one, whose weights first-order training begins with; none: it begins
            with those of the staged fit.
    """

    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    gradient: GradientConfig = field(default_factory=GradientConfig)
    unrolled: UnrolledConfig = field(default_factory=UnrolledConfig)
    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
    output: str = "runs/default"
    overfit: bool = False
    compare_chains: bool = True
    init: str = ""

    def __post_init__(self) -> None:
        other = self.gradient.objective
        if self.learning.objective == "unrolled" and other not in ("none", "unrolled"):
            raise ValueError(f"gradient.objective: expected unrolled with learning.objective unrolled, got {other}")
        if self.init and self.first_order == "none":
            raise ValueError(f"init: expected a gradient.objective to go on with from {self.init}, got none")

    @property
    def first_order(self) -> str:
        """The loss of first-order training: `none`, or one of `GradientConfig.objective`."""
        return "unrolled" if self.learning.objective == "unrolled" else self.gradient.objective

    @property
    def staged(self) -> LearningConfig:
        """How the staged fit learns: what goes on through the unrolled iterations begins with pseudo-likelihood."""
        return replace(self.learning, objective="pseudo_likelihood") if self.learning.objective == "unrolled" else self.learning
