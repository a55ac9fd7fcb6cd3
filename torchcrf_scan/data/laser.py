"""The simulated laser: beams cast onto outlines, and what a scanner makes of their hits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.data.world import Shapes
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.scan import MAX_RANGE_MARGIN, Floats, Ints, Scan

NO_BODY = -1  # the body of a return of no single surface

VIBRATION_KNOTS = np.radians(8.0)  # angle over which neighbouring beams share a jolt
MIXED_JUMP = (0.3, 6.0)  # metres at full size; ranges this far apart merge in one beam; farther ones give two separate echoes
GRAZING_COSINE = 0.03  # loss of grazing beams: exp(-cosine / this)
LEAST_COSINE = 0.1  # the spacing of returns on a surface is limited to ten times that at normal incidence


@dataclass(frozen=True, slots=True)
class Hits:
    """The first hit of every beam, at full size: (B,) `ranges` (inf: none), `cosine` of incidence, and `body`."""

    ranges: Floats
    cosine: Floats
    body: Ints

    def nearer(self, other: Hits) -> Hits:
        """The nearer of the two, beam by beam."""
        closer = other.ranges < self.ranges
        pairs = ((self.ranges, other.ranges), (self.cosine, other.cosine), (self.body, other.body))
        return Hits(*(np.where(closer, theirs, ours) for ours, theirs in pairs))


def _segment_ranges(segments: Floats, directions: Floats) -> Floats:
    """(B, S) ranges at which beams from the origin meet segments (S, 4), else inf; directions: (B, 2)."""
    a, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    dx, dy = directions[:, :1], directions[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel beams divide by zero and fail all comparisons below
        inverse = 1.0 / (dx * edge[:, 1] - dy * edge[:, 0])
        ranges = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) * inverse
        along = (a[:, 0] * dy - a[:, 1] * dx) * inverse
        return np.where((ranges > 0) & (along >= 0) & (along <= 1), ranges, np.inf)


def _circle_ranges(circles: Floats, directions: Floats, rng: np.random.Generator) -> Floats:
    """(B, C) ranges at which beams meet circles (C, 4); in foliage they end at a random depth, or pass through."""
    along = directions @ circles[:, :2].T
    half_squared = circles[:, 2] ** 2 - (circles[:, :2] ** 2).sum(1) + along**2
    half = np.sqrt(np.maximum(half_squared, 0))
    ranges = along - half
    hit = (half_squared > 0) & (ranges > 0)
    leafy = np.flatnonzero(circles[:, 3] > 0)
    depth = rng.standard_exponential((len(directions), len(leafy))) * circles[leafy, 3]
    hit[:, leafy] &= depth < 2 * half[:, leafy]
    ranges[:, leafy] += depth
    return np.where(hit, ranges, np.inf)


def cast(shapes: Shapes, bearings: Floats, body: int, rng: np.random.Generator) -> Hits:
    """Casts every beam (B,) from the origin onto shapes in the sensor's frame. O(B (S + C))."""
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    n_segments, n_shapes = len(shapes.segments), len(shapes.segments) + len(shapes.circles)
    nothing = np.full((len(bearings), 1), np.inf)
    ranges = [_segment_ranges(shapes.segments, directions), _circle_ranges(shapes.circles, directions, rng), nothing]
    table = np.concatenate(ranges, axis=1)  # (B, S + C + 1)
    nearest = table.argmin(1)
    reached = table[np.arange(len(bearings)), nearest]
    nearest[np.isinf(reached)] = n_shapes
    cosine = np.ones(len(bearings))  # foliage has no orientation

    on = np.flatnonzero(nearest < n_segments)
    edge = shapes.segments[nearest[on], 2:] - shapes.segments[nearest[on], :2]
    cross = directions[on, 0] * edge[:, 1] - directions[on, 1] * edge[:, 0]
    cosine[on] = np.abs(cross) / np.hypot(edge[:, 0], edge[:, 1])

    on = np.flatnonzero((nearest >= n_segments) & (nearest < n_shapes))
    circle = shapes.circles[nearest[on] - n_segments]
    on, circle = on[circle[:, 3] == 0], circle[circle[:, 3] == 0]
    outward = directions[on] * reached[on, None] - circle[:, :2]
    cosine[on] = np.abs((directions[on] * outward).sum(1)) / circle[:, 2]
    return Hits(reached, cosine, np.full(len(bearings), body))


