"""Training pairs from recordings that nobody annotated: where a stream's answers to four scans agree, they count as labels.

A stream sees more than a pair: what stands is met again, what moves goes on. A label is kept where the scans before and after
say the same, and its return is ignored elsewhere. The weight of a pair is the model's confidence in the labels that are kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from torchcrf_scan.baselines.cloud import Cloud
from torchcrf_scan.batch import range_noise_of
from torchcrf_scan.data.annotate import scan_gate
from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.recording import log_name
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.geometry import se2
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, ScanPair
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.stream.clock import Clock
from torchcrf_scan.stream.placement import explained_by, grid_at, place
from torchcrf_scan.stream.stream import ScanStream

SCANS = 4  # of a pair: one before the source, the source, the target, one after it
STANDS = 2  # of the three others must see a surface where a return stands
FEWEST = 3  # returns of a mover in the source and in the target
LEAST_EXPLAINED = 0.5  # share of a mover's returns that lie on its returns in another scan
LEAST_KNOWN = 0.5  # share of a pair's returns that are labelled
EARLY = 0.25  # share of the time between the scans of a pair by which it may be shorter


@dataclass(frozen=True, slots=True)
class Seen:
    """A scan of the stream. track: (N,) of its points, as in `ScanResult`. time: seconds by the stream's clock."""

    result: ScanResult
    grid: ScanGrid
    track: Ints
    time: float

    @property
    def points(self) -> Floats:
        """(N, 2) in the sensor's frame."""
        return self.grid.scan.points

    def motion_to(self, other: Seen) -> Floats:
        """(3,) of what stands, into the frame of another scan."""
        return se2.compose(se2.inverse(other.result.pose), self.result.pose)


def label_recordings(model: JointScanCRF, paths: Iterable[str | Path], most: int, seconds: float) -> list[ScanPair]:
    """Annotated pairs of recordings, evenly over each, with their weights.

    Args:
        model: of the stream.
        most: pairs of a recording.
        seconds: between the scans of a pair, at least about so many.

    Raises:
        TorchCRFScanError: a file that is no recording, or damaged.
    """
    pairs: list[ScanPair] = []
    for path in paths:
        name = log_name(Path(path))
        readings = tqdm(read_scans(path), unit="scan", desc=f"{name}, unlabelled", leave=False, disable=None)
        pairs += label_readings(model, readings, most, seconds, name)
    return weighted(model, pairs)


def label_readings(model: JointScanCRF, readings: Iterable[Reading], most: int, seconds: float, sequence: str) -> list[ScanPair]:
    """At most so many annotated pairs of a recording; memory is bounded whatever its length."""
    stream, clock = ScanStream(model), Clock(warns=False)
    seen: deque[Seen] = deque(maxlen=SCANS)
    found: list[ScanPair] = []
    stride = turn = 0
    for number, reading in enumerate(readings):
        clock.advance(reading.stamp)
        result = stream.feed(reading.scan, reading.stamp)
        if result.status != "ok":
            seen.clear()
        elif not seen or clock.elapsed - seen[-1].time >= (1 - EARLY) * seconds:
            track = result.track[result.scan.beam]
            seen.append(Seen(result, grid_at(result.scan, result.scan.points), track, clock.elapsed))
        else:
            continue
        if len(seen) < SCANS:
            continue
        turn += 1
        if turn % (1 << stride) == 0:
            pair = label(seen, sequence, f"{sequence}_{number:05d}")
            found += [pair] if pair is not None else []
        if len(found) > 2 * most:
            stride, found = stride + 1, found[1::2]
    kept = np.linspace(0, len(found) - 1, most).round().astype(int)
    return [found[k] for k in np.unique(kept)] if found else []


def weighted(model: JointScanCRF, pairs: Sequence[ScanPair]) -> list[ScanPair]:
    """The pairs, their weights the model's mean confidence in their clusters; 0 counts for what is not labelled."""
    weighed = []
    for pair, answer in zip(pairs, model.match_pairs(pairs) if pairs else [], strict=True):
        truth, beam = annotation_of(pair), pair.source.beam
        sure = np.where(truth.ignore[beam], 0.0, answer.cluster_confidence[beam])
        weighed.append(replace(pair, annotation=replace(truth, weight=float(sure.mean()))))
    return weighed


