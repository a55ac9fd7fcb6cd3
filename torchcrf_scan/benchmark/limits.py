"""The limit: minimum operations and bytes of a whole pair, and the time that this machine would take for them.

Additions, products, comparisons, look-ups, roots, quotients and trigonometric functions all count as one operation, at the rate
of a matrix product, which no program reaches. Bytes are those of the tables written and read, as if they went to memory and
came back. Nearest points are found through boxes round runs of neighbours, not by N M distances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from torchcrf_scan.benchmark.timing import least_seconds, threads_kept
from torchcrf_scan.features.shape import ORDERS
from torchcrf_scan.inference.joint import SELECTION_ROUNDS
from torchcrf_scan.names import ASSOCIATION_UNARY, CLUSTERING_UNARY, LOCAL_CHANNELS, SHAPE_CHANNELS
from torchcrf_scan.search import cold, hypotheses, pool

COPIED = 2**23  # numbers in a copy, far more than any cache holds
MATRIX = 512
VECTOR = 4096  # numbers that fit the first-level cache
REPEATS = 15
NUMBER = 8  # bytes of a double
RUN = 8  # points in a box, and boxes in a large box
BOX, POINT = 6, 5  # operations of the distance to a box, and to a point
MOVE, STEP = 8, 40  # operations to move a point, and of a point in a Gauss-Newton step
LOOK = 30  # of the free-space test of a point
SQUARE = 4  # of a robust square
GRID = 40  # starts of the background's search
GROUPS = 30  # segments in a street that may be movers


@dataclass(frozen=True, slots=True)
class Rates:
    """Rates of one thread: bytes a second to and from memory; double-precision operations a second in matrices and in vectors."""

    bandwidth: float
    matrix: float
    vector: float


@dataclass(frozen=True, slots=True)
class Size:
    """Problem size of the counts.

    Attributes:
        points: N of either scan. candidates: K. clusters: D, of which `motions` exist. rounds: of inference. stumps: of a booster.
        is_warm: the background is registered from a prior motion instead of searched for.
    """

    points: int = 361
    candidates: int = 8
    clusters: int = 8
    motions: float = 4.0
    rounds: float = 4.0
    stumps: int = 50
    is_warm: bool = False


@dataclass(frozen=True, slots=True)
class Work:
    """Operations and bytes of one pair."""

    operations: float
    bytes: float

    def __add__(self, other: Work) -> Work:
        return Work(self.operations + other.operations, self.bytes + other.bytes)

    def times(self, factor: float) -> Work:
        """The work multiplied by a factor."""
        return Work(factor * self.operations, factor * self.bytes)

    def milliseconds(self, rates: Rates) -> float:
        """At the limit of one thread: bytes at the memory's bandwidth or operations at the rate of a matrix product."""
        return 1e3 * max(self.bytes / rates.bandwidth, self.operations / rates.matrix)


def nearest(points: int) -> float:
    """Operations to find the nearest of N points: all large boxes, the small ones of two of them, the points of two of those."""
    return BOX * math.ceil(points / RUN**2) + 2 * RUN * BOX + 2 * RUN * POINT


def count_work(size: Size) -> Work:
    """The work of one whole pair: the start, the rounds, the read-out."""
    a_round = _candidates(size) + _cluster_scores(size) + _boosted_scores(size) + _pairwise_tables(size) + _messages(size)
    once = _initialisation(size) + _descriptors(size) + _candidates(size) + _read_out(size)
    selection = _mover_selection(size).times(min(size.rounds, SELECTION_ROUNDS))
    return once + selection + (a_round + _motion_update(size).times(2)).times(size.rounds)


def _descriptors(size: Size) -> Work:
    """Two scans; at each neighbour order two lengths, two geodesics and an angle."""
    per_point = len(ORDERS) * 2 * (6 + 2) + len(ORDERS) * 10
    return Work(2.0 * size.points * per_point, 2.0 * size.points * (2 + SHAPE_CHANNELS * 2) * NUMBER)


def _candidates(size: Size) -> Work:
    """Every motion moves every point, finds its nearest target and sorts the K around it."""
    per_point = size.motions * (MOVE + nearest(size.points) + 2 * size.candidates * POINT)
    return Work(size.points * per_point, size.points * (2 + size.candidates + size.motions) * NUMBER)


def _cluster_scores(size: Size) -> Work:
    """Residual, two free-space tests and the features' weighted sum, for every motion of every point."""
    per_state = 2 * MOVE + POINT + 2 * LOOK + SQUARE + 2 * CLUSTERING_UNARY
    return Work(size.points * size.motions * per_state, size.points * size.clusters * (CLUSTERING_UNARY + 1) * NUMBER)


def _boosted_scores(size: Size) -> Work:
    """N K local channels (a length channel has two errors), the data booster's look-ups, the outlier booster, the weighted sum."""
    search = math.ceil(math.log2(max(size.stumps, 2)))
    channels = 2 * len(LOCAL_CHANNELS) * SQUARE
    boosting = len(LOCAL_CHANNELS) * (search + 2)
    per_state = channels + boosting + 2 * ASSOCIATION_UNARY
    outlier = size.candidates * len(LOCAL_CHANNELS) + (len(LOCAL_CHANNELS) + 2) * (search + 2)
    per_point = size.candidates * per_state + outlier + MOVE + LOOK
    descriptors = 2 * SHAPE_CHANNELS * 2  # of the point and, once, of a target point
    return Work(size.points * per_point, size.points * (descriptors + size.candidates + 1) * NUMBER)


