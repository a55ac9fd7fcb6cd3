"""Settings of the paper's experiment, in addition to those of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from torchcrf_scan.checks import OneOf, Within, check_fields
from torchcrf_scan.learning.settings import Config, Count, World
from torchcrf_scan.names import WEIGHTS


@dataclass(frozen=True)
class ExperimentConfig:
    """The paper's experiment, `torchcrf-scan experiment`: every pair is tested by models trained without it.

    Attributes:
        pairs: a file, folder or glob pattern of the annotated pairs, or a list of them; none: the simulated `worlds`.
        worlds: names of simulated `NAMED_WORLDS`, `data.pairs` pairs each, if no files are given.
        also_train: names of simulated `NAMED_WORLDS` that every fold trains on too, `data.pairs` pairs each.
        protocols: `leave_one_pair_out` (the paper's; consecutive pairs share a scan, so it leaks) and `leave_one_sequence_out`.
        joint_alone: of all the methods, only the joint model (for ablations).
        test_every: test only every so-many-th pair, for models that are slow to decode.
        leave_out: features, named as in `FeatureConfig.left_out`: a variant without each of them (for ablations).
        joint_variants: in leave_one_sequence_out, the joint model by exact likelihood and as a lattice too (half of a fold's time).
        figures: pairs to draw, as SEQUENCE:NUMBER, the number counting from 0; none: one of each of the first three.
        resamples: of the bootstrap.
        jobs: processes; 0: one a core.
    """

    pairs: tuple[str, ...] | str = ()
    worlds: tuple[World, ...] = ("street",)
    also_train: tuple[World, ...] = ()
    protocols: tuple[Annotated[str, OneOf("leave_one_pair_out", "leave_one_sequence_out")], ...] = (
        "leave_one_pair_out",
        "leave_one_sequence_out",
    )
    joint_alone: bool = False
    test_every: Count = 1
    leave_out: tuple[Annotated[str, OneOf(*WEIGHTS)], ...] = ()
    joint_variants: bool = True
    figures: tuple[str, ...] = ()
    resamples: Count = 2000
    jobs: Annotated[int, Within(0, 1000)] = 0

    def __post_init__(self) -> None:
        check_fields(self, "experiment.")


@dataclass(frozen=True)
class RunConfig(Config):
    """All settings of a configuration file: one run of `train.py` or of `torchcrf-scan experiment`.

    Attributes:
        experiment: settings of `torchcrf-scan experiment`; ignored by `train.py`.
    """

    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
