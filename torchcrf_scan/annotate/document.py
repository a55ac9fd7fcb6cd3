"""The annotation of one pair while it is made: labels, motions, and associations mended by hand.

A document does not change: every action gives a new one. It counts points; the file's annotation counts beams.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from torchcrf_scan.annotate.fit import FOLLOWS, Scans, fit, search
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction

UNKNOWN = -2  # label of points that nobody annotated, `ignore` in a file
MOST_MOVERS = 30
SAME = 1e-6  # radians or metres; a motion this near to the fitted one was fitted


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """What is known of N source points and K movers.

    Attributes:
        scans: the points.
        label: (N,) 0 background, k >= 1 mover k, -1 outlier, -2 unknown.
        motions: (K+1, 3) `T_target_source`, NaN for movers that are not there.
        held: (K+1,) bool, motions that are not fitted: set by hand, or the model's.
        mended: (N,) target points given by hand, -1 none, `FOLLOWS` where the association follows from the motion.
        is_line: motions are fitted point-to-line, else by Kabsch.
    """

    scans: Scans
    label: Ints
    motions: Floats
    held: Bools
    mended: Ints
    is_line: bool = True

    @property
    def moved(self) -> Floats:
        """(N, 2) every point under the motion of its own body, of outliers and unknown ones under the background's."""
        motion = self.motions[np.maximum(self.label, BACKGROUND)]
        return se2.rotate(motion[:, 0], self.scans.source) + motion[:, 1:]

    @property
    def association(self) -> Ints:
        """(N,) target points: those given by hand, else the nearest within the gate under the body's motion; -1 none."""
        nearest = self.scans.nearest(self.moved)
        return np.where(self.label >= BACKGROUND, np.where(self.mended == FOLLOWS, nearest, self.mended), OUTLIER)

    @property
    def movers(self) -> list[int]:
        """The movers that have points, ascending."""
        return np.unique(self.label[self.label > BACKGROUND]).tolist()

    def of(self, cluster: int) -> Ints:
        """The points of a cluster."""
        return np.flatnonzero(self.label == cluster)


def blank(scans: Scans) -> Document:
    """Everything unknown, and a sensor that stands still."""
    n = len(scans.source)
    start = np.zeros(3) if scans.pair.initial_motion is None else np.asarray(scans.pair.initial_motion, np.float64)
    return Document(scans, np.full(n, UNKNOWN), start[None], np.zeros(1, dtype=bool), np.full(n, FOLLOWS))


def proposed(scans: Scans, prediction: PairPrediction) -> Document:
    """The model's clusters and motions. These are held: with true labels they are nearer to the true motions than a fit is."""
    label = prediction.cluster[scans.pair.source.beam]
    motions = np.asarray(prediction.motions, np.float64)
    return replace(blank(scans), label=label, motions=motions, held=np.isfinite(motions[:, 0]))


def annotated(scans: Scans, annotation: Annotation) -> Document:
    """The document of an annotation: associations that do not follow from motions are mended, motions that no fit gives held."""
    beam = scans.pair.source.beam
    body = np.where(annotation.cluster >= BACKGROUND, annotation.cluster, annotation.body)[beam]
    label = np.where(annotation.ignore[beam], UNKNOWN, body)
    association = np.where(label >= BACKGROUND, scans.pair.target_points(annotation.association), FOLLOWS)
    motions = np.array(annotation.motions, np.float64)
    motions[BACKGROUND] = np.where(np.isnan(motions[BACKGROUND]), blank(scans).motions[0], motions[BACKGROUND])
    document = replace(blank(scans), label=label, motions=motions, mended=association, held=np.zeros(len(motions), dtype=bool))
    document = _fitted(document, np.flatnonzero(np.isnan(annotation.motions[:, 0])).tolist())
    follows = replace(document, mended=np.full(len(label), FOLLOWS)).association
    document = replace(document, mended=np.where(association == follows, FOLLOWS, association))
    apart = np.abs(_fitted(document, range(len(motions))).motions - document.motions).max(-1)
    return replace(document, held=apart > SAME)


def annotation_of(document: Document) -> Annotation:
    """What a pair file says of it, by beam."""
    source, target = document.scans.pair.source, document.scans.pair.target
    association, label = document.association, document.label
    beam = np.append(target.beam, OUTLIER)[association]
    body = np.where(label >= BACKGROUND, label, OUTLIER)
    cluster = np.where(association == OUTLIER, OUTLIER, body)
    return Annotation(
        source.to_beams(beam, OUTLIER),
        source.to_beams(cluster, OUTLIER),
        document.motions,
        source.to_beams(body, OUTLIER),
        source.to_beams(label == UNKNOWN, True),
    )


