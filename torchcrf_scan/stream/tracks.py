"""Objects over time: moving clusters of scan after scan become tracks with numbers, velocities and extents."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import MovingObject
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints
from torchcrf_scan.stream.assignment import Comparison, assign, twins
from torchcrf_scan.stream.track import Sighting, Track, TrackerConfig


@dataclass(frozen=True, slots=True)
class TrackPrediction:
    """Where a track is expected at some time, in the world.

    Attributes:
        number: of the track.
        position: (2,) centre of its extent, metres. velocity: (2,) over ground, m/s. covariance: (4, 4) of both.
        heading: radians. extent: (2,) length and width, metres.
        points: (n, 2) its points as last seen. shift: (2,) how far it has moved since.
        is_confirmed: whether it is more than a guess.
    """

    number: int
    position: Floats
    velocity: Floats
    covariance: Floats
    heading: float
    extent: Floats
    points: Floats
    shift: Floats
    is_confirmed: bool


class Tracker:
    """Follows moving objects from scan to scan.

    A cluster continues the track whose predicted motion and extent it fits best; others begin new tracks, which count as objects
    once they are seen repeatedly, or at once when much speaks for them. An object that is not seen is predicted for a while. The
    pieces of a cluster that lie apart may belong to several tracks; what they do not continue is ignored, but for the largest.
    Memory is bounded by the tracks alive, and these by the clusters of the scans of one `lifetime`.

    A stamp that stands still or goes back adds a sighting without motion; one that goes back by more than `lifetime` ends all
    tracks, and a gap those whose position it makes too uncertain (`loss`).
    """

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config or TrackerConfig()
        self._tracks: list[Track] = []
        self._born = 0
        self._stamp: float | None = None

    def predict(self, stamp: float) -> tuple[TrackPrediction, ...]:
        """All tracks at a time, confirmed or not, by number; nothing is changed."""
        return tuple(
            TrackPrediction(
                number=of.number,
                position=of.centre,
                velocity=of.velocity,
                covariance=of.covariance,
                heading=of.heading,
                extent=of.extent,
                points=of.points,
                shift=of.centre - of.seen_from,
                is_confirmed=of.is_confirmed,
            )
            for of in self._at(stamp)
        )

    def update(
        self,
        stamp: float,
        points: Floats,
        cluster: Ints,
        velocities: Floats,
        covariances: Floats,
        sensor: Floats | None = None,
        since: float = 0.0,
        turns: Floats | None = None,
    ) -> tuple[Ints, tuple[MovingObject, ...]]:
        """Takes a scan.

        Args:
            stamp: seconds.
            points: (N, 2) in the world. cluster: (N,) 0 background, k >= 1 mover k, -1 outlier.
            velocities: (K, 2) of the movers over ground, m/s. covariances: (K, 2, 2). NaN: not observed.
            sensor: (2,) its position in the world, which tells the faces it sees; None: not known.
            since: seconds over which the velocities were measured; 0: not known.
            turns: (K,) rad/s, at which the movers rotate; the velocities are those of the middle of their points. NaN: not known.

        Returns:
            (K,) the number of each mover's track, 0 for a mover without points, and the confirmed objects by number.

        Raises:
            TorchCRFScanError: a stamp or points that are not finite, shapes that do not fit each other, clusters beyond K.
        """
        points, cluster, velocities, covariances = _checked(stamp, points, cluster, velocities, covariances)
        rates = np.zeros(len(velocities)) if turns is None else np.asarray(turns, dtype=np.float64)
        if rates.shape != (len(velocities),):
            raise TorchCRFScanError(f"turns: expected ({len(velocities)},), got {rates.shape}")
        labels = [k for k in range(1, len(velocities) + 1) if (cluster == k).any()]
        sightings = [
            Sighting.of(points[cluster == k], velocities[k - 1], covariances[k - 1], since, float(rates[k - 1]), self.config)
            for k in labels
        ]
        numbers, objects = self._taken(stamp, sightings, sensor)
        of_cluster = np.zeros(len(velocities), dtype=np.int64)
        of_cluster[[k - 1 for k in labels]] = numbers
        return of_cluster, objects

    def _taken(
        self, stamp: float, sightings: Sequence[Sighting], sensor: Floats | None
    ) -> tuple[list[int], tuple[MovingObject, ...]]:
        """Follows the sightings of a scan; returns the track number of each, and the confirmed objects."""
        tracks = self._at(stamp)
        found, numbers = self._matched(tracks, sightings)
        after = [
            track.seen(found[track.number], sensor, self.config) if track.number in found else track.missed(self.config)
            for track in tracks
        ]
        after = [track for track in after if track.number in found or not track.is_over(self.config)]
        first = {n: of.pieces()[0] for n, of in zip(numbers, sightings, strict=True) if n not in found}
        born = [Track.born_of(n, stamp, of, self.config) for n, of in first.items()]
        same = twins([*after, *born])
        self._tracks, self._stamp = [of for of in (*after, *born) if of.number not in same], stamp
        seen: Counter[int] = Counter()
        for number, of in (found | first).items():
            seen[same.get(number, number)] += len(of.points)
        objects = tuple(of.to_object(seen[of.number]) for of in self._tracks if of.is_confirmed)
        return [same.get(number, number) for number in numbers], objects

    def _at(self, stamp: float) -> list[Track]:
        """The tracks predicted to a time, without those that it ends."""
        if self._stamp is not None and stamp < self._stamp - self.config.lifetime:
            return []
        return [of for of in (track.at(stamp, self.config) for track in self._tracks) if not of.is_lost(self.config)]

    def _matched(self, tracks: Sequence[Track], sightings: Sequence[Sighting]) -> tuple[dict[int, Sighting], list[int]]:
        """The sighting of each track seen, by its number, and the track number of every sighting, new ones included."""
        pieces = [(k, piece) for k, of in enumerate(sightings) for piece in of.pieces()]
        found, numbers = {}, [0] * len(pieces)
        if tracks and pieces:
            beside = Comparison(tracks, [piece for _, piece in pieces], self.config)
            for i, p in assign(beside.cost):
                numbers[p] = tracks[i].number
                found[tracks[i].number] = pieces[p][1]
            for p in np.flatnonzero(np.array(numbers) == 0).tolist():
                inside = [track.number for track, is_part in zip(tracks, beside.is_part[:, p], strict=True) if is_part]
                numbers[p] = next((number for number in inside if number in found), 0)
                if numbers[p]:  # an object in pieces
                    found[numbers[p]] = found[numbers[p]].joined(pieces[p][1])
        firsts = [next(p for p, (of, _) in enumerate(pieces) if of == k) for k in range(len(sightings))]
        return found, [numbers[p] or self._next_number() for p in firsts]

    def _next_number(self) -> int:
        self._born += 1
        return self._born


def _checked(
    stamp: float, points: Floats, cluster: Ints, velocities: Floats, covariances: Floats
) -> tuple[Floats, Ints, Floats, Floats]:
    """The arguments of `update` as arrays of fitting shapes."""
    points, velocities = np.asarray(points, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
    cluster, covariances = np.asarray(cluster), np.asarray(covariances, dtype=np.float64)
    if not np.isfinite(stamp):
        raise TorchCRFScanError(f"stamp: expected finite seconds, got {stamp}")
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise TorchCRFScanError(f"points: expected finite numbers (N, 2), got {points.shape}")
    if cluster.shape != (len(points),):
        raise TorchCRFScanError(f"cluster: expected one label per point ({len(points)},), got {cluster.shape}")
    if velocities.ndim != 2 or velocities.shape[1] != 2:
        raise TorchCRFScanError(f"velocities: expected (K, 2), got {velocities.shape}")
    if covariances.shape != (len(velocities), 2, 2):
        raise TorchCRFScanError(f"covariances: expected ({len(velocities)}, 2, 2), got {covariances.shape}")
    if len(cluster) and not (cluster.min() >= OUTLIER and cluster.max() <= BACKGROUND + len(velocities)):
        raise TorchCRFScanError(f"cluster: expected labels in [-1, {len(velocities)}], got {cluster.min()} to {cluster.max()}")
    return points, cluster, velocities, covariances
