"""Figures of a pair: what became of every point, what moves together and how fast, beside the truth where it is known.

All positions are in the source sensor's frame (x ahead, y left, metres); target points are drawn at their own coordinates, so the
line of an association also shows how far the sensor moved. Arrows show velocities relative to the world: for a mover with motion
T and the background's B, both `T_target_source`, its centroid c travels B^-1(T(c)) - c in `dt` seconds.

Matplotlib is imported when a figure is made, not with this module, and pyplot never: no global state, no display.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction, Scan, ScanPair

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SOURCE, TARGET = "#4F7396", "#F28E2B"
STATIC, INK, WRONG = "#A3A9B0", "#1F2328", "#C1121F"
MOVERS = ("#009E73", "#CC5FA6", "#0072B2", "#D55E00", "#6F4E9C", "#35A7DB")  # after Okabe and Ito, told apart by the colour-blind
MARKERS = "osD^v"  # the second six movers wear the second marker, and so on
FAINT = 0.22  # opacity of what nobody annotated
ASSOCIATION_TOLERANCE = 2  # beams: an association this near is drawn as right
HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # seconds of travel that an arrow may stand for
MAX_SPEED_LABELS = 10  # the largest movers, more would cover the picture
PANEL_HEIGHT = 3.7  # inches
MAX_COLUMNS = 4

Window = tuple[Floats, Floats]  # lower and upper corner, (2,) each


@dataclass(frozen=True, slots=True)
class _Scene:
    """What every panel of a figure shares; points are (n_beams, 2), NaN where a beam returned nothing."""

    source: Floats
    target: Floats
    dt: float
    faint: Bools
    window: Window
    zoom: Window | None


@dataclass(frozen=True, slots=True)
class _Labels:
    """One answer for a pair, by source beam, its movers numbered as the annotation's where they match; unknown motions are NaN."""

    association: Ints
    cluster: Ints
    motions: Floats

    @property
    def movers(self) -> Ints:
        return np.unique(self.cluster[self.cluster > BACKGROUND])

    def motion(self, cluster: int) -> Floats:
        return self.motions[cluster] if cluster < len(self.motions) else np.full(3, np.nan)


@dataclass(frozen=True, slots=True)
class _Answer:
    """Labels with a name, and which associations and clusters to ring: the prediction's mistakes, None without a truth."""

    name: str
    labels: _Labels
    wrong_association: Bools | None = None
    wrong_cluster: Bools | None = None


def plot_pair(pair: ScanPair, prediction: PairPrediction | None = None) -> Figure:
    """Draws a pair, its prediction (first row) and its annotation (next row, with the prediction's mistakes ringed).

    Columns: both scans in their sensors' frames (next row: with the sensor's motion undone); associations; clusters with the
    movers' velocities and the sensor's motion; a magnified view of the largest mover. Rows and columns without content are left out.

    Raises:
        ValueError: the prediction does not fit the pair.
    """
    truth = _truth(pair)
    guess = None if prediction is None else _predicted(pair, "prediction", prediction, truth)
    rows = []
    if guess is not None:
        rows.append(_Answer("predicted", guess))
    if truth is not None:
        rows.append(_Answer("true", truth) if guess is None else _judged("true", truth, pair, guess, truth))
    scene = _scene(pair, [row.labels for row in reversed(rows)])
    columns = 1 if not rows else 3 + (scene.zoom is not None)
    figure, axes = _canvas(scene, max(len(rows), 1), columns)
    _draw_scans(axes[0][0], scene)
    for index, (answer, panels) in enumerate(zip(rows, axes, strict=False)):
        if index > 0:
            _draw_registered(panels[0], scene, answer)
        _draw_associations(panels[1], scene, answer, f"{answer.name} associations")
        _draw_clusters(panels[2], scene, answer, f"{answer.name} clusters")
        if scene.zoom is not None:
            _draw_zoom(panels[3], scene, answer, "magnified")
    return _finish(figure, pair)


