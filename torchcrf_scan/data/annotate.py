"""Annotation of simulated scans from the true motions of the sensor and of every body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from torchcrf_scan.data.laser import NO_BODY
from torchcrf_scan.data.world import Mover
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Annotation, Floats, Ints, Scan

STATIC = 0  # bodies in a scan: the static world, movers by number, and returns of no single body (`NO_BODY`)
UNSEEN = -2  # a body of the target that is not visible in the source
UNKNOWN = -3  # a body that is left out of the annotation

GATE = 3.2  # times half the scan's usual spacing plus twice its noise; annotators of recordings use one gate for a whole scan
LEAST_MOTION = 0.02  # metres at full size; bodies that move less within a pair are static


@dataclass(frozen=True, slots=True)
class Capture:
    """One scan with the state of the simulation.

    Attributes:
        scan: the valid returns, n of them.
        body: (n,) their bodies: `STATIC`, a mover's number, or `NO_BODY`.
        spacing: (n,) metres between neighbouring returns on the surface there.
        settled: (n, 2) their places in the sensor's frame had all beams been cast at `time`.
        time: seconds, of the middle of the sweep.
        ego: (3,) the sensor's pose in the world, at full size.
        movers: those in the world at this time, visible or not.
    """

    scan: Scan
    body: Ints
    spacing: Floats
    settled: Floats
    time: float
    ego: Floats
    movers: tuple[Mover, ...]


def association_gate(spacing: Floats, config: SimulatorConfig) -> float:
    """Maximum distance of a moved return to its counterpart, metres; spacing: (M,) of the target scan, not empty."""
    noise = float(np.hypot(config.range_noise, config.vibration))
    return scan_gate(spacing, noise)


def scan_gate(spacing: Floats, noise: float) -> float:
    """Metres up to which a moved return has a counterpart in a scan, as annotations have it; spacing: (M,), not empty."""
    return GATE * (float(np.median(spacing)) / 2 + 2 * noise)


def _associate(moved: Floats, seen: Floats, body: Ints, target: Capture, target_body: Ints, config: SimulatorConfig) -> Ints:
    """(N,) the target return of the same body that was seen nearest, of those truly within the gate, or -1. O(N M).

    Args:
        moved, seen: (N, 2) the moved source returns, where they were had the sweep taken no time, and as they were measured.
    """
    association = np.full(len(moved), OUTLIER)
    if not len(moved) or not len(target_body):
        return association
    is_near = cdist(moved, target.settled) <= association_gate(target.spacing, config)
    distance = np.where((body[:, None] == target_body) & is_near, cdist(seen, target.scan.points), np.inf)
    nearest = distance.argmin(1)
    found = np.isfinite(distance[np.arange(len(moved)), nearest])
    association[found] = nearest[found]
    return association


def annotate(source: Capture, target: Capture, config: SimulatorConfig) -> Annotation:
    """Ground truth of every source return, from the true motions of the sensor and of every body."""
    table, label = _bodies(source, target, config)
    body = np.array([label[b] for b in source.body], dtype=np.int64)
    target_body = np.array([label.get(b, UNSEEN) for b in target.body], dtype=np.int64)
    motion = table[np.maximum(body, 0)]
    moved, seen = (se2.rotate(motion[:, 0], points) + motion[:, 1:] for points in (source.settled, source.scan.points))
    partner = np.where(body < 0, OUTLIER, _associate(moved, seen, body, target, target_body, config))
    ignore = body == UNKNOWN
    body = np.where((body < 0) | ((source.body == NO_BODY) & (partner == OUTLIER)), NO_BODY, body)
    return Annotation(partner, np.where(partner == OUTLIER, OUTLIER, body), table, body, ignore)


def _bodies(source: Capture, target: Capture, config: SimulatorConfig) -> tuple[Floats, dict[int, int]]:
    """(K + 1, 3) motions of the background and of the annotated movers, and the label of every body of the source."""
    scale = np.array([1.0, config.scale, config.scale])
    motions = [se2.compose(se2.inverse(target.ego), source.ego) * scale]
    label = {STATIC: 0, NO_BODY: 0 if config.matches_mixed else NO_BODY}
    least = config.least_travel * (association_gate(target.spacing, config) if config.least_travel and len(target.spacing) else 0.0)
    for mover in source.movers:
        before, after = mover.pose(source.time), mover.pose(target.time)
        if np.hypot(*(after - before)[1:]) < LEAST_MOTION and abs(se2.wrap(after[0] - before[0])) < LEAST_MOTION:
            label[mover.number] = 0
            continue
        points = source.settled[source.body == mover.number]
        to_world = se2.compose(after, se2.inverse(before))
        motion = se2.compose(se2.inverse(target.ego), se2.compose(to_world, source.ego)) * scale
        travel = np.hypot(*(se2.apply(motion, points) - se2.apply(motions[0], points)).T)
        if len(points) and travel.max() < least:
            label[mover.number] = UNKNOWN
        elif len(points):
            label[mover.number] = len(motions)
            motions.append(motion)
    return np.stack(motions), label
