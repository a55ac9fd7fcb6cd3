"""Search for the background's motion without a usable guess: a pool of hypotheses, narrowed down in stages.

Every stage takes a range of hypotheses and holds no lock while it runs: threads may share the hypotheses of a stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from torchcrf_scan.loops.jit import Array, Integers, entry
from torchcrf_scan.loops.median import lower_median
from torchcrf_scan.loops.rigid import compose, wrap
from torchcrf_scan.search.background import background_cost, every, polish, refine, stride_of, unit_length
from torchcrf_scan.search.cold import shape_motions
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.registration import register
from torchcrf_scan.search.surface import Surface, surface_of

SEARCHED = 3000  # points of a scan at most: more tell nothing new of where it was taken
RANSAC_STARTS = 4
RANSAC_GATE = 3.0  # units of registration error

COARSE_POINTS = 120
SEGMENT_POINTS = 24
COARSE = 6  # number of hypotheses kept of the coarse search; the segments are registered from the best three
SLIDES = 10  # steps each way along the walls, for all of them
SLIDE_STEP = 4.0  # units
SLID = 6  # number kept of these
KEPT = 12  # number of all hypotheses that are polished,
REFINED = 5  # and of polished ones that are refined
GRID_REACH = 0.12  # of the usual range: the unit of the grid's shifts
GRID_SHIFTS = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (2.5, 0.0), (-2.5, 0.0))
GRID_TURNS = (0.0, 0.12, -0.12, 0.3, -0.3)  # radians
ALIKE_TURN = 0.02  # radians below which two motions may be the same
SMALLEST_SEGMENT, SEGMENTS = 6, 12  # points of a segment that is registered alone, and number of such segments
COARSE_GATES, COARSE_ALONG = np.array((8.0, 8.0, 6.0, 6.0, 4.0, 4.0, 3.0, 2.0)), np.array((1.0,) * 4 + (0.3,) * 4)
SEGMENT_GATES, SEGMENT_ALONG = np.array((6.0, 4.0, 3.0, 2.0)), np.array((1.0, 1.0, 0.3, 0.3))


Stage = Callable[[Array], Array]  # of (H, 3) motions to (H, ...), each for itself
Share = Callable[[Stage, Array], Array]  # calls a stage, maybe for parts of its motions at once


def alone(stage: Stage, motions: Array) -> Array:
    """All motions in this thread."""
    return stage(motions)


# The stages.


@entry
def _reach_of(source: Surface, target: Surface) -> float:
    return lower_median(np.concatenate((source.ranges, target.ranges)))


def start_grid(source: Surface, target: Surface) -> Array:
    """(H, 3) rotations and shifts scaled by the scene's size."""
    reach = np.float32(GRID_REACH * _reach_of(source, target))  # single precision: the labels on record depend on it
    turns, shifts = np.array(GRID_TURNS, np.float32), np.array(GRID_SHIFTS, np.float32)
    grid = np.concatenate([np.repeat(turns, len(shifts))[:, None], np.tile(shifts, (len(turns), 1)) * reach], axis=1)
    return grid.astype(np.float64)


@entry
def shifted_from(grid: Array, guesses: Array) -> Array:
    """(G H, 3) the motions (H, 3) of a grid, each after every guess (G, 3)."""
    starts = np.empty((len(guesses) * len(grid), 3))
    for g in range(len(guesses)):
        for h in range(len(grid)):
            starts[g * len(grid) + h] = compose(grid[h], guesses[g])
    return starts


@entry
def search_coarsely(motions: Array, source: ScanGrid, target: ScanGrid, unit: float) -> Array:
    """(H, 3) motions registered with wide gates by a part of the source's points."""
    stride = stride_of(len(source.features), COARSE_POINTS)
    points = every(source.scan.points, stride)
    return register(points, every(source.pull, stride), target, motions, unit * COARSE_GATES, COARSE_ALONG)


@entry
def slide(motions: Array, target: Surface, unit: float) -> Array:
    """(H S, 3) motions displaced along the main direction of the target's surfaces, where registration is slow or undetermined."""
    sine = cosine = 0.0
    for i in range(len(target.tangent)):
        x, y = target.tangent[i, 0], target.tangent[i, 1]
        sine += 2 * x * y
        cosine += x * x - y * y
    heading = math.atan2(sine, cosine) / 2  # the mean of axes, which have no sign
    dx, dy = SLIDE_STEP * unit * math.cos(heading), SLIDE_STEP * unit * math.sin(heading)
    slid = np.empty((len(motions) * 2 * SLIDES, 3))
    row = 0
    for h in range(len(motions)):
        for step in range(-SLIDES, SLIDES + 1):
            if step != 0:
                slid[row, 0] = motions[h, 0]
                slid[row, 1], slid[row, 2] = motions[h, 1] + step * dx, motions[h, 2] + step * dy
                row += 1
    return slid


def large_segments(source: Surface) -> Integers:
    """(S,) numbers of the segments that are registered alone, the largest first."""
    sizes = torch.from_numpy(np.bincount(source.segment))
    largest = sizes.argsort(descending=True)[:SEGMENTS]  # torch has its own order of ties
    return largest[sizes[largest] >= SMALLEST_SEGMENT].numpy()


