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
    left_out: tuple[str, ...] = LEFT_OUT

    def __post_init__(self) -> None:
        for name in self.left_out:
            _choose("left_out", name, WEIGHTS)
        _choose("length_unit", self.length_unit, ("spacing", "metre"))


@dataclass(frozen=True)
class ModelConfig:
    """Everything that `save_pretrained` writes beside the weights.

    Attributes:
        chains: `joint`, or one chain alone: `matching`, `clustering`.
        coupling: of the joint chains: `motions` (the paper's) or `lattice`: both labels of a point are decided at once (spec 7.7).
        start: `search` (hypotheses over the whole scene), `paper` (spec 7.3: association chain, then runs of residuals) or `points`
            (the same chain, then one cluster a point, of which the vacuous ones are discarded).
    """

    chains: str = "joint"
    coupling: str = "motions"
    start: str = "search"
    features: FeatureConfig = field(default_factory=FeatureConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)

    def __post_init__(self) -> None:
        _choose("chains", self.chains, ("joint", "matching", "clustering"))
        _choose("coupling", self.coupling, ("motions", "lattice"))
        _choose("start", self.start, ("search", "paper", "points"))
        if self.coupling == "lattice" and self.chains != "joint":
            raise ValueError(f"coupling: expected motions for the {self.chains} chain alone, got lattice")
        if self.coupling == "lattice" and self.inference.schedule != "sweep":
            raise ValueError(f"coupling: expected motions with schedule {self.inference.schedule}, got lattice")


@dataclass(frozen=True)
class LearningConfig:
    """How the model is learned (spec 2, 6).

    Attributes:
        rotation_noise: radians of noise on the true motions.
        translation_noise: metres of noise on the true motions.
        objective: `pseudo_likelihood` (the paper's), or `likelihood`: the exact likelihood of each chain, without the former's
            over-strong pairwise weights (spec 6.5).
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
        _choose("objective", self.objective, ("pseudo_likelihood", "likelihood"))


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
    """

    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
    output: str = "runs/default"
    overfit: bool = False
    compare_chains: bool = True