def _pairwise_tables(size: Size) -> Work:
    """Two chains: (K + 1)^2 pairs of candidates with 4 features, and those of clusters."""
    association = (size.candidates + 1) ** 2
    return Work(size.points * association * 10.0, float(size.points * association * NUMBER)) + _cluster_edges(size)


def _cluster_edges(size: Size) -> Work:
    """D^2 pairs of clusters on every edge, with a distance and 8 features."""
    pairs = size.points * size.clusters**2
    return Work(pairs * (POINT + SQUARE + 16.0), float(pairs * NUMBER))


def _mover_selection(size: Size) -> Work:
    """The clustering chain's tables once, and its total with and without every motion: a product and a sum a pair of states."""
    tables = _candidates(size) + _cluster_scores(size) + _cluster_edges(size)
    pairs = size.points * size.clusters**2
    return tables + Work(size.motions * 2.0 * pairs, size.motions * pairs * NUMBER)


def chain_work(points: int, states: int) -> Work:
    """Max-marginals of one chain: in both directions an addition and a comparison for every pair of states of every edge."""
    operations = 2 * 2 * points * states**2 + 3 * points * states
    return Work(float(operations), float(points * (2 * states**2 + 2 * states) * NUMBER))


def _messages(size: Size) -> Work:
    return chain_work(size.points, size.candidates + 1) + chain_work(size.points, size.clusters)


def _motion_update(size: Size) -> Work:
    """The contribution of every point to the step of its own cluster."""
    return Work(size.points * (MOVE + STEP + 10.0), size.points * 8.0 * NUMBER)


def _read_out(size: Size) -> Work:
    """Covariances from every point's information, confidences from the beliefs of both chains."""
    per_point = STEP + 20 + 3 * (size.candidates + size.clusters)
    return Work(float(size.points * per_point), float(size.points * (size.candidates + size.clusters + 10) * NUMBER))


def _initialisation(size: Size) -> Work:
    """InitialiseRT: the background, registered from the prior or searched for, and the movers' hypotheses."""
    n = size.points
    settled = hypotheses.STARTS * hypotheses.REGISTER_POINTS * 6 * _pull(n)
    screened = 3 * GROUPS * hypotheses.SCREEN_POINTS * (MOVE + nearest(n))
    judged = hypotheses.STARTS * 2 * hypotheses.REGISTER_POINTS * _charge(n)
    movers = Work(float(GROUPS * (settled + screened + judged)), 20.0 * n * NUMBER)
    led = Work(4 * n * _pull(n) + 6 * 2 * n * _pull(n) + 2 * n * _charge(n), 10.0 * n * NUMBER)
    return movers + (led if size.is_warm else _search(n))


def _pull(points: int) -> float:
    """Operations per point in one iteration of a registration."""
    return MOVE + nearest(points) + STEP


def _charge(points: int) -> float:
    """Operations per point to compare motions."""
    return MOVE + nearest(points) + LOOK + 15


def _search(n: int) -> Work:
    """The search for the background as the reference does it: shape matching and RANSAC, and the pool of registrations."""
    some, pull, charge = min(n, pool.COARSE_POINTS), _pull(n), _charge(n)
    shapes = Work(float(n * n * (2 * SHAPE_CHANNELS * SQUARE + 1)), float(n * n * NUMBER))
    ransac = Work(cold.SAMPLES * n * (MOVE + POINT), 4.0 * n * NUMBER)
    slid = 2 * pool.SLIDES * (pool.COARSE + 1)
    segments = min(12, GROUPS) * 3
    hypotheses_in_all = 2 * pool.COARSE + pool.SLID + segments
    search = GRID * some * 8 * pull + (GRID + slid) * 2 * some * charge
    search += segments * pool.SEGMENT_POINTS * 4 * pull + hypotheses_in_all * 2 * n * charge
    search += pool.KEPT * (4 * n * pull + 2 * n * charge) + pool.REFINED * (6 * 2 * n * pull + 2 * n * charge)
    return shapes + chain_work(n, cold.CANDIDATES + 1) + ransac + Work(float(search), 20.0 * n * NUMBER)


def measure_rates() -> Rates:
    """A large copy, a matrix product (multiply-adds count twice), and a product and a sum of short vectors."""
    with threads_kept():
        torch.set_num_threads(1)
        here, there = np.ones(COPIED), np.zeros(COPIED)
        copy = least_seconds(lambda: np.copyto(there, here), REPEATS)
        square = torch.ones(MATRIX, MATRIX, dtype=torch.float64)
        matrix = least_seconds(lambda: square @ square, REPEATS)
        a, b = np.ones(VECTOR), np.ones(VECTOR)

        def multiply_add() -> None:
            for _ in range(100):
                np.multiply(a, 0.5, out=b)
                np.add(a, b, out=b)

        vector = least_seconds(multiply_add, REPEATS)
    return Rates(2 * here.nbytes / copy, 2 * MATRIX**3 / matrix, 200 * VECTOR / vector)
