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
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SOURCE, TARGET = "#4F7396", "#F28E2B"
STATIC, INK, NOTE, WRONG = "#A3A9B0", "#1F2328", "#57606A", "#C1121F"
MOVERS = ("#009E73", "#CC5FA6", "#0072B2", "#D55E00", "#6F4E9C", "#35A7DB")  # after Okabe and Ito, told apart by the colour-blind
MARKERS = "osD^v"  # the second six movers wear the second marker, and so on
FAINT = 0.22  # opacity of what nobody annotated
ASSOCIATION_TOLERANCE = 2  # beams: an association this near is drawn as right
HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # seconds of travel that an arrow may stand for
MAX_SPEED_LABELS = 10  # the largest movers, more would cover the picture
PANEL_HEIGHT = 3.3  # inches
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
    arrow_seconds: float  # of travel, the same for all panels


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
    movers' velocities and the sensor's motion; the largest mover magnified. Rows and columns without content are left out.

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
    centroids = [_centroid(source, labels.cluster == k) for labels in answers[:1] for k in labels.movers]
    window = _robust_window(np.concatenate([source, target]), np.reshape(centroids, (-1, 2)))
    zooms = (_zoom_window(source, target, labels, window) for labels in answers)
    zoom = next((zoom for zoom in zooms if zoom is not None), None)
    speeds = [[float(np.hypot(*v)) for _, v in _velocities(source, pair.dt, labels).values()] for labels in answers]
    seconds = _horizon([max(fastest) for fastest in speeds if fastest], window)
    return _Scene(source, target, pair.dt, faint, window, zoom, seconds)


