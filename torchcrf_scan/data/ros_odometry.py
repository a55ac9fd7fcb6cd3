"""Odometry beside scans: the sensor's pose by the wheels at the time of every scan."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.ros_messages import planar_pose, stamp_of
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats

KEPT = 2000  # poses
PATIENCE = 50  # scans that wait for the pose after them
REACH = 0.2  # seconds beyond the last pose for which it is taken


@dataclass(slots=True)
class OdometryBeside:
    """Scans wait until a pose after them is known, and get the pose between those around them.

    Transforms tell where the sensor sits on the robot, as far as there are any; without, it sits in its centre.
    """

    _times: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    _poses: deque[Floats] = field(default_factory=lambda: deque(maxlen=KEPT))
    _waiting: deque[tuple[Reading, str]] = field(default_factory=deque)
    _parents: dict[str, tuple[str, Floats]] = field(default_factory=dict)
    _base: str = ""

    def transform(self, message: Any) -> None:
        """Notes the planar transforms of a TFMessage."""
        for one in message.transforms:
            pose = planar_pose(one.transform.translation, one.transform.rotation)
            if pose is not None:
                self._parents[one.child_frame_id.strip("/")] = (one.header.frame_id.strip("/"), pose)

    def pose(self, message: Any) -> Iterator[Reading]:
        """Notes the pose of an Odometry; the scans up to it."""
        pose, stamp = planar_pose(message.pose.pose.position, message.pose.pose.orientation), stamp_of(message.header)
        self._base = message.child_frame_id.strip("/")
        if pose is not None and not (self._times and stamp <= self._times[-1]):
            self._times.append(stamp)
            self._poses.append(pose)
        yield from self._ready(stamp)

    def scan(self, reading: Reading, frame: str) -> Iterator[Reading]:
        """Lets a scan wait; those that have waited too long."""
        self._waiting.append((reading, frame.strip("/")))
        while len(self._waiting) > PATIENCE:
            yield self._placed(*self._waiting.popleft())

    def rest(self) -> Iterator[Reading]:
        """The scans that still wait."""
        yield from self._ready(np.inf)

    def _ready(self, stamp: float) -> Iterator[Reading]:
        while self._waiting and self._waiting[0][0].stamp <= stamp:
            yield self._placed(*self._waiting.popleft())

    def _placed(self, reading: Reading, frame: str) -> Reading:
        robot = self._at(reading.stamp)
        return reading if robot is None else replace(reading, odometry=se2.compose(robot, self._mount(frame)))

    def _at(self, stamp: float) -> Floats | None:
        """(3,) pose of the robot; None: too far from those that are known."""
        times = self._times
        if not times or not times[0] - REACH <= stamp <= times[-1] + REACH:
            return None
        known = np.array(times)
        after = int(np.clip(np.searchsorted(known, stamp), 1, max(len(known) - 1, 1)))
        if len(known) == 1:
            return self._poses[0]
        a, b = self._poses[after - 1], self._poses[after]
        share = float(np.clip((stamp - known[after - 1]) / (known[after] - known[after - 1]), 0.0, 1.0))
        step = se2.compose(se2.inverse(a), b)
        return se2.compose(a, share * step)

    def _mount(self, frame: str) -> Floats:
        """(3,) pose of a frame on the robot, by the chain of transforms; the identity where there is none."""
        pose: Floats = np.zeros(3)
        for _ in range(len(self._parents)):
            if frame == self._base:
                return pose
            if frame not in self._parents:
                break
            frame, step = self._parents[frame]
            pose = se2.compose(step, pose)
        return pose if frame == self._base else np.zeros(3)