def plot_associations(pair: ScanPair, predictions: Mapping[str, PairPrediction]) -> Figure:
    """Draws the associations of several methods side by side, the truth last, the largest mover magnified below each.

    Args:
        pair: with an annotation, mistakes are ringed (more than `ASSOCIATION_TOLERANCE` beams off, or outlier against inlier).
        predictions: method name -> its prediction of this pair.

    Raises:
        ValueError: there is nothing to draw, or a prediction does not fit the pair.
    """
    answers = _answers(pair, predictions)
    scene = _scene(pair, [answer.labels for answer in reversed(answers)])
    rows_each = 1 + (scene.zoom is not None)
    figure, axes = _canvas(scene, rows_each * -(-len(answers) // MAX_COLUMNS), min(len(answers), MAX_COLUMNS))
    for index, answer in enumerate(answers):
        row, column = divmod(index, MAX_COLUMNS)
        _draw_associations(axes[row * rows_each][column], scene, answer, answer.name)
        if scene.zoom is not None:
            _draw_zoom(axes[row * rows_each + 1][column], scene, answer, "magnified")
    return _finish(figure, pair)


def plot_clusters(pair: ScanPair, predictions: Mapping[str, PairPrediction]) -> Figure:
    """Draws the clusters and velocities of several methods side by side, the truth last.

    Args:
        pair: with an annotation, mistakes are ringed; movers are matched to the true ones first and share their colours.
        predictions: method name -> its prediction of this pair.

    Raises:
        ValueError: there is nothing to draw, or a prediction does not fit the pair.
    """
    answers = _answers(pair, predictions)
    scene = _scene(pair, [answer.labels for answer in reversed(answers)])
    figure, axes = _canvas(scene, -(-len(answers) // MAX_COLUMNS), min(len(answers), MAX_COLUMNS))
    for index, answer in enumerate(answers):
        _draw_clusters(axes[index // MAX_COLUMNS][index % MAX_COLUMNS], scene, answer, answer.name)
    return _finish(figure, pair)


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: float = 130.0) -> None:
    """Writes a PNG in one step (a temporary file beside it, then a rename); makes the folders above it.

    Raises:
        ValueError: `path` does not end in .png.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"path: expected a name ending in .png, got {path.name!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        figure.savefig(temporary, format="png", dpi=dpi)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


# Answers and their mistakes


def _truth(pair: ScanPair) -> _Labels | None:
    return None if pair.annotation is None else _labels(pair, "annotation", pair.annotation)


def _predicted(pair: ScanPair, name: str, prediction: PairPrediction, truth: _Labels | None) -> _Labels:
    labels = _labels(pair, name, prediction)
    return labels if truth is None else _renumber(labels, truth)


def _labels(pair: ScanPair, name: str, given: Annotation | PairPrediction) -> _Labels:
    association, cluster = np.asarray(given.association), np.asarray(given.cluster)
    motions = np.asarray(given.motions, dtype=np.float64)
    for key, values in (("association", association), ("cluster", cluster)):
        if values.shape != (pair.source.n_beams,):
            raise ValueError(f"{name}.{key}: expected shape ({pair.source.n_beams},), got {values.shape}")
    if (association >= pair.target.n_beams).any():
        raise ValueError(f"{name}.association: expected indices below {pair.target.n_beams}, got {association.max()}")
    return _Labels(association, cluster, motions.reshape(-1, 3))


def _renumber(labels: _Labels, truth: _Labels) -> _Labels:
    """Gives every mover the number of the true one it overlaps most (one to one, largest overlap in all), others new numbers."""
    from scipy.optimize import linear_sum_assignment

    movers, true_movers = labels.movers, truth.movers
    shared = (labels.cluster == movers[:, None])[:, None] & (truth.cluster == true_movers[:, None])[None]  # (K, L, n)
    overlap = shared.sum(-1)
    rows, columns = linear_sum_assignment(-overlap)
    matched = {int(movers[i]): int(true_movers[j]) for i, j in zip(rows, columns, strict=True) if overlap[i, j] > 0}
    first_new = max([len(truth.motions) - 1, *true_movers.tolist(), 0]) + 1
    new = {int(k): first_new + i for i, k in enumerate(k for k in movers if int(k) not in matched)}
    cluster, motions = labels.cluster.copy(), np.full((first_new + len(new), 3), np.nan)
    motions[BACKGROUND] = labels.motion(BACKGROUND)
    for old, number in (matched | new).items():
        cluster[labels.cluster == old] = number
        motions[number] = labels.motion(old)
    return _Labels(labels.association, cluster, motions)


def _judged(name: str, drawn: _Labels, pair: ScanPair, guess: _Labels, truth: _Labels) -> _Answer:
    """The labels `drawn` with the mistakes of `guess` to ring; what nobody annotated is never wrong."""
    assert pair.annotation is not None
    known = ~pair.annotation.ignore
    known &= pair.source.to_beams(np.ones(len(pair.source), dtype=bool), False)
    a, b = guess.association, truth.association
    near = ((a < 0) & (b < 0)) | ((a >= 0) & (b >= 0) & (np.abs(a - b) <= ASSOCIATION_TOLERANCE))
    return _Answer(name, drawn, known & ~near, known & (guess.cluster != truth.cluster))


def _answers(pair: ScanPair, predictions: Mapping[str, PairPrediction]) -> list[_Answer]:
    truth = _truth(pair)
    if truth is None and not predictions:
        raise ValueError("predictions: expected at least one method for a pair without annotation, got none")
    answers = []
    for name, prediction in predictions.items():
        guess = _predicted(pair, name, prediction, truth)
        answers.append(_Answer(name, guess) if truth is None else _judged(name, guess, pair, guess, truth))
    return answers if truth is None else [*answers, _Answer("truth", truth)]


# Where to look


def _scene(pair: ScanPair, answers: list[_Labels]) -> _Scene:
    """The common ground of all panels; `answers` in order of trust: the first that has a mover chooses the magnified view."""
    source, target = _beam_points(pair.source), _beam_points(pair.target)
    faint = np.zeros(len(source), dtype=bool) if pair.annotation is None else np.asarray(pair.annotation.ignore)
    centroids = [c for c in (_centroid(source, answers[0].cluster == k) for k in answers[0].movers) if np.isfinite(c).all()] if answers else []
    window = _robust_window(np.concatenate([source, target]), np.reshape(centroids, (-1, 2)))
    zooms = (_zoom_window(source, target, labels, window) for labels in answers)
    return _Scene(source, target, pair.dt, faint, window, next((zoom for zoom in zooms if zoom is not None), None))


def _beam_points(scan: Scan) -> Floats:
    return scan.to_beams(scan.points, np.nan)


def _centroid(points: Floats, mask: Bools) -> Floats:
    points = points[mask & np.isfinite(points).all(axis=-1)]
    return points.mean(axis=0) if len(points) else np.full(2, np.nan)


def _robust_window(points: Floats, always: Floats) -> Window:
    """Holds the sensor, 96 % of the points per axis and the `always` ones, with a margin; aspect between 0.8 and 1.6."""
    points = points[np.isfinite(points).all(axis=-1)]
    bulk = np.percentile(points, (2, 98), axis=0) if len(points) else np.zeros((1, 2))
    corners = np.concatenate([bulk, always, np.zeros((1, 2))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(1.16 * (high - low), max(0.1 * float((high - low).max()), 0.5))
    size = np.maximum(size, [0.8 * size[1], size[0] / 1.6])
    return _box((low + high) / 2, size)


def _zoom_window(source: Floats, target: Floats, labels: _Labels, window: Window) -> Window | None:
    """A window of the same aspect around the largest mover and what it became, None where nothing moves."""
    sizes = {int(k): int((np.isfinite(source[:, 0]) & (labels.cluster == k)).sum()) for k in labels.movers}
    if not sizes or max(sizes.values()) == 0:
        return None
    mask = labels.cluster == max(sizes, key=lambda k: sizes[k])
    points = np.concatenate([source[mask], target[labels.association[mask & (labels.association >= 0)]]])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    full = window[1] - window[0]
    scale = float(np.clip((1.5 * (high - low) / full).max(), 0.06, 1.0))
    return _box((low + high) / 2, scale * full)


def _box(centre: Floats, size: Floats) -> Window:
    return centre - size / 2, centre + size / 2


# Panels


def _draw_scans(ax: Axes, scene: _Scene) -> None:
    _frame(ax, scene.window, "both scans", "each in its own sensor's frame")
    _dots(ax, scene.target, TARGET, "target scan", size=2.6)
    _dots(ax, scene.source, SOURCE, "source scan", size=2.6)
    _sensor(ax, np.zeros(2), INK)


def _draw_registered(ax: Axes, scene: _Scene, answer: _Answer) -> None:
    """Both scans in the target's frame: what is static coincides, what moves stands apart."""
    background = answer.labels.motion(BACKGROUND)
    _frame(ax, scene.window, "sensor's motion undone", f"source moved by the {answer.name} background motion")
    _dots(ax, scene.target, TARGET, "target scan", size=2.6)
    if np.isfinite(background).all():
        _dots(ax, se2.apply(background, scene.source), SOURCE, "source scan", size=2.6)
        _sensor(ax, background[1:], SOURCE)
    _sensor(ax, np.zeros(2), TARGET)


def _draw_associations(ax: Axes, scene: _Scene, answer: _Answer, title: str) -> None:
    outliers = int((np.isfinite(scene.source[:, 0]) & (answer.labels.association < 0)).sum())
    note = f"{outliers} outliers" + _mistakes(answer.wrong_association, scene)
    _frame(ax, scene.window, title, note)
    _associations(ax, scene, answer, size=2.0)
    if scene.zoom is not None:
        (x, y), (x_end, y_end) = scene.zoom
        ax.plot([x, x_end, x_end, x, x], [y, y, y_end, y_end, y], color=INK, lw=0.8, ls=(0, (4, 3)), zorder=5)
    _sensor(ax, np.zeros(2), INK)


def _draw_zoom(ax: Axes, scene: _Scene, answer: _Answer, title: str) -> None:
    assert scene.zoom is not None
    _frame(ax, scene.zoom, title, "the largest mover (dashed box)")
    _associations(ax, scene, answer, size=5.0)


def _draw_clusters(ax: Axes, scene: _Scene, answer: _Answer, title: str) -> None:
    labels = answer.labels
    _frame(ax, scene.window, title, _ego_motion(labels.motion(BACKGROUND)) + _mistakes(answer.wrong_cluster, scene))
    static = labels.cluster == BACKGROUND
    _dots(ax, scene.source, STATIC, "background", static, scene.faint, size=2.6)
    for k in labels.movers.tolist():
        color, marker = _look(k)
        _dots(ax, scene.source, color, "", labels.cluster == k, scene.faint, size=4.2, marker=marker)
    _outliers(ax, scene, labels.cluster == OUTLIER, size=3.2)
    _rings(ax, scene, answer.wrong_cluster, size=7.5)
    _velocities(ax, scene, labels)
    _sensor(ax, np.zeros(2), INK)


def _associations(ax: Axes, scene: _Scene, answer: _Answer, size: float) -> None:
    labels = answer.labels
    associated = labels.association >= 0
    _dots(ax, scene.target, TARGET, "target scan", size=size)
    for k in np.unique(labels.cluster[associated]).tolist():
        _lines(ax, scene, labels, associated & (labels.cluster == k), k, width=0.5 + 0.12 * size)
    _dots(ax, scene.source, SOURCE, "source scan", associated, scene.faint, size=size)
    _outliers(ax, scene, ~associated, size=1.6 + 0.8 * size)
    _rings(ax, scene, answer.wrong_association, size=5.0 + size)


# Marks


def _dots(
    ax: Axes,
    points: Floats,
    color: str,
    label: str,
    mask: Bools | None = None,
    faint: Bools | None = None,
    *,
    size: float,
    marker: str = "o",
) -> None:
    mask = np.ones(len(points), dtype=bool) if mask is None else mask
    for part, alpha in _by_opacity(mask, faint):
        name = label if alpha == 1.0 else ""
        ax.plot(*points[part].T, ls="", marker=marker, ms=size, mew=0, color=color, alpha=alpha, label=name, zorder=3)


def _outliers(ax: Axes, scene: _Scene, mask: Bools, size: float) -> None:
    for part, alpha in _by_opacity(mask, scene.faint):
        name = "outlier" if alpha == 1.0 else ""
        ax.plot(*scene.source[part].T, ls="", marker="x", ms=size, mew=0.8, color=INK, alpha=alpha, label=name, zorder=3.2)


def _rings(ax: Axes, scene: _Scene, mask: Bools | None, size: float) -> None:
    if mask is not None and mask.any():
        ax.plot(*scene.source[mask].T, ls="", marker="o", ms=size, mfc="none", mec=WRONG, mew=0.9, label="predicted wrong", zorder=4)


def _lines(ax: Axes, scene: _Scene, labels: _Labels, mask: Bools, cluster: int, width: float) -> None:
    """Lines from source points to their target points, in the cluster's colour; one artist, broken by NaN."""
    color = INK if cluster <= BACKGROUND else _look(cluster)[0]
    for part, alpha in _by_opacity(mask, scene.faint):
        ends = np.stack([scene.source[part], scene.target[labels.association[part]]], axis=1)  # (n, 2 ends, 2)
        path = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        name = "association" if cluster <= BACKGROUND and alpha == 1.0 else ""
        ax.plot(*path.T, color=color, lw=width, alpha=0.75 * alpha, label=name, zorder=2)


def _velocities(ax: Axes, scene: _Scene, labels: _Labels) -> None:
    """Arrows and speeds of the movers whose motion is known; all arrows of a panel stand for the same time of travel."""
    if not (np.isfinite(scene.dt) and scene.dt > 0):
        return
    moving = [(k, *_velocity(scene, labels, k)) for k in labels.movers.tolist()]
    moving = [(k, centroid, velocity) for k, centroid, velocity in moving if np.isfinite(velocity).all()]
    if not moving:
        return
    centroids, velocities = np.stack([m[1] for m in moving]), np.stack([m[2] for m in moving])
    seconds = _horizon(velocities, scene.window)
    colors = [_look(k)[0] for k, *_ in moving]
    ax.quiver(
        *centroids.T, *(seconds * velocities).T, color=colors, angles="xy", scale_units="xy", scale=1, units="inches", width=0.03,
        edgecolor="white", linewidth=0.4, minshaft=1.5, zorder=6,
    )  # fmt: skip
    largest = sorted(moving, key=lambda m: -int((labels.cluster == m[0]).sum()))[:MAX_SPEED_LABELS]
    for k, centroid, velocity in largest:
        _speed_label(ax, centroid + seconds * velocity, velocity, _look(k)[0])
    ax.text(0.985, 0.015, f"arrow: {seconds:g} s of travel", transform=ax.transAxes, ha="right", va="bottom", fontsize=7, color="#57606A")


def _velocity(scene: _Scene, labels: _Labels, mover: int) -> tuple[Floats, Floats]:
    """Centroid of a mover and its velocity relative to the world, (2,) each, in the source frame."""
    centroid = _centroid(scene.source, labels.cluster == mover)
    end = se2.apply(se2.compose(se2.inverse(labels.motion(BACKGROUND)), labels.motion(mover)), centroid[None])[0]
    return centroid, (end - centroid) / scene.dt


def _horizon(velocities: Floats, window: Window) -> float:
    """The longest of `HORIZONS` in which the fastest mover stays within a fifth of the picture."""
    reach = 0.2 * float((window[1] - window[0]).max())
    fastest = float(np.hypot(*velocities.T).max())
    return max((s for s in HORIZONS if s * fastest <= reach), default=HORIZONS[0])


def _speed_label(ax: Axes, tip: Floats, velocity: Floats, color: str) -> None:
    speed = float(np.hypot(*velocity))
    direction = velocity / speed if speed > 0.0 else np.array([0.0, 1.0])
    ax.annotate(
        f"{speed:.2f} m/s" if speed < 10.0 else f"{speed:.1f} m/s", tuple(tip), (14 * direction[0], 9 * direction[1]),
        textcoords="offset points", ha="left" if direction[0] > 0.3 else "right" if direction[0] < -0.3 else "center", va="center",
        fontsize=8, fontweight="bold", color=color, bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.8},
        annotation_clip=True, in_layout=False, zorder=7,
    )  # fmt: skip


def _sensor(ax: Axes, position: Floats, color: str) -> None:
    ax.plot(*position, ls="", marker=(3, 0, -90), ms=9, color=color, mec="white", mew=0.8, label="sensor", zorder=5)


def _look(cluster: int) -> tuple[str, str]:
    round_, index = divmod(cluster - 1, len(MOVERS))
    return MOVERS[index], MARKERS[round_ % len(MARKERS)]


def _by_opacity(mask: Bools, faint: Bools | None) -> Iterator[tuple[Bools, float]]:
    faint = np.zeros_like(mask) if faint is None else faint
    for part, alpha in ((mask & ~faint, 1.0), (mask & faint, FAINT)):
        if part.any():
            yield part, alpha


# Figure and words


def _canvas(scene: _Scene, rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = scene.window[1] - scene.window[0]
    size = (PANEL_HEIGHT * float(width / height) * columns + 0.4, (PANEL_HEIGHT + 0.45) * rows + 0.7)
    figure = Figure(figsize=size, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()  # until something is drawn on it
    return figure, [list(row) for row in axes]


def _frame(ax: Axes, window: Window, title: str, note: str) -> None:
    ax.set_axis_on()
    ax.set_aspect("equal")
    (x, y), (x_end, y_end) = window
    ax.set_xlim(x, x_end)
    ax.set_ylim(y, y_end)
    ax.set_autoscale_on(False)
    ax.grid(color="#E6E8EB", lw=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=7, color="#B8BEC5", labelcolor="#57606A", length=2.5)
    for spine in ax.spines.values():
        spine.set_color("#B8BEC5")
    ax.set_title(title, loc="left", fontsize=10.5, fontweight="bold", color=INK, pad=17, parse_math=False)
    ax.annotate(note, (0, 1), (0, 4), xycoords="axes fraction", textcoords="offset points", fontsize=8, color="#57606A", va="bottom")


def _finish(figure: Figure, pair: ScanPair) -> Figure:
    """Adds the pair's name and one legend for all panels."""
    name = pair.name or pair.sequence or "scan pair"
    counts = f"{len(pair.source)} and {len(pair.target)} returns, {pair.dt:.3g} s apart; x ahead, y left, metres"
    figure.suptitle(f"{name}: {counts}", x=0.008, ha="left", fontsize=11.5, color=INK, parse_math=False)
    entries = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        figure.legend(
            list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries), frameon=False, fontsize=8.5, markerscale=1.4
        )
    return figure


def _ego_motion(background: Floats) -> str:
    if not np.isfinite(background).all():
        return "sensor's motion unknown"
    theta, x, y = se2.inverse(background)
    return f"sensor: dx {x:+.2f} m, dy {y:+.2f} m, d\N{GREEK SMALL LETTER THETA} {np.degrees(theta):+.1f}\N{DEGREE SIGN}"


def _mistakes(wrong: Bools | None, scene: _Scene) -> str:
    if wrong is None:
        return ""
    judged = int((np.isfinite(scene.source[:, 0]) & ~scene.faint).sum())
    return f"; {int(wrong.sum())} of {judged} points wrong"
