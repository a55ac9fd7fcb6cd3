"""Settings of learning: data, losses, optimisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

from torchcrf_scan.checks import Amount, OneOf, Positive, Seed, Share, Within, check_fields
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.learning.losses import LOSSES, NO_STEPS, STAGED

Count = Annotated[int, Within(1, 1_000_000)]
CountOrNone = Annotated[int, Within(0, 1_000_000)]
World = Annotated[str, OneOf(*NAMED_WORLDS)]


@dataclass(frozen=True)
class UnrolledConfig:
    """The objective `unrolled`: losses on soft read-outs after a fixed number of rounds, at inferred motions.

    Attributes:
        iterations: number of rounds, without early stopping.
        temperature: of the read-out: log-beliefs (max-marginals, where `inference.temperature` is 0) are divided by it.
        association: weight of the associations' cross-entropy.
        cluster: weight of the clusters' cross-entropy.
        rotation: weight of the motions' robust geodesic loss.
        translation: weight of the robust loss of the position of a cluster's moved centroid.
        rotation_scale: radians; the loss is quadratic for smaller errors and logarithmic for larger ones.
        translation_scale: metres (scaled as by `length_unit: spacing`), likewise.
        detach_motion: no gradient passes through a motion into the features of the next pass.
        deep_supervision: factor between the weights of a round and of the next; 0: the last round alone, 1: all rounds equally.
    """

    iterations: Annotated[int, Within(1, 1000)] = 4
    temperature: Positive = 1.0
    association: Amount = 1.0
    cluster: Amount = 1.0
    rotation: Amount = 0.2
    translation: Amount = 0.2
    rotation_scale: Positive = 0.02
    translation_scale: Positive = 0.1
    detach_motion: bool = False
    deep_supervision: Share = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "unrolled.")


@dataclass(frozen=True)
class LearningConfig:
    """Settings of the staged fit (spec 2, 6).

    Attributes:
        objective: `pseudo_likelihood` (the paper's), or `likelihood`: the exact likelihood of each chain, without the former's
            over-strong pairwise weights (spec 6.5); or `unrolled`: first-order steps through the unrolled iterations, starting
            from the weights of pseudo-likelihood (`gradient`).
        predicted_share: share of the pairs whose clustering features use predicted associations (A-28). 0, the true ones, for
            pseudo-likelihood: given its neighbours' true clusters a point learns little else, and movers then vanish; 0.5 suits
            `likelihood`. CRF-Clustering alone always uses predicted ones.
        folds: folds of the training pairs for out-of-fold margins; sequences stay whole. 0: margins on the same pairs (faithful).
        negatives: wrong pairs per true one for the data booster.
        booster_examples: maximum number of examples of a booster, drawn at random; 0: all.
        prior: standard deviation s_w of the weights' Gaussian prior, on standardised features.
        max_steps: maximum number of L-BFGS steps.
        tolerance: gradient per node at which L-BFGS stops.
        batch_size: pairs processed at once.
        rotation_noise: radians of noise on the true motions.
        translation_noise: metres of noise on the true motions.
        disturbance: units of resolution by which training scans are skewed and bumped, as by moving sensors; 0: undisturbed.
        start_share: share of the pairs whose features use InitialiseRT's motions instead.
        seed: of all random draws while learning.
    """

    objective: Annotated[str, OneOf(*LOSSES)] = STAGED
    predicted_share: Share = 0.0
    folds: Annotated[int, Within(0, 1000)] = 4
    negatives: Annotated[int, Within(1, 1000)] = 4
    booster_examples: Annotated[int, Within(0)] = 5_000
    prior: Positive = 10.0
    max_steps: Count = 200
    tolerance: Amount = 1e-4
    batch_size: Annotated[int, Within(1, 10_000)] = 16
    rotation_noise: Amount = 0.005
    translation_noise: Amount = 0.02
    disturbance: Amount = 0.7
    start_share: Share = 0.5
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_fields(self, "learning.")


@dataclass(frozen=True)
class AugmentConfig:
    """Augmentation of training pairs; 0 turns an augmentation off.

    Attributes:
        mirror: share of the pairs that are mirrored, left for right.
        dropout: largest share of the returns of a scan that are dropped.
        noise: largest noise added to the returns, in units of the sensor's own.
        frame_rotation: radians by which the target's frame is rotated, at most.
        frame_translation: largest shift of the target's frame along x and y, in units of the usual range of the target.
    """

    mirror: Share = 0.5
    dropout: Annotated[float, Within(0, 0.9)] = 0.1
    noise: Amount = 1.0
    frame_rotation: Annotated[float, Within(0, math.pi)] = 0.05
    frame_translation: Amount = 0.02

    def __post_init__(self) -> None:
        check_fields(self, "gradient.augment.")

    @classmethod
    def nothing(cls) -> AugmentConfig:
        """Settings without any augmentation."""
        return cls(mirror=0.0, dropout=0.0, noise=0.0, frame_rotation=0.0, frame_translation=0.0)


@dataclass(frozen=True)
class GradientConfig:
    """First-order training from the weights of the staged fit or of `init`: AdamW on pairs that are generated on the fly.

    Attributes:
        objective: loss of the steps: `pseudo_likelihood`, `likelihood` (exact, of each chain at the start's motions) or
            `unrolled`; `none`: staged fit only. With `learning.objective` unrolled it is `unrolled`.
        steps: maximum number of optimiser steps.
        batch_size: pairs of a step, of all processes together.
        part: pairs processed at once; a step's parts are divided among the processes. Divides `batch_size`.
        workers: processes that generate pairs, per training process; 0: generated in the training process.
        learning_rate: maximum of the schedule.
        weight_decay: of AdamW.
        warmup: steps of linear increase to the maximal learning rate, which then decays along a cosine.
        final_rate: final learning rate as a share of the maximum.
        average: share of the steps, the last ones, whose mean weights are kept where nothing is validated; 0: the last weights.
        trained_share: weight of the trained log potentials in their mean with the initial ones; 1: the trained ones alone. Less
            holds better on data unlike the training worlds (Wortsman et al., Robust fine-tuning, 2022).
        clip: norm to which gradients are clipped; 0: no clipping.
        amp: bfloat16 on GPUs that support it (torch.autocast); CPUs always use full precision.
        device: `auto` (a GPU if there is one), `cpu` or `cuda`.
        worlds: names of the simulated `NAMED_WORLDS` that pairs are drawn from.
        fresh: share of the pairs that are simulated on the fly; the others are drawn from the training pairs.
        validation: share of the training pairs, in whole sequences, held out for validation; 0: no validation, and the last
            weights are kept instead of the best.
        validate_every: steps between validations.
        patience: validations without improvement after which training stops early; 0: never.
        checkpoint_every: steps between checkpoints.
        refit_potential: fit the potential of movers' clusters anew after the steps; off, that of the initial weights is kept.
        graph: draw the module's graph in TensorBoard, which takes some seconds.
        seed: of all random draws: pair k of a run is a function of (seed, k) alone.
    """

    objective: Annotated[str, OneOf(NO_STEPS, *LOSSES)] = NO_STEPS
    steps: Count = 200
    batch_size: Annotated[int, Within(1, 10_000)] = 8
    part: Annotated[int, Within(1, 10_000)] = 4
    workers: Annotated[int, Within(0, 1000)] = 1
    learning_rate: Positive = 0.01
    weight_decay: Amount = 0.0
    warmup: CountOrNone = 10
    final_rate: Share = 0.05
    average: Share = 0.0
    trained_share: Share = 1.0
    clip: Amount = 1.0
    amp: bool = False
    device: Annotated[str, OneOf("auto", "cpu", "cuda")] = "auto"
    worlds: tuple[World, ...] = ("street",)
    fresh: Share = 1.0
    validation: Annotated[float, Within(0, 1, below=True)] = 0.25
    validate_every: Count = 20
    patience: CountOrNone = 5
    checkpoint_every: Count = 20
    refit_potential: bool = True
    graph: bool = True
    seed: Seed = 0
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        check_fields(self, "gradient.")
        if self.batch_size % self.part:
            raise TorchCRFScanError(f"gradient.part: expected a divisor of batch_size = {self.batch_size}, got {self.part}")
        if self.fresh > 0 and not self.worlds:
            raise TorchCRFScanError(f"gradient.worlds: expected at least one with gradient.fresh = {self.fresh}, got none")


@dataclass(frozen=True)
class DataConfig:
    """Sources of annotated pairs: files, the simulator, or both.

    Attributes:
        train: a file, folder or glob pattern of training pairs, or a list of them.
        test: the same for test pairs.
        unlabelled: a recording that nobody annotated, or a list of them: pairs of which `ScanStream` is sure over four scans are
            trained on too, with their confidence as weight (`learning.self_labelled`).
        unlabelled_pairs: at most so many of each.
        simulate_train: names of simulated `NAMED_WORLDS` to train on too, `pairs` pairs each. For other worlds,
            `torchcrf-scan simulate` writes files.
        simulate_test: names of simulated `NAMED_WORLDS` to test on too; train and test never share a seed.
        pairs: pairs of every simulated world.
        sequences: sequences of every simulated world.
        seed: of the simulator.
    """

    train: tuple[str, ...] | str = ()
    test: tuple[str, ...] | str = ()
    unlabelled: tuple[str, ...] | str = ()
    unlabelled_pairs: Annotated[int, Within(1, 100_000)] = 60
    simulate_train: tuple[World, ...] = ("street",)
    simulate_test: tuple[World, ...] = ("street",)
    pairs: Annotated[int, Within(1, 100_000)] = 31
    sequences: Annotated[int, Within(1, 100_000)] = 8
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_fields(self, "data.")


@dataclass(frozen=True)
class Config:
    """One training run.

    Attributes:
        output: run folder for resolved config, versions, model, metrics, events and pictures.
        overfit: train and test on the first training pair alone, a quick check that everything can learn.
        compare_chains: also fit and evaluate CRF-Matching and CRF-Clustering alone.
        init: a model, as a folder or by the name of a shipped one, with the initial weights of first-order training; none: those
            of the staged fit. Without first-order training it is fitted to the training pairs (`learning.own_laser`): weights
            around its own, with the prior `learning.prior`, and every part of `torchcrf-scan calibrate`, where pairs left out
            gain. The sequences that it was trained on (`learning.leaks`) must not be tested.
    """

    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    gradient: GradientConfig = field(default_factory=GradientConfig)
    unrolled: UnrolledConfig = field(default_factory=UnrolledConfig)
    output: str = "runs/default"
    overfit: bool = False
    compare_chains: bool = True
    init: str = ""

    def __post_init__(self) -> None:
        check_fields(self)
        other, staged = self.gradient.objective, self.learning.objective
        if not LOSSES[staged].is_staged and other not in (NO_STEPS, staged):
            raise TorchCRFScanError(f"gradient.objective: expected {staged} with learning.objective {staged}, got {other}")

    @property
    def first_order(self) -> str:
        """The loss of first-order training: `none`, or one of `GradientConfig.objective`."""
        return self.gradient.objective if LOSSES[self.learning.objective].is_staged else self.learning.objective

    @property
    def has_steps(self) -> bool:
        """Whether there is first-order training."""
        return self.first_order != NO_STEPS

    @property
    def fits_init(self) -> bool:
        """Whether the model of `init` is fitted to the training pairs as it is, without first-order training."""
        return bool(self.init) and not self.has_steps

    @property
    def staged(self) -> LearningConfig:
        """Settings of the staged fit; a loss that it does not support is replaced by `STAGED`."""
        return self.learning if LOSSES[self.learning.objective].is_staged else replace(self.learning, objective=STAGED)