def label(seen: Sequence[Seen], sequence: str, name: str) -> ScanPair | None:
    """The annotated pair of the two scans in the middle of four; None if too little of it is sure."""
    before, source, target, after = seen
    dt = target.time - source.time
    pair = ScanPair(source.result.scan, target.result.scan, dt, None, sequence, name)
    gate = scan_gate(Cloud.of(target.result.scan).spacing, range_noise_of(pair))
    motions = [_background_motion(source, target)]
    votes = np.sum([explained_by(source.motion_to(other), source.grid, other.grid) for other in (before, target, after)], axis=0)
    body = np.where((source.track == BACKGROUND) & (votes >= STANDS), BACKGROUND, OUTLIER)
    known = (body == BACKGROUND) | ((source.track <= BACKGROUND) & (votes == 0))
    association = _nearest(source, target, body == BACKGROUND, target.track <= BACKGROUND, motions[0], gate)
    for mover in source.result.objects:
        mine = source.track == mover.number
        motion = _mover_motion(seen, mover)
        if motion is not None:
            body[mine], known[mine] = len(motions), True
            association = np.where(mine, _nearest(source, target, mine, target.track == mover.number, motion, gate), association)
            motions.append(motion)
    if known.mean() < LEAST_KNOWN:
        return None
    scan, there = source.result.scan, np.append(target.result.scan.beam, OUTLIER)
    annotation = Annotation(
        association=scan.to_beams(there[association], OUTLIER),
        cluster=scan.to_beams(np.where(association == OUTLIER, OUTLIER, body), OUTLIER),
        motions=np.stack(motions),
        body=scan.to_beams(body, OUTLIER),
        ignore=scan.to_beams(~known, True),
    )
    return replace(pair, annotation=annotation)


def _background_motion(source: Seen, target: Seen) -> Floats:
    """(3,) of what stands in both, from the stream's poses, refined."""
    here, there = (of.points[of.track == BACKGROUND] for of in (source, target))
    guess = source.motion_to(target)
    if min(len(here), len(there)) < FEWEST:
        return guess
    return place(grid_at(source.result.scan, here), grid_at(target.result.scan, there), guess).motion


def _mover_motion(seen: Sequence[Seen], mover: MovingObject) -> Floats | None:
    """(3,) of an object from the source to the target; None unless it goes on alike in three scans."""
    _, source, target, _ = seen
    motion = _motion_between(source, target, mover)
    if motion is None:
        return None
    centre = source.points[source.track == mover.number].mean(0)
    going = _over_ground(source, target, motion, centre)
    for other in (seen[0], seen[3]):
        again = _motion_between(source, other, mover)
        if again is not None:
            so_far = _over_ground(source, other, again, centre) * (target.time - source.time) / (other.time - source.time)
            if np.hypot(*(going - so_far)) <= 0.5 * max(np.hypot(*going), np.hypot(*so_far)):
                return motion
    return None


def _motion_between(source: Seen, other: Seen, mover: MovingObject) -> Floats | None:
    """(3,) of an object into another scan; None if it is not seen there, or where it does not explain it."""
    here, there = (of.points[of.track == mover.number] for of in (source, other))
    if min(len(here), len(there)) < FEWEST:
        return None
    shift = np.append(0.0, mover.velocity * (other.time - source.time))
    guess = se2.compose(se2.inverse(other.result.pose), se2.compose(shift, source.result.pose))
    found = place(grid_at(source.result.scan, here), grid_at(other.result.scan, there), guess)
    return found.motion if found.share >= LEAST_EXPLAINED else None


def _over_ground(source: Seen, other: Seen, motion: Floats, point: Floats) -> Floats:
    """(2,) metres that a point goes in the world under a motion (3,) into another scan."""
    return se2.apply(other.result.pose, se2.apply(motion, point[None]))[0] - se2.apply(source.result.pose, point[None])[0]


def _nearest(source: Seen, target: Seen, mine: Bools, others: Bools, motion: Floats, gate: float) -> Ints:
    """(N,) the nearest of some target points to those of a body under its motion, within the gate; -1 none, or not its point."""
    found = np.full(len(mine), OUTLIER)
    index = np.flatnonzero(others)
    if len(index) and mine.any():
        distance, nearest = cKDTree(target.points[index]).query(se2.apply(motion, source.points[mine]))
        found[mine] = np.where(distance <= gate, index[nearest], OUTLIER)
    return found
