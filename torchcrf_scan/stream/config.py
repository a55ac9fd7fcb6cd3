"""Settings of a stream of scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from torchcrf_scan.checks import Amount, Share, Within, check_fields


@dataclass(frozen=True)
class StreamConfig:
    """Settings of `ScanStream`; the defaults serve robots, cars and standing sensors alike.

    Attributes:
        lag: seconds; a scan is matched to the newest one that is at least so much older: in less time nothing moves visibly.
        history: number of scans kept to match to.
        keyframe_share: a keyframe is replaced when it explains less than this share of a scan's background; half of it suffices
            while the sensor stands where it was taken.
        keyframe_distance: metres from its keyframe at which the sensor takes a new one.
        keyframe_turn: radians from its keyframe at which the sensor takes a new one.
        least_share: of the returns that a motion must explain; otherwise the scan is not placed.
        gap: seconds without a placed scan after which the stream starts anew from the predicted pose.
        memory: number of earlier scans asked what they saw where a point lies now.
        memory_spacing: seconds between those scans, at least.
        least_speed: metres per second, below which nothing counts as a moving object.
        deskew: scans with beam times are corrected for the motion during their sweep.
    """

    lag: Amount = 0.15
    history: Annotated[int, Within(1, 1000)] = 32
    keyframe_share: Share = 0.7
    keyframe_distance: Amount = 3.0
    keyframe_turn: Amount = 1.0
    least_share: Share = 0.2
    gap: Annotated[float, Within(0, above=True)] = 2.0
    memory: Annotated[int, Within(0, 1000)] = 6
    memory_spacing: Amount = 0.5
    least_speed: Amount = 0.2
    deskew: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
