"""A scan of a recording, with what was recorded beside it."""

from __future__ import annotations

from dataclasses import dataclass

from torchcrf_scan.scan import Floats, Scan


@dataclass(frozen=True, slots=True)
class Reading:
    """One scan of a recording.

    Attributes:
        scan: the valid returns.
        stamp: seconds, of the scan's first beam; as recorded, plausible or not.
        odometry: (3,) pose (theta, x, y) of the sensor by the wheels; None: not recorded.
        pose: (3,) pose of the sensor as the log states it, corrected if the log is; None: not recorded.
    """

    scan: Scan
    stamp: float
    odometry: Floats | None = None
    pose: Floats | None = None
