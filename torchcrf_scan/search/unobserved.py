"""What a scene leaves open of the background's motion: of motions that explain it alike the one nearest to the guess is taken.

In a corridor any motion along the walls explains the scans alike. A search finds one of them by accident of sampling: mostly the
one that takes every beam to its own next reading.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array, Booleans, entry
from torchcrf_scan.loops.rigid import apply, rotate, transform_of
from torchcrf_scan.loops.solve import axes_of
from torchcrf_scan.prediction import LEAST_SHARE
from torchcrf_scan.search.background import background_cost, polish, refine, unit_length
from torchcrf_scan.search.directions import Directions, directions_of
from torchcrf_scan.search.grid import ScanGrid, grid_of

OPEN_SHARE = 0.75 * LEAST_SHARE  # of information, below which a direction is open: not even five points in three hundred tell
ALIKE = 0.4  # units both ways, of ordinarily 1 to 2: motions whose costs differ by less explain the scans alike
ALIKE_TURNED = 0.2  # the same for motions that are turned against each other
LARGE_TURN = 0.6  # radians against the guess; what has the same shape turned round, as a plain room, is checked for a smaller turn


class Observed(NamedTuple):
    """What is observed of a background motion, in the coordinates of `prediction.Uncertainty`.

    Attributes:
        information: (3,) ascending. axes: (3, 3) its directions, a row each. centre: (2,) of the moved points; length: L.
        surface: of all points of the source.
    """

    information: Array
    axes: Array
    centre: Array
    length: float
    surface: Directions

    @property
    def unobserved(self) -> Array:
        """(3, 3) projection on the directions that are not observed."""
        rows = self.axes * (self.information < OPEN_SHARE)[:, None]
        return rows.T @ rows


@entry
def observe(grid: ScanGrid, motion: Array, explained: Booleans) -> Observed:
    """What the points explained (P,) of a scan observe of its motion (3,)."""
    scan, by = grid.scan, transform_of(motion)
    surface = directions_of(scan.points, explained, scan.noise)
    moved = apply(motion, scan.points)
    total = x = y = second = 0.0
    for i in range(len(explained)):
        if explained[i]:
            total, x, y = total + 1, x + moved[i, 0], y + moved[i, 1]
    total = max(total, 1.0)
    x, y = x / total, y / total
    for i in range(len(explained)):
        if explained[i]:
            second += (moved[i, 0] - x) ** 2 + (moved[i, 1] - y) ** 2
    length = np.sqrt(second / total + scan.noise**2 + 1e-12)
    normal, row = np.zeros((3, 3)), np.empty((2, 3))
    for i in range(len(explained)):
        if not explained[i]:
            continue
        ux = uy = 0.0
        if surface.is_found[i] and (scan.tangent[i, 0] != 0 or scan.tangent[i, 1] != 0 or surface.is_straight[i]):
            ux, uy = rotate(by, surface.tangent[i, 0], surface.tangent[i, 1])
        lx, ly = (y - moved[i, 1]) / length, (moved[i, 0] - x) / length
        along = ux * lx + uy * ly
        row[0, 0], row[1, 0] = lx - ux * along, ly - uy * along
        row[0, 1], row[1, 1] = 1 - ux * ux, -uy * ux
        row[0, 2], row[1, 2] = -ux * uy, 1 - uy * uy
        for r in range(3):
            for d in range(3):
                normal[r, d] += (row[0, r] * row[0, d] + row[1, r] * row[1, d]) / total
    information, axes = axes_of(normal)
    centre = np.empty(2)
    centre[0], centre[1] = x, y
    return Observed(information, axes, centre, length, surface)


def settle(
    source: ScanGrid, target: ScanGrid, motion: Array, explained: Booleans, guess: Array
) -> tuple[ScanGrid, ScanGrid, Array]:
    """The grids and the background's motion (3,), as near to the guess (3,) as explains the scans alike.

    Where a direction is not observed, isolated returns in line with their neighbours are surface in the grids. explained: (P,).
    """
    seen = observe(source, motion, explained)
    if not (seen.information < OPEN_SHARE).any():
        return source, target, motion
    everything = np.ones(len(target.scan.points), np.bool_)
    there = observe(target, np.zeros(3), everything).surface
    source, target = straightened(source, seen.surface), straightened(target, there)
    nearer = less_turned(source, target, moved_towards(motion, guess, seen), guess)
    nearer = moved_towards(refine(nearer[None], source, target)[0], guess, seen)
    return source, target, nearer if is_alike(nearer, motion, source, target, ALIKE) else motion


def less_turned(source: ScanGrid, target: ScanGrid, motion: Array, guess: Array) -> Array:
    """(3,) the motion (3,), or if it is far turned against the guess (3,) the registration from there, if that explains alike."""
    if abs(se2.wrap(motion[0] - guess[0])) < LARGE_TURN:
        return motion
    other = refine(polish(guess[None], source, target, unit_length(source.scan, target.scan)), source, target)[0]
    return other if is_alike(other, motion, source, target, ALIKE_TURNED) else motion


def is_alike(one: Array, other: Array, source: ScanGrid, target: ScanGrid, units: float) -> bool:
    """Whether a motion (3,) explains the scans as well as another one (3,), but for some units of cost."""
    cost = background_cost(np.stack([one, other]), source, target, 0, 1.0)
    return bool(cost[0] <= cost[1] + units)


def moved_towards(motion: Array, guess: Array, seen: Observed) -> Array:
    """(3,) the motion, along what is not observed as the guess (3,)."""
    middle = se2.apply(se2.inverse(motion), seen.centre[None])
    shift = (se2.apply(guess, middle) - seen.centre)[0]
    turn, *shift = seen.unobserved @ np.array([se2.wrap(guess[0] - motion[0]) * seen.length, *shift])
    theta = turn / seen.length
    step = np.array([theta, *(seen.centre + shift - se2.rotate(np.array([theta]), seen.centre[None])[0])])
    return se2.compose(step, motion)


def straightened(grid: ScanGrid, surface: Directions) -> ScanGrid:
    """The grid with isolated points in line with their neighbours as pieces of surface."""
    scan = grid.scan
    is_piece = ~scan.tangent.any(-1) & surface.is_straight & surface.is_found
    gap = np.linalg.norm(np.diff(scan.points, axis=0), axis=1)
    nearest = np.minimum(np.append(gap, np.inf), np.append(np.inf, gap))
    tangent = np.where(is_piece[:, None], surface.tangent, scan.tangent)
    return grid_of(scan._replace(tangent=tangent, spacing=np.where(is_piece, nearest, scan.spacing)))
