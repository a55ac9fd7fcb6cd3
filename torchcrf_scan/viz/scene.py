"""Common geometry of a figure's panels: points, windows onto them, and the time span of arrows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    speeds = [[float(np.hypot(*v)) for _, v in mover_velocities(source, pair.dt, labels).values()] for labels in answers]
    seconds = _horizon([max(fastest) for fastest in speeds if fastest], window)
    scene = Scene(source, target, pair.dt, faint, window, None, seconds)
    zooms = (zoom_on([(scene, labels)]) for labels in answers)
    return replace(scene, zoom=next((zoom for zoom in zooms if zoom is not None), None))


def join_windows(windows: Sequence[Window]) -> Window:
    """The smallest window around all of them, of an aspect between 0.85 and 1.4."""
    low, high = np.min([window[0] for window in windows], axis=0), np.max([window[1] for window in windows], axis=0)
    return _box((low + high) / 2, _within_aspect(high - low))


def zoom_on(steps: Sequence[tuple[Scene, Labels]]) -> Window | None:
    """A window of the aspect of the first scene's around one mover in all scans: the largest of the first pair that has one."""
    for scene, labels in steps:
        sizes = {k: int((np.isfinite(scene.source[:, 0]) & (labels.cluster == k)).sum()) for k in labels.movers.tolist()}
        if sizes and max(sizes.values()):
            mover = max(sizes, key=lambda k: sizes[k])
            break
    else:
        return None
    points = []
    for scene, labels in steps:
        mask = labels.cluster == mover
        points += [scene.source[mask], scene.target[labels.association[mask & (labels.association >= 0)]]]
    return _around(np.concatenate(points), steps[0][0].window)


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
    return _box((low + high) / 2, _within_aspect(np.maximum(1.16 * (high - low), max(0.1 * float((high - low).max()), 0.5))))


def _within_aspect(size: Floats) -> Floats:
    """(2,) the smallest size around this one of an aspect between 0.85 and 1.4."""
    return np.maximum(size, [0.85 * size[1], size[0] / 1.4])


def _around(points: Floats, window: Window) -> Window:
    """A window of the same aspect around points."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    full = window[1] - window[0]
    return _box((low + high) / 2, float(np.clip((1.35 * (high - low) / full).max(), 0.03, 1.0)) * full)


def _box(centre: Floats, size: Floats) -> Window:
    return centre - size / 2, centre + size / 2
