"""The measures that readers of other fields know: scene flow, moving points by speed, panoptic quality, errors by range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from torchcrf_scan.evaluation.calibration import Rightness, rightness
from torchcrf_scan.evaluation.measures import mean
from torchcrf_scan.evaluation.panoptic import PanopticCount, panoptic_quality
from torchcrf_scan.evaluation.report import Column
from torchcrf_scan.evaluation.scene_flow import FlowErrors, bucket_normalised, end_point_errors, moving_shares
from torchcrf_scan.evaluation.table import Cell, Table
from torchcrf_scan.scan import Bools, Floats, PairPrediction, ScanPair

RANGES = (0.0, 5.0, 10.0, 20.0, 40.0, math.inf)  # metres
FLOW: tuple[Column, ...] = (
    ("EPE three-way (cm)", "epe_threeway", 2),
    ("moving objects (cm)", "epe_moving", 2),
    ("standing objects (cm)", "epe_standing", 2),
    ("background (cm)", "epe_background", 2),
    ("accuracy strict (%)", "accuracy_strict", 1),
    ("relaxed (%)", "accuracy_relaxed", 1),
    ("strict, moving (%)", "accuracy_strict_moving", 1),
    ("relaxed, moving (%)", "accuracy_relaxed_moving", 1),
    ("bucket-normalised, dynamic", "bucket_dynamic", 3),
)
MOVING: tuple[Column, ...] = (
    ("IoU (%)", "speed_iou", 1),
    ("precision (%)", "speed_precision", 1),
    ("recall (%)", "speed_recall", 1),
    ("F1 (%)", "speed_f1", 1),
    ("panoptic quality (%)", "pq", 1),
    ("segmentation quality (%)", "sq", 1),
    ("recognition quality (%)", "rq", 1),
)
FLOW_NOTE = (
    "End-point errors of the points' flow, the sensor's motion being answered too; three-way: the mean over the kinds that have "
    "points. Strict: within 5 cm or 5 %, relaxed: 10. Bucket-normalised: error over way, by speed."
)
MOVING_NOTE = "Moving: at 0.5 m/s or more over the ground, by the flow. Panoptic quality of the movers, by the labels."


@dataclass(frozen=True, slots=True)
class NeighbourScore:
    """The counts of one pair.

    Attributes:
        flow: of the points of known flow. panoptic: of the movers.
        range: (P,) metres of the annotated points; wrong_association, wrong_cluster: (P,) whether their labels are wrong.
        sequence: of the pair.
    """

    flow: FlowErrors
    panoptic: PanopticCount
    range: Floats
    wrong_association: Bools
    wrong_cluster: Bools
    sequence: str = ""

    @classmethod
    def of(cls, pair: ScanPair, prediction: PairPrediction) -> NeighbourScore:
        """The counts of an annotated pair; raises TorchCRFScanError for a pair without annotation."""
        right: Rightness = rightness(pair, prediction)
        known = right.known
        flow, panoptic = FlowErrors.of(pair, prediction), PanopticCount.of(pair, prediction)
        return cls(flow, panoptic, pair.source.ranges[known], ~right.within[known], ~right.cluster[known], pair.sequence)


def summarise_neighbours(scores: Sequence[NeighbourScore]) -> dict[str, float]:
    """All measures over some pairs, pooled: the keys of `scene_flow` and `panoptic`; NaN where there is nothing to measure."""
    flow = FlowErrors.pool([score.flow for score in scores])
    quality = panoptic_quality([score.panoptic for score in scores])
    return {**end_point_errors(flow), **bucket_normalised(flow), **moving_shares(flow), **quality}


def neighbour_tables(rows: Mapping[str, Sequence[NeighbourScore]]) -> list[Table]:
    """Tables of scene flow and of moving points for `{row: its scores}`, and errors by range of the last row."""
    summaries = {name: summarise_neighbours(scores) for name, scores in rows.items()}
    flow = {name: {**of, **{key: 100 * of[key] for key in of if key.startswith("epe_")}} for name, of in summaries.items()}
    tables = [_table("Scene flow", FLOW, flow, FLOW_NOTE), _table("Moving points and movers", MOVING, summaries, MOVING_NOTE)]
    return [*tables, *(range_table(scores) for scores in list(rows.values())[-1:])]


def range_table(scores: Sequence[NeighbourScore]) -> Table:
    """Errors by range: one row for every interval of `RANGES`."""
    found = errors_by_range(scores)
    rows: list[tuple[Cell, ...]] = [(name, *of.values()) for name, of in found.items()]
    columns = (
        "range",
        "points",
        "association wrong (%)",
        "cluster wrong (%)",
        "EPE (cm)",
        "EPE of moving (cm)",
        "moving found (%)",
    )
    return Table(
        "Errors by range", columns, tuple(rows), (0, 0, 1, 1, 1, 1, 1), "An association is wrong beyond +-2. Moving as above."
    )


def errors_by_range(scores: Sequence[NeighbourScore]) -> dict[str, dict[str, float]]:
    """For every interval of `RANGES`: annotated `points`, wrong labels in percent, end-point errors in cm, moving points found."""
    flow = FlowErrors.pool([score.flow for score in scores])
    names = ("range", "wrong_association", "wrong_cluster")
    away, association, cluster = (np.concatenate([np.zeros(0), *(getattr(of, name) for of in scores)]) for name in names)
    found = {}
    for low, high in pairwise(RANGES):
        own, flown = (away >= low) & (away < high), (flow.range >= low) & (flow.range < high)
        moving = flown & flow.is_moving
        found[f"{low:.0f} to {high:.0f} m" if high < math.inf else f"from {low:.0f} m"] = {
            "points": float(own.sum()),
            "association_wrong": 100 * mean(association[own]),
            "cluster_wrong": 100 * mean(cluster[own]),
            "epe_cm": 100 * mean(flow.error[flown]),
            "epe_moving_cm": 100 * mean(flow.error[moving]),
            "moving_found": 100 * mean(flow.is_found_moving[moving]),
        }
    return found


def _table(title: str, columns: Sequence[Column], summaries: Mapping[str, Mapping[str, float]], note: str) -> Table:
    rows: list[tuple[Cell, ...]] = [(name, *(of[key] for _, key, _ in columns)) for name, of in summaries.items()]
    return Table(
        title, ("method", *(heading for heading, _, _ in columns)), tuple(rows), (0, *(digits for *_, digits in columns)), note
    )
