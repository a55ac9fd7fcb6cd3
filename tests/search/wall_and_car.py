"""A car before a wall, as a sensor sees it."""

import math

import numpy as np
from surveyed import seen

from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.surface import Surface

STEP = math.radians(0.5)
FAR = 30.0


def wall_and_car(shift: float) -> ScanGrid:
    """A wall across the view, 30 m ahead, and a car's rear 0.8 m before it, `shift` metres to the left."""
    bearing = np.arange(-60, 61) * STEP
    is_car = np.abs(FAR * np.tan(bearing) - shift) < 0.9
    return grid_of(seen(polar((FAR - 0.8 * is_car) / np.cos(bearing), bearing)))


def polar(ranges: Array, bearing: Array) -> Array:
    return np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing)], axis=-1)


def on_car(scan: Surface) -> Booleans:
    return scan.points[:, 0] < FAR - 0.4
