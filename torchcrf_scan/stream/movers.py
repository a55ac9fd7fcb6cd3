"""Which of the objects that are followed move: the edge of a shadow and a wall's end are followed too."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchcrf_scan.result import MovingObject

CERTAIN = 1.75  # standard deviations of the speed, above which an object seems to move,
REPEATED = 2  # in so many sightings in a row,
PROGRESS = 0.3  # if its place went at least this share of the way that its velocity tells,
WINDOW = 0.6  # in so many seconds,
FEWEST = 2.0  # and if it has so many points a scan on average
STRONG_POINTS, STRONG_SPEED, STRONG_CERTAIN = 12, 1.5, 4.0  # points, m/s and standard deviations of what moves at once


@dataclass(slots=True)
class Course:
    """What was seen of one object: its places (stamp, (2,)), scans and points, how often it seemed to move in a row."""

    places: deque[tuple[float, np.ndarray]] = field(default_factory=deque)
    scans: int = 0
    points: int = 0
    in_a_row: int = 0
    moves: bool = False

    def add(self, stamp: float, of: MovingObject, least_speed: float) -> None:
        """Takes the object after a scan. least_speed: m/s, below which nothing seems to move."""
        self.scans, self.points = self.scans + 1, self.points + of.points
        self.places.append((stamp, of.position))
        while stamp - self.places[0][0] > WINDOW:
            self.places.popleft()
        if not of.points:
            return
        speed, deviation = float(np.hypot(*of.velocity)), float(np.sqrt(np.linalg.eigvalsh(of.covariance[2:, 2:])[1]))
        seems = speed > max(least_speed, CERTAIN * deviation) and self._progress(stamp, of) >= PROGRESS
        self.in_a_row = self.in_a_row + 1 if seems and self.points >= FEWEST * self.scans else 0
        at_once = of.points >= STRONG_POINTS and speed > max(STRONG_SPEED, STRONG_CERTAIN * deviation)
        self.moves = self.moves or at_once or self.in_a_row >= REPEATED

    def _progress(self, stamp: float, of: MovingObject) -> float:
        """Share of the way that the velocity tells which the place has gone; 1 of an object seen for the first time."""
        before, place = self.places[0]
        told = float(of.velocity @ of.velocity) * (stamp - before)
        return float((of.position - place) @ of.velocity) / told if told > 0 else 1.0


class Movers:
    """Tells which confirmed tracks move, or have moved: fast beyond doubt, twice in a row, and gone where the velocity points.

    Args:
        least_speed: m/s, below which nothing seems to move.
    """

    def __init__(self, least_speed: float) -> None:
        self._least_speed = least_speed
        self._courses: dict[int, Course] = {}  # by number

    def update(self, stamp: float, objects: Sequence[MovingObject]) -> tuple[MovingObject, ...]:
        """Takes all confirmed tracks after a scan, at a time in seconds; returns those that move."""
        self._courses = {of.number: self._courses.get(of.number) or Course() for of in objects}
        for of in objects:
            self._courses[of.number].add(stamp, of, self._least_speed)
        return tuple(of for of in objects if self._courses[of.number].moves)
