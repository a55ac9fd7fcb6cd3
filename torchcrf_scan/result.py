"""What is known after a scan of a stream: the sensor's pose, what moves, the objects. Arrays, no tensors.

Frame `world`: that of the first scan. A pose is `T_world_sensor` = (theta, x, y), a point's position in the world is its image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from torchcrf_scan.scan import Bools, Floats, Ints, Scan

Status = Literal["ok", "degenerate", "lost"]


@dataclass(frozen=True, slots=True)
class MovingObject:
    """A moving object at the time of a scan, in the world.

    Attributes:
        number: of its track, from 1; never given twice.
        position: (2,) centre of its extent, metres. velocity: (2,) over ground, m/s.
        covariance: (4, 4) of (position, velocity).
        heading: radians, of the velocity while it moves, then the last one.
        extent: (length, width) along and across the heading, metres; of all that was seen of it.
        points: number of its points in this scan; 0: predicted, not seen.
        age: seconds since it was first seen.
    """

    number: int
    position: Floats
    velocity: Floats
    covariance: Floats
    heading: float
    extent: tuple[float, float]
    points: int
    age: float


@dataclass(frozen=True, slots=True)
class ScanResult:
    """What is known after a scan.

    Attributes:
        scan: the scan, corrected for the motion during its sweep where that was possible.
        stamp: seconds.
        pose: (3,) `T_world_sensor`. covariance: (3, 3) of it against the reference scan; never singular, large along what is
            not observed.
        twist: (3,) velocity (theta, x, y) in the sensor's frame, rad/s and m/s. twist_covariance: (3, 3).
        moving: (n_beams,) bool. track: (n_beams,) 0 background, the number of an object, -1 outlier or no return.
        objects: the tracks that are confirmed.
        status: `degenerate`: a direction of the motion is not observed, and predicted; `lost`: the scan was not placed, and
            the pose is predicted. reason: in words, empty if ok.
    """

    scan: Scan
    stamp: float
    pose: Floats
    covariance: Floats
    twist: Floats
    twist_covariance: Floats
    moving: Bools
    track: Ints
    objects: tuple[MovingObject, ...]
    status: Status
    reason: str


class Stream(Protocol):
    """What makes results of scans: `torchcrf_scan.stream.stream.ScanStream`, or anything with its `feed`."""

    def feed(self, scan: Scan, stamp: float, odometry: Floats | None = None) -> ScanResult:
        """What is known after one more scan."""