def in_view(shapes: Shapes, reach: float, fov: float) -> Shapes:
    """Culls shapes that no beam can meet, such as most of a long street. shapes: in the sensor's frame."""
    ends = shapes.segments.reshape(-1, 2, 2)
    near = np.hypot(*(ends.mean(1)).T) < reach + np.hypot(*(ends[:, 1] - ends[:, 0]).T) / 2
    near_circles = np.hypot(shapes.circles[:, 0], shapes.circles[:, 1]) < reach + shapes.circles[:, 2]
    if fov <= 180:
        near &= ends[:, :, 0].max(1) > 0
        near_circles &= shapes.circles[:, 0] + shapes.circles[:, 2] > 0
    return Shapes(shapes.segments[near], shapes.circles[near_circles])


# --- the sensor ---------------------------------------------------------------------------------------------------------------


def beam_bearings(config: SimulatorConfig) -> tuple[Floats, float]:
    """(beams,) bearings of the sensor and the angle between neighbours, radians; a single beam looks ahead."""
    fov = np.radians(config.fov)
    step = fov / config.beams if config.fov == 360 else fov / max(config.beams - 1, 1)
    first = -fov / 2 if config.beams > 1 else 0.0
    return first + step * np.arange(config.beams), float(step)


def _mix_edges(ranges: Floats, body: Ints, config: SimulatorConfig, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Mixed pixels: at some depth edges a beam returns a range between both surfaces, which belongs to no body."""
    with np.errstate(invalid="ignore"):
        jump = np.diff(ranges)  # inf - inf is nan: no edge
        is_edge = (np.abs(jump) > MIXED_JUMP[0]) & (np.abs(jump) < MIXED_JUMP[1]) & (rng.random(len(jump)) < config.mixed_pixels)
    edge = np.flatnonzero(is_edge)
    far = edge + (jump[edge] > 0)
    near = ranges[edge + (jump[edge] <= 0)]
    mixed, bodies = ranges.copy(), body.copy()
    mixed[far] = near + rng.uniform(0.1, 0.9, len(edge)) * np.abs(jump[edge])
    bodies[far] = NO_BODY
    return mixed, bodies


def _noise(bearings: Floats, config: SimulatorConfig, rng: np.random.Generator) -> Floats:
    """(B,) range noise of the beams plus the vibration shared by neighbours, metres."""
    knots = np.arange(bearings[0] - VIBRATION_KNOTS, bearings[-1] + 2 * VIBRATION_KNOTS, VIBRATION_KNOTS)
    jolts = np.interp(bearings, knots, rng.normal(0, config.vibration, len(knots)))
    return rng.normal(0, config.range_noise, len(bearings)) + jolts


def measure(hits: Hits, config: SimulatorConfig, rng: np.random.Generator) -> tuple[Scan, Ints, Ints, Floats]:
    """The measured scan of `hits`, and beam, body and spacing (n,) of its returns."""
    bearings, step = beam_bearings(config)
    ranges, body = _mix_edges(hits.ranges, hits.body, config, rng)
    ranges = config.scale * ranges + _noise(bearings, config, rng)
    grazing = np.exp(-hits.cosine / GRAZING_COSINE)
    lost = rng.random(len(ranges)) < config.dropout + (1 - config.dropout) * grazing
    keep = np.flatnonzero(~lost & (ranges > config.range_min) & (ranges < config.range_max - MAX_RANGE_MARGIN))
    limits = {"range_min": config.range_min, "range_max": config.range_max, "range_noise": config.range_noise}
    limits = limits if config.states_limits else {}
    scan = Scan.from_ranges(ranges[keep], bearings[keep], **limits)
    assert len(scan) == len(keep)
    return scan, keep, body[keep], scan.ranges * step / np.maximum(hits.cosine[keep], LEAST_COSINE)