def assign(document: Document, points: Ints, label: int) -> Document:
    """Gives points to the background, an outlier's or unknown label, or to a mover; fits the motions that this concerns.

    Raises:
        TorchCRFScanError: a mover beyond the next free number.
    """
    if not UNKNOWN <= label <= min(len(document.motions), MOST_MOVERS):
        raise TorchCRFScanError(f"expected a mover up to {min(len(document.motions), MOST_MOVERS)}, got {label}")
    if not len(points):
        return document
    concerned, is_fresh = {int(k) for k in document.label[points]} | {label}, not (document.label == label).any()
    new, mended = document.label.copy(), document.mended.copy()
    new[points], mended[points] = label, FOLLOWS
    motions, held = document.motions, document.held
    if label == len(motions):
        motions, held = np.append(motions, np.full((1, 3), np.nan), axis=0), np.append(held, False)
    changed = replace(document, label=new, mended=mended, motions=motions, held=held)
    changed = _fitted(changed, sorted(k for k in concerned if k >= BACKGROUND))
    return fit_again(changed, label) if is_fresh and label >= BACKGROUND else changed


def new_mover(document: Document) -> int:
    """The first number without points, which may be one more than there are; `assign` refuses one too many."""
    return next(k for k in range(1, len(document.motions) + 1) if k not in document.movers)


def drag(document: Document, cluster: int, offset: Floats) -> Document:
    """Moves a cluster by hand: offset (3,), a turn about the centre of its moved points, then a shift in the target frame."""
    points = document.of(cluster)
    if not len(points) or not np.isfinite(document.motions[cluster]).all():
        return document
    centre = document.moved[points].mean(axis=0)
    shift = centre - se2.rotate(offset[0], centre) + offset[1:]
    motions, held = document.motions.copy(), document.held.copy()
    motions[cluster] = se2.compose(np.append(offset[0], shift), motions[cluster])
    held[cluster] = True
    return replace(document, motions=motions, held=held)


def fit_again(document: Document, cluster: int) -> Document:
    """Fits a cluster's motion from wider gates, from its own motion and all others; it is no longer held."""
    points, held = document.of(cluster), document.held.copy()
    if not len(points):
        return document
    held[cluster] = False
    return replace(document, motions=_searched(document, cluster), held=held)


def with_metric(document: Document, is_line: bool) -> Document:
    """All motions but those held by hand, fitted point-to-line or by Kabsch."""
    return _fitted(replace(document, is_line=is_line), range(len(document.motions)))


def mend(document: Document, points: Ints, targets: Ints) -> Document:
    """Associates points of bodies by hand: targets (P,), -1 no counterpart, `FOLLOWS` as the motion says."""
    mended = document.mended.copy()
    is_body = document.label[points] >= BACKGROUND
    mended[points[is_body]] = np.broadcast_to(targets, points.shape)[is_body]
    concerned = np.unique(document.label[points[is_body]]).tolist()
    return _fitted(replace(document, mended=mended), concerned)


def beside(document: Document, points: Ints, step: int) -> Ints:
    """The target points so many places after those that points are associated with; -1 for outliers."""
    association, last = document.association[points], len(document.scans.pair.target) - 1
    return np.where(association == OUTLIER, OUTLIER, np.clip(association + step, 0, last))


def surface(document: Document, points: Ints) -> Ints:
    """The points, and all that are connected with them beam by beam."""
    source = document.scans.source
    if not len(points):
        return points
    step = np.median(np.diff(document.scans.pair.source.bearings)) if len(source) > 1 else 0.0
    is_gap = np.linalg.norm(np.diff(source, axis=0), axis=-1) > document.scans.gate + 3 * step * np.hypot(*source[1:].T)
    run = np.append(0, np.cumsum(is_gap))
    return np.flatnonzero(np.isin(run, run[points]))


def _fitted(document: Document, clusters: Iterable[int]) -> Document:
    """The same with the motions of some clusters fitted, of new ones searched; movers without points lose theirs."""
    for k in clusters:
        points = document.of(k)
        motions, held = document.motions.copy(), document.held.copy()
        if not len(points):
            if k == BACKGROUND:
                continue
            motions[k], held[k] = np.nan, False
        elif np.isnan(motions[k]).any():
            motions = _searched(document, k)
        elif not held[k]:
            here = document.scans.source[points]
            motions[k] = fit(document.scans, here, document.mended[points], motions[k], document.is_line)
        document = replace(document, motions=motions, held=held)
    return document


def _searched(document: Document, cluster: int) -> Floats:
    points, motions = document.of(cluster), document.motions.copy()
    starts = [*motions[np.isfinite(motions).all(-1)], np.zeros(3)]
    here = document.scans.source[points]
    motions[cluster] = search(document.scans, here, document.mended[points], starts, document.is_line)
    return motions