@entry
def segment_points(source: Surface, chosen: Integers) -> Array:
    """(S, 24, 2) points of segments (S,), evenly drawn."""
    points = np.empty((len(chosen), SEGMENT_POINTS, 2))
    members = np.empty(len(source.points), np.int64)
    for s in range(len(chosen)):
        count = 0
        for i in range(len(members)):
            if source.segment[i] == chosen[s]:
                members[count] = i
                count += 1
        for k in range(SEGMENT_POINTS):
            i = members[k * count // SEGMENT_POINTS]
            points[s, k, 0], points[s, k, 1] = source.points[i, 0], source.points[i, 1]
    return points


@entry
def segment_hypotheses(segments: Array, target: ScanGrid, motions: Array, unit: float) -> Array:
    """(S H, 3) registers every segment (S, L, 2) alone: even if most returns belong to a mover, some segment is background."""
    H = len(motions)
    found = np.empty((len(segments) * H, 3))
    weights = np.ones(segments.shape[1])
    for s in range(len(segments)):
        found[s * H : (s + 1) * H] = register(segments[s], weights, target, motions, unit * SEGMENT_GATES, SEGMENT_ALONG)
    return found


@entry
def distinct(motions: Array, cost: Array, near: float, count: int) -> Integers:
    """Index of the `count` cheapest motions, no two of which are closer than `near` (metres) and similar in rotation."""
    is_left = np.ones(len(motions), np.bool_)
    kept = np.empty(min(count, len(motions)), np.int64)
    for k in range(len(kept)):
        best = -1
        for h in range(len(motions)):
            if is_left[h] and (best < 0 or cost[h] < cost[best]):
                best = h
        if best < 0:
            return kept[:k]
        kept[k] = best
        is_left[best] = False
        for h in range(len(motions)):
            dx, dy = motions[h, 1] - motions[best, 1], motions[h, 2] - motions[best, 2]
            if math.sqrt(dx * dx + dy * dy) < near and abs(wrap(motions[best, 0] - motions[h, 0])) < ALIKE_TURN:
                is_left[h] = False
    return kept


# The search.


def background_pool(source: ScanGrid, target: ScanGrid, guess: Array, extra: Array, share: Share = alone) -> Array:
    """(H, 3) hypotheses of the background's motion, cheapest first.

    Every stage's motions stay in the pool: where a mover supplies most returns, the next stage may lead away from the truth.

    Args:
        guess: (3,) one more place to search from, and one more hypothesis; so is the identity. extra: (H, 3) more starts.
        share: how the hypotheses of a stage are worked on.
    """
    unit = unit_length(source.scan, target.scan)
    grid = start_grid(source.scan, target.scan)

    def cheapest(motions: Array, most: int, slack: float, count: int) -> Array:
        cost = share(lambda part: background_cost(part, source, target, most, slack), motions)
        return motions[distinct(motions, cost, unit, count)]

    guesses = np.stack([np.zeros(3), guess]) if guess.any() else guess[None]
    given = np.concatenate([guesses, extra])
    starts = np.concatenate([shifted_from(grid, guesses), given])
    coarse = cheapest(share(lambda part: search_coarsely(part, source, target, unit), starts), COARSE_POINTS, 1.0, COARSE)
    slid = slide(np.concatenate([coarse, guesses]), target.scan, unit)
    slid = cheapest(slid, COARSE_POINTS, SLIDE_STEP, SLID)
    segments = segment_points(source.scan, large_segments(source.scan))
    by_segment = share(lambda part: segment_hypotheses(part, target, coarse[:3], unit), segments)
    pool = np.concatenate([coarse, given, slid, by_segment])
    cost = share(lambda part: background_cost(part, source, target, 0, 1.0), pool)
    kept = distinct(pool, cost, unit, KEPT)
    polished = share(lambda part: polish(part, source, target, unit), pool[kept])
    pool = np.concatenate([pool[kept], polished])
    cost = np.concatenate([cost[kept], share(lambda part: background_cost(part, source, target, 0, 1.0), polished)])
    refined = share(lambda part: refine(part, source, target), pool[distinct(pool, cost, unit / 2, REFINED)])
    pool = np.concatenate([pool, refined])
    cost = np.concatenate([cost, share(lambda part: background_cost(part, source, target, 0, 1.0), refined)])
    return pool[distinct(pool, cost, unit / 2, len(pool))]


def thinned(grid: ScanGrid) -> ScanGrid:
    """The grid of every second, third, ... point of a scan of more than `SEARCHED`: the search costs N^2."""
    scan, stride = grid.scan, -(-len(grid.features) // SEARCHED)
    if stride == 1:
        return grid
    return grid_of(surface_of(scan.points[::stride].copy(), scan.noise, scan.is_closed, scan.origin))


def find_background(source: ScanGrid, target: ScanGrid, guess: Array, share: Share = alone) -> Array:
    """(3,) the background's motion from shapes, a grid of starts and a guess (3,); scans of at least three points."""
    source, target = thinned(source), thinned(target)
    ransac = shape_motions(source.scan, target.scan, RANSAC_GATE * unit_length(source.scan, target.scan), RANSAC_STARTS)
    return background_pool(source, target, guess, ransac, share)[0]
