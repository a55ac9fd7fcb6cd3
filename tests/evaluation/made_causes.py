"""A street by hand, in which every cause of a wrong point can be made: a wall, two movers, points without counterpart."""

from dataclasses import dataclass, replace

import numpy as np

from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair

WALL, CAR, BIKE, GONE = slice(0, 41), slice(41, 49), slice(49, 55), slice(55, 60)  # of the source's beams
MOTIONS = np.array([[0.0, 0.1, 0.0], [0.0, 0.7, 0.0], [0.0, -0.6, 0.0]])  # background, car, bike
BODY = np.concatenate([np.zeros(41, np.int64), np.ones(8, np.int64), np.full(6, 2), np.full(5, -1)])
UNITS = np.full(60, 0.1)


@dataclass(frozen=True)
class Street:
    """The pair, the answer that is right everywhere, and the trace of a search that considered and kept both movers."""

    pair: ScanPair
    answer: PairPrediction
    trace: SearchTrace


def make_street() -> Street:
    """The wall stands at x = 10 m, the car at its left, the bike at its right, five points behind are gone afterwards."""
    wall = np.stack([np.full(41, 10.0), np.linspace(-10, 10, 41)], axis=1)
    car = np.stack([np.full(8, 2.0), np.linspace(5, 6.75, 8)], axis=1)
    bike = np.stack([np.full(6, 3.0), np.linspace(-9.25, -8, 6)], axis=1)
    gone = np.stack([np.full(5, -4.0), np.linspace(4, 6, 5)], axis=1)
    source = np.concatenate([wall, car, bike, gone])
    target = np.concatenate([se2.apply(MOTIONS[k], points) for k, points in enumerate((wall, car, bike))])
    association = np.append(np.arange(55), np.full(5, -1))
    cluster = np.where(association >= 0, BODY, -1)
    truth = Annotation(association, cluster, MOTIONS, BODY, np.zeros(60, bool))
    pair = ScanPair(scan_of(source), scan_of(target), dt=0.11, annotation=truth, sequence="street", name="by hand")
    ones = np.ones(60)
    return Street(pair, PairPrediction(association.copy(), cluster.copy(), MOTIONS.copy(), ones, ones, True), trace_of(pair))


def scan_of(points: np.ndarray) -> Scan:
    return Scan.from_ranges(np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0]))


def trace_of(pair: ScanPair) -> SearchTrace:
    """A pool of the right motion of each mover and one wrong motion of the wall."""
    motions = np.array([MOTIONS[1], MOTIONS[2], [0.0, 3.0, 1.0]])
    members = np.stack([BODY[pair.source.beam] == k for k in (1, 2, 0)])
    every = np.ones(3, bool)
    return SearchTrace(MOTIONS[0], motions, members, every, np.array([0, 1]), np.ones(2, bool), UNITS)


def labelled(answer: PairPrediction, beams: slice | np.ndarray, cluster: int | None = None, association: int | None = None):
    """The answer with other labels of some beams; association: by how many beams it is shifted, None: not at all."""
    association_of, cluster_of = answer.association.copy(), answer.cluster.copy()
    if cluster is not None:
        cluster_of[beams] = cluster
    if association is not None:
        association_of[beams] += association
    return replace(answer, association=association_of, cluster=cluster_of)
