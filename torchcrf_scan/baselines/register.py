"""Register of the methods compared with the joint model, in the order of the tables' rows: one line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from torchcrf_scan.baselines.cascade import Cascade
from torchcrf_scan.baselines.start import label_nearest
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import load
from torchcrf_scan.inference.start import Start
from torchcrf_scan.scan import PairPrediction, ScanPair


@dataclass(frozen=True, slots=True)
class Case:
    """A pair with the results that methods may build on.

    Attributes:
        pair: without annotation. batch: the pair alone, as tensors. start: of InitialiseRT.
        cascade: the chains alone, fitted. icp_gate: metres, chosen on training pairs.
        answers: of earlier rows, by row.
    """

    pair: ScanPair
    batch: ScanPairBatch
    start: Start
    cascade: Cascade
    icp_gate: float
    answers: dict[str, PairPrediction] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Baseline:
    """A method.

    Attributes:
        match: predicts a case.
        of_pair: the same from the pair alone; None: it needs more. command: its name in `torchcrf-scan evaluate --method`.
        after: row whose result it builds on. from_start: it builds on the start. The time of either is included in its own.
        requires: optional module that it needs; empty: none.
    """

    match: Callable[[Case], PairPrediction]
    of_pair: Callable[[ScanPair], PairPrediction] | None = None
    command: str = ""
    after: str = ""
    from_start: bool = False
    requires: str = ""


def call(function: str, *arguments: Any, **settings: Any) -> PairPrediction:
    """Calls `module:name` of `baselines`, imported on demand: most need scipy or more."""
    found: PairPrediction = load(f"baselines.{function}")(*arguments, **settings)
    return found


def alone(function: str, command: str = "", requires: str = "") -> Baseline:
    """A method that needs the pair alone."""
    return Baseline(lambda case: call(function, case.pair), lambda pair: call(function, pair), command, requires=requires)


def k_means(after: str, *, remove_motion: bool = False) -> Baseline:
    """K-Means on the displacements of another row."""
    function = "kmeans:cluster_displacements"
    return Baseline(lambda case: call(function, case.pair, case.answers[after], remove_motion=remove_motion), after=after)


BASELINES: Mapping[str, Baseline] = {
    "all background": alone("icp:match_background", "background"),
    "ICP": alone("icp:match_icp", "icp"),
    "ICP, tuned": Baseline(lambda case: call("icp:match_icp", case.pair, gate=case.icp_gate)),
    "small_gicp (ICP)": alone("libraries:match_small_gicp", requires="small_gicp"),
    "Open3D (ICP)": alone("libraries:match_open3d", requires="open3d"),
    "trimmed ICP + RANSAC": alone("ransac:match_ransac", "ransac"),
    "K-Means (ICP)": k_means("ICP, tuned"),
    "K-Means (ICP), ego removed": k_means("ICP, tuned", remove_motion=True),
    "CRF-Matching": Baseline(
        lambda case: case.cascade.matching(case.batch, case.start.background_alone()).pair(0, case.pair), from_start=True
    ),
    "CRF-Matching, own start": Baseline(
        lambda case: case.cascade.match_from_own_start(case.batch, case.start).pair(0, case.pair), from_start=True
    ),
    "K-Means (CRF-Matching)": k_means("CRF-Matching"),
    "K-Means (CRF-Matching), ego removed": k_means("CRF-Matching", remove_motion=True),
    "CRF-Clustering": Baseline(lambda case: case.cascade(case.batch, case.start).pair(0, case.pair), from_start=True),
    "start + gated NN": Baseline(lambda case: label_nearest(case.batch, case.start).pair(0, case.pair), from_start=True),
}


def can_import(module: str) -> bool:
    """Whether a library is installed."""
    try:
        import_module(module)
    except ImportError:
        return False
    return True


def installed() -> dict[str, Baseline]:
    """The methods whose libraries are installed."""
    return {row: baseline for row, baseline in BASELINES.items() if not baseline.requires or can_import(baseline.requires)}


def by_command() -> dict[str, Callable[[ScanPair], PairPrediction]]:
    """The methods of a pair alone, by their name on the command line."""
    return {of.command: of.of_pair for of in BASELINES.values() if of.command and of.of_pair is not None}