def _velocities(source: Floats, dt: float, labels: _Labels) -> dict[int, tuple[Floats, Floats]]:
    """Mover -> its centroid and its velocity relative to the world in the source frame, (2,) each, where both are known."""
    if not (np.isfinite(dt) and dt > 0.0):
        return {}
    from_target = se2.inverse(labels.motion(BACKGROUND))
    known = {}
    for k in labels.movers.tolist():
        centroid = _centroid(source, labels.cluster == k)
        end = se2.apply(se2.compose(from_target, labels.motion(k)), centroid[None])[0]
        if np.isfinite(end).all():
            known[k] = (centroid, (end - centroid) / dt)
    return known


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
    """Holds the sensor, 96 % of the points per axis and the `always` ones, with a margin; aspect between 0.85 and 1.4."""
    points, always = points[np.isfinite(points).all(axis=-1)], always[np.isfinite(always).all(axis=-1)]
    bulk = np.percentile(points, (2, 98), axis=0) if len(points) else np.zeros((1, 2))
    corners = np.concatenate([bulk, always, np.zeros((1, 2))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(1.16 * (high - low), max(0.1 * float((high - low).max()), 0.5))
    size = np.maximum(size, [0.85 * size[1], size[0] / 1.4])
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
    scale = float(np.clip((1.35 * (high - low) / full).max(), 0.03, 1.0))
    return _box((low + high) / 2, scale * full)


def _box(centre: Floats, size: Floats) -> Window:
    return centre - size / 2, centre + size / 2


# Panels


def _draw_scans(ax: Axes, scene: _Scene) -> None:
    _frame(ax, scene.window, "both scans", "each in its own sensor's frame")
    _dots(ax, scene.target, TARGET, "target scan", size=3.0)
    _dots(ax, scene.source, SOURCE, "source scan", size=3.0)
    _sensor(ax, np.zeros(2), INK)


def _draw_registered(ax: Axes, scene: _Scene, answer: _Answer) -> None:
    """Both scans in the target's frame: what is static coincides, what moves stands apart."""
    background = answer.labels.motion(BACKGROUND)
    _frame(ax, scene.window, "sensor's motion undone", f"source moved by the {answer.name} background motion")
    _dots(ax, scene.target, TARGET, "target scan", size=3.0)
    if np.isfinite(background).all():
        _dots(ax, se2.apply(background, scene.source), SOURCE, "source scan", size=3.0)
        _sensor(ax, background[1:], SOURCE)
    _sensor(ax, np.zeros(2), TARGET)


def _draw_associations(ax: Axes, scene: _Scene, answer: _Answer, title: str) -> None:
    outliers = int((np.isfinite(scene.source[:, 0]) & (answer.labels.association < 0)).sum())
    _frame(ax, scene.window, title, f"{outliers} outliers", _mistakes(answer.wrong_association, scene))
    _associations(ax, scene, answer, size=2.4)
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
    _frame(ax, scene.window, title, _ego_motion(labels.motion(BACKGROUND)), _mistakes(answer.wrong_cluster, scene))
    static = labels.cluster == BACKGROUND
    _dots(ax, scene.source, STATIC, "background", static, scene.faint, size=3.0)
    for index, k in enumerate(labels.movers.tolist()):
        color, marker = _look(k)
        name = "" if index else "mover, with its speed"
        _dots(ax, scene.source, color, name, labels.cluster == k, scene.faint, size=4.6, marker=marker)
    _outliers(ax, scene, labels.cluster == OUTLIER, size=3.6)
    _rings(ax, scene, answer.wrong_cluster, size=6.5)
    _arrows(ax, scene, labels)
    _sensor(ax, np.zeros(2), INK)


def _associations(ax: Axes, scene: _Scene, answer: _Answer, size: float) -> None:
    labels = answer.labels
    associated = labels.association >= 0
    _dots(ax, scene.target, TARGET, "target scan", size=size)
    for k in np.unique(labels.cluster[associated]).tolist():
        _lines(ax, scene, labels, associated & (labels.cluster == k), k, width=0.5 + 0.12 * size)
    _dots(ax, scene.source, SOURCE, "source scan", associated, scene.faint, size=size)
    _outliers(ax, scene, ~associated, size=1.6 + 0.8 * size)
    _rings(ax, scene, answer.wrong_association, size=4.5 + size)


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
        points = scene.source[mask].T
        ax.plot(*points, ls="", marker="o", ms=size, mfc="none", mec=WRONG, mew=0.9, label="predicted wrong", zorder=4)


def _lines(ax: Axes, scene: _Scene, labels: _Labels, mask: Bools, cluster: int, width: float) -> None:
    """Lines from source points to their target points, in the cluster's colour; one artist, broken by NaN."""
    color = NOTE if cluster <= BACKGROUND else _look(cluster)[0]
    for part, alpha in _by_opacity(mask, scene.faint):
        ends = np.stack([scene.source[part], scene.target[labels.association[part]]], axis=1)  # (n, 2 ends, 2)
        path = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        name = "association" if cluster <= BACKGROUND and alpha == 1.0 else ""
        ax.plot(*path.T, color=color, lw=width, alpha=0.75 * alpha, label=name, zorder=2)


def _arrows(ax: Axes, scene: _Scene, labels: _Labels) -> None:
    """Arrows and speeds of the movers whose motion is known."""
    known = _velocities(scene.source, scene.dt, labels)
    if not known:
        return
    centroids, velocities = np.stack([c for c, _ in known.values()]), np.stack([v for _, v in known.values()])
    ax.quiver(
        *centroids.T, *(scene.arrow_seconds * velocities).T, color=[_look(k)[0] for k in known], angles="xy", scale_units="xy",
        scale=1, units="inches", width=0.03, edgecolor="white", linewidth=0.4, minshaft=1.5, zorder=6,
    )  # fmt: skip
    largest = sorted(known, key=lambda k: -int((labels.cluster == k).sum()))[:MAX_SPEED_LABELS]
    for k in largest:
        centroid, velocity = known[k]
        _speed_label(ax, scene, centroid + scene.arrow_seconds * velocity, velocity, _look(k)[0])
    note = f"arrow: {scene.arrow_seconds:g} s of travel"
    ax.text(0.985, 0.015, note, transform=ax.transAxes, ha="right", va="bottom", fontsize=8, color=NOTE, zorder=7)


def _speed_label(ax: Axes, scene: _Scene, tip: Floats, velocity: Floats, color: str) -> None:
    """Writes the speed at the arrow's tip, inside the picture even where the tip is not."""
    low, high = scene.window
    place = np.clip((tip - low) / (high - low), 0.02, 0.95)
    side = "left" if place[0] < 0.15 else "right" if place[0] > 0.85 else "center"
    speed, up = float(np.hypot(*velocity)), velocity[1] >= 0.0 and place[1] < 0.9
    x, y = (low + place * (high - low)).tolist()
    ax.annotate(
        f"{speed:.2f} m/s" if speed < 10.0 else f"{speed:.1f} m/s", (x, y), (0, 5 if up else -5), textcoords="offset points",
        ha=side, va="bottom" if up else "top", fontsize=9, fontweight="bold", color=color,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6}, in_layout=False, zorder=7,
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


def _frame(ax: Axes, window: Window, title: str, note: str, mistakes: str = "") -> None:
    ax.set_axis_on()
    ax.set_aspect("equal")
    (x, y), (x_end, y_end) = window
    ax.set_xlim(x, x_end)
    ax.set_ylim(y, y_end)
    ax.set_autoscale_on(False)
    ax.grid(color="#E6E8EB", lw=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=7, color="#B8BEC5", labelcolor=NOTE, length=2.5)
    for spine in ax.spines.values():
        spine.set_color("#B8BEC5")
    ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK, pad=19, parse_math=False)
    ax.set_title(mistakes, loc="right", fontsize=9, color=WRONG, pad=19)
    ax.text(0.0, 1.015, note, transform=ax.transAxes, fontsize=8.5, color=NOTE, va="bottom", in_layout=False)


def _finish(figure: Figure, pair: ScanPair) -> Figure:
    """Adds the pair's name and one legend for all panels."""
    name = pair.name or pair.sequence or "scan pair"
    counts = f"{len(pair.source)} and {len(pair.target)} returns, {pair.dt:.3g} s apart; x ahead, y left, metres"
    figure.suptitle(f"{name}: {counts}", x=0.008, ha="left", fontsize=11.5, color=INK, parse_math=False)
    entries: dict[str, Artist] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        columns = len(entries) if figure.get_figwidth() > 8.0 else 3
        handles, labels = list(entries.values()), list(entries)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, markerscale=1.4)
    return figure


def _ego_motion(background: Floats) -> str:
    if not np.isfinite(background).all():
        return "sensor's motion unknown"
    theta, x, y = se2.inverse(background)
    dx, dy, degrees = round(x, 2) + 0.0, round(y, 2) + 0.0, round(float(np.degrees(theta)), 1) + 0.0  # + 0.0: never -0.00
    return f"sensor: dx {dx:+.2f} m, dy {dy:+.2f} m, d\N{GREEK SMALL LETTER THETA} {degrees:+.1f}\N{DEGREE SIGN}"


def _mistakes(wrong: Bools | None, scene: _Scene) -> str:
    if wrong is None:
        return ""
    judged = int((np.isfinite(scene.source[:, 0]) & ~scene.faint).sum())
    return f"{int(wrong.sum())} of {judged} wrong"
