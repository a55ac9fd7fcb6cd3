"""Simulated drives with everything that is true of them: the sensor's poses, and moving objects with persistent numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from torchcrf_scan.data.annotate import Capture
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.simulate import simulate_sequence
from torchcrf_scan.data.world import Mover
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Bools, Floats, Ints, Scan

PATIENCE = 2.0  # seconds for which an object that is out of sight stays in the world


@dataclass(frozen=True, slots=True)
class TrueObject:
    """A moving object at the time of a scan, in the frame of the drive's first scan.

    Attributes:
        number: from 1, the same in all scans.
        position: (2,) centre, metres. velocity: (2,) over ground, m/s. heading: radians.
        extent: (length, width) along and across the heading, metres.
        points: number of its returns in this scan; 0: hidden or out of reach.
    """

    number: int
    position: Floats
    velocity: Floats
    heading: float
    extent: tuple[float, float]
    points: int


@dataclass(frozen=True, slots=True)
class DriveScan:
    """One scan of a drive.

    Attributes:
        scan: the valid returns.
        stamp: seconds, of the middle of the sweep, when all that follows is true.
        pose: (3,) of the sensor in the frame of the first scan.
        body: (n_beams,) 0 background, the number of an object, -1 no return or one of no single surface.
        objects: all that move in the world, seen or not.
    """

    scan: Scan
    stamp: float
    pose: Floats
    body: Ints
    objects: tuple[TrueObject, ...]

    @property
    def moving(self) -> Bools:
        """(n_beams,) whether a beam hit a moving object."""
        return self.body > 0


class Drive(Sequence[DriveScan]):
    """The scans of one drive, in order.

    Args:
        name: of the drive. scans: its scans. sweep: seconds from the first to the last beam of each.
    """

    def __init__(self, name: str, scans: Sequence[DriveScan], sweep: float = 0.0) -> None:
        self.name = name
        self.sweep = sweep
        self._scans = tuple(scans)

    def __len__(self) -> int:
        return len(self._scans)

    @overload
    def __getitem__(self, index: int) -> DriveScan: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[DriveScan, ...]: ...
    def __getitem__(self, index: int | slice) -> DriveScan | tuple[DriveScan, ...]:
        return self._scans[index]

    @property
    def stamps(self) -> Floats:
        """(S,) seconds."""
        return np.array([of.stamp for of in self._scans])

    @property
    def poses(self) -> Floats:
        """(S, 3) of the sensor in the frame of the first scan."""
        return np.stack([of.pose for of in self._scans])

    def readings(self) -> Iterator[Reading]:
        """The scans as a recording gives them: without what is true, and stamped by their first beam."""
        for of in self._scans:
            yield Reading(of.scan, of.stamp - self.sweep / 2)


def simulate_drive(config: SimulatorConfig, scans: int, seed: int) -> Drive:
    """Simulates `scans` scans of one drive, `config.dt` seconds apart, among objects that come and go.

    Objects keep their numbers while they are hidden; those that stay out of sight for longer than two seconds are replaced by
    new ones. `worlds.every` changes the time between scans. The same arguments give the same bytes.

    Raises:
        TorchCRFScanError: fewer than two scans, or a negative seed.
    """
    if scans < 2:
        raise TorchCRFScanError(f"scans: expected at least 2, got {scans}")
    if seed < 0:
        raise TorchCRFScanError(f"seed: expected at least 0, got {seed}")
    patience = round(PATIENCE / config.dt)
    captures = simulate_sequence(config, scans - 1, np.random.default_rng([seed, 0]), patience)
    to_first = se2.inverse(captures[0].ego)
    return Drive(f"drive{seed}", [_true(capture, to_first, config.scale) for capture in captures], config.sweep)


def _true(capture: Capture, to_first: Floats, scale: float) -> DriveScan:
    """A scan with its truth. to_first: (3,) `T_first_world`, at full size."""
    unit = np.array([1.0, scale, scale])
    pose = unit * se2.compose(to_first, capture.ego)
    objects = tuple(_true_object(mover, capture, to_first, scale) for mover in capture.movers)
    scan = capture.scan
    return DriveScan(scan, float(capture.time), pose, scan.to_beams(capture.body, OUTLIER), objects)


def _true_object(mover: Mover, capture: Capture, to_first: Floats, scale: float) -> TrueObject:
    theta, x, y = se2.compose(to_first, mover.pose(capture.time))
    course = np.array([np.cos(theta), np.sin(theta)])
    length, width = 2 * scale * mover.half_size
    points = int(np.count_nonzero(capture.body == mover.number))
    position, velocity = scale * np.array([x, y]), scale * mover.speed * course
    return TrueObject(mover.number, position, velocity, float(theta), (float(length), float(width)), points)
