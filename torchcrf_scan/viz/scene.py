"""Common geometry of a figure's panels: points, windows onto them, and the time span of arrows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.geometry.velocity import ground_velocity
from torchcrf_scan.scan import BACKGROUND, Bools, Floats, Scan, ScanPair
from torchcrf_scan.viz.answers import Labels

HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # seconds of travel shown by an arrow

Window = tuple[Floats, Floats]  # lower and upper corner, (2,) each


@dataclass(frozen=True, slots=True)
class Scene:
    """Data shared by all panels of a figure; points are (n_beams, 2), NaN for beams without return."""

    source: Floats
    target: Floats
    dt: float
    faint: Bools
    window: Window
    zoom: Window | None
    arrow_seconds: float  # of travel, the same for all panels


def make_scene(pair: ScanPair, answers: list[Labels]) -> Scene:
    """The scene of a figure; the first of `answers` with a mover determines the magnified view."""
    source, target = _beam_points(pair.source), _beam_points(pair.target)
    faint = np.zeros(len(source), dtype=bool) if pair.annotation is None else np.asarray(pair.annotation.ignore)
    centroids = [_centroid(source, labels.cluster == k) for labels in answers[:1] for k in labels.movers]
    window = _robust_window(np.concatenate([source, target]), np.reshape(centroids, (-1, 2)))
    zooms = (_zoom_window(source, target, labels, window) for labels in answers)
    zoom = next((zoom for zoom in zooms if zoom is not None), None)
    speeds = [[float(np.hypot(*v)) for _, v in mover_velocities(source, pair.dt, labels).values()] for labels in answers]
    seconds = _horizon([max(fastest) for fastest in speeds if fastest], window)
    return Scene(source, target, pair.dt, faint, window, zoom, seconds)


def mover_velocities(source: Floats, dt: float, labels: Labels) -> dict[int, tuple[Floats, Floats]]:
    """Mover -> its centroid and its velocity relative to the world in the source frame, (2,) each, if both are known."""
    background = labels.motion(BACKGROUND)
    centroids = {k: _centroid(source, labels.cluster == k) for k in labels.movers.tolist()}
    found = {k: (centroid, ground_velocity(centroid, labels.motion(k), background, dt)) for k, centroid in centroids.items()}
    return {k: (centroid, velocity) for k, (centroid, velocity) in found.items() if np.isfinite(velocity).all()}


def _horizon(fastest: list[float], window: Window) -> float:
    """The longest of `HORIZONS` in which the fastest mover of a typical answer stays within a fifth of the picture."""
    reach = 0.2 * float((window[1] - window[0]).max())
    speed = float(np.median(fastest)) if fastest else 0.0
    return max((seconds for seconds in HORIZONS if seconds * speed <= reach), default=HORIZONS[0])


def _beam_points(scan: Scan) -> Floats:
    return scan.to_beams(scan.points, np.nan)


def _centroid(points: Floats, mask: Bools) -> Floats:
    points = points[mask & np.isfinite(points).all(axis=-1)]
    return points.mean(axis=0) if len(points) else np.full(2, np.nan)


def _robust_window(points: Floats, always: Floats) -> Window:
    """Contains the sensor, 96 % of the points per axis and the `always` ones, with a margin; aspect between 0.85 and 1.4."""
    points, always = points[np.isfinite(points).all(axis=-1)], always[np.isfinite(always).all(axis=-1)]
    bulk = np.percentile(points, (2, 98), axis=0) if len(points) else np.zeros((1, 2))
    corners = np.concatenate([bulk, always, np.zeros((1, 2))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(1.16 * (high - low), max(0.1 * float((high - low).max()), 0.5))
    size = np.maximum(size, [0.85 * size[1], size[0] / 1.4])
    return _box((low + high) / 2, size)


def _zoom_window(source: Floats, target: Floats, labels: Labels, window: Window) -> Window | None:
    """A window of the same aspect around the largest mover in both scans, None if nothing moves."""
    sizes = {int(k): int((np.isfinite(source[:, 0]) & (labels.cluster == k)).sum()) for k in labels.movers}
    if not sizes or max(sizes.values()) == 0:
        return None
    mask = labels.cluster == max(sizes, key=lambda k: sizes[k])
    points = np.concatenate([source[mask], target[labels.association[mask & (labels.association >= 0)]]])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    full = window[1] - window[0]
    scale = float(np.clip((1.35 * (high - low) / full).max(), 0.03, 1.0))
    return _box((low + high) / 2, scale * full)


def _box(centre: Floats, size: Floats) -> Window:
    return centre - size / 2, centre + size / 2
