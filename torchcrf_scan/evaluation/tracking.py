"""Scores of objects over time: HOTA, MOTA, id switches and IDF1, by the library trackeval (extra `tracking`).

Sources: Luiten et al., HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking, IJCV 2021; Bernardin and Stiefelhagen,
Evaluating Multiple Object Tracking Performance, 2008; Ristani et al., Performance Measures and a Data Set for Multi-Target,
Multi-Camera Tracking, 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.metrics import MOVER_MIN_POINTS
from torchcrf_scan.scan import BACKGROUND, Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class TrackFrame:
    """The G true and the E estimated objects of one scan.

    Attributes:
        true: (G,) numbers. found: (E,) numbers. None twice.
        similarity: (G, E) in [0, 1]; what is at least 0.5 may count as found.
    """

    true: Ints
    found: Ints
    similarity: Floats


def frame_of_points(body: Ints, track: Ints, least: int = MOVER_MIN_POINTS) -> TrackFrame:
    """Objects are similar by the overlap (IoU) of their points.

    True objects of fewer than `least` points are not asked for; estimated ones that have most of their points there are not
    counted, nor are those without points, which are predicted.

    Args:
        body: (N,) number of the true object of each point, 0 background, -1 unknown. track: (N,) estimated numbers likewise.
    """
    true, points = np.unique(body[body > BACKGROUND], return_counts=True)
    found = np.unique(track[track > BACKGROUND])
    is_true, is_found = body == true[:, None], track == found[:, None]  # (G, N), (E, N)
    both = is_true.astype(np.float64) @ is_found.T  # (G, E)
    size = is_found.sum(1)
    similarity = both / np.maximum(points[:, None] + size - both, 1)
    is_small = points < least
    spared = 2 * both[is_small].sum(0) > size
    return TrackFrame(true[~is_small], found[~spared], similarity[~is_small][:, ~spared])


def frame_of_positions(
    true: Ints, true_positions: Floats, asked: Bools, found: Ints, positions: Floats, reach: float
) -> TrackFrame:
    """Objects are similar by distance: 1 at the same place, 0.5 at half of `reach`, 0 from there on.

    True objects that are not asked for, such as hidden ones, need not be found; an estimated one that is nearest to such an
    object, and no farther than half of `reach`, is not counted.

    Args:
        true: (G,) numbers. true_positions: (G, 2) metres. asked: (G,) bool.
        found: (E,) numbers. positions: (E, 2). reach: metres.
    """
    offset = true_positions.reshape(-1, 1, 2) - positions.reshape(1, -1, 2)
    similarity = np.maximum(1 - np.hypot(offset[..., 0], offset[..., 1]) / reach, 0.0)  # (G, E)
    best = similarity[asked].max(0, initial=0.0)
    spared = similarity[~asked].max(0, initial=0.0) > np.maximum(best, 0.5)
    return TrackFrame(true[asked], found[~spared], similarity[asked][:, ~spared])


def track_scores(sequences: Sequence[Sequence[TrackFrame]]) -> dict[str, float]:
    """Scores over all scans of some sequences; percent and counts.

    - `hota`, and its parts of detection `deta` and association `assa`: means over the thresholds 0.05 to 0.95 of the similarity.
    - `mota`, `idf1`, `recall`, `precision`: percent, of objects with a similarity of at least 0.5.
    - `id_switches`: how often an object got another number.
    - `objects`, `tracks`: true and estimated ones; `sightings`: of the true ones, by scan.

    Raises:
        TorchCRFScanError: no sequences.
        ImportError: trackeval is not installed.
    """
    from trackeval.metrics import CLEAR, HOTA, Identity

    if not sequences:
        raise TorchCRFScanError("sequences: expected at least one, got none")
    data = [_as_trackeval(frames) for frames in sequences]
    silent = {"PRINT_CONFIG": False}
    found: dict[str, Any] = {}
    for metric in (HOTA(), CLEAR(silent), Identity(silent)):
        found |= metric.combine_sequences({str(i): metric.eval_sequence(of) for i, of in enumerate(data)})
    means = {name: 100 * float(np.mean(found[key])) for name, key in (("hota", "HOTA"), ("deta", "DetA"), ("assa", "AssA"))}
    shares = (("mota", "MOTA"), ("idf1", "IDF1"), ("recall", "CLR_Re"), ("precision", "CLR_Pr"))
    return {
        **means,
        **{name: 100 * float(found[key]) for name, key in shares},
        "id_switches": float(found["IDSW"]),
        "objects": float(sum(of["num_gt_ids"] for of in data)),
        "tracks": float(sum(of["num_tracker_ids"] for of in data)),
        "sightings": float(sum(of["num_gt_dets"] for of in data)),
    }


def _as_trackeval(frames: Sequence[TrackFrame]) -> dict[str, Any]:
    """A sequence in the form that trackeval takes: numbers from 0 without gaps."""
    true, found = ([getattr(of, name) for of in frames] for name in ("true", "found"))
    place = [{int(number): i for i, number in enumerate(np.unique(np.concatenate([*of, []])))} for of in (true, found)]
    gt_ids, tracker_ids = (
        [np.array([places[int(number)] for number in row], dtype=np.int64) for row in rows]
        for places, rows in zip(place, (true, found), strict=True)
    )
    return {
        "gt_ids": gt_ids,
        "tracker_ids": tracker_ids,
        "similarity_scores": [of.similarity for of in frames],
        "num_timesteps": len(frames),
        "num_gt_ids": len(place[0]),
        "num_tracker_ids": len(place[1]),
        "num_gt_dets": sum(map(len, gt_ids)),
        "num_tracker_dets": sum(map(len, tracker_ids)),
    }
