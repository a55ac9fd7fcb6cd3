"""Frames of a movie: a scan among all that was seen before, with what moves and where to."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import BACKGROUND, Floats
from torchcrf_scan.viz.camera import Camera, nice_step
from torchcrf_scan.viz.canvas import Canvas, Image
from torchcrf_scan.viz.history import Path, StaticMap, static_points
from torchcrf_scan.viz.marks import INK, NOTE, mover_look

SIZE = (800, 600)  # pixels
MAP, GRID, SEEN, UNSURE = "#C9CED5", "#EEF0F2", "#68727D", "#C99700"
STATUS_COLORS = {"ok": "#1A7F37", "degenerate": "#BC6C00", "lost": "#C1121F"}
MAP_POINTS = 8000  # drawn at most
LABELS = 8  # objects with a label at most
ARROW_SECONDS = (2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02)  # of travel
ARROW_SHARE = 0.25  # the longest arrow, of the picture's height
TAIL_SECONDS, TAIL_ROWS = 5.0, 100  # of an object's way behind it
GRID_LINES = 6  # at least, over the height
EDGE = 14  # pixels from the picture's edge to its texts
SHORT, LONGEST = 20, 70  # letters of a status that fits beside the rest, and of any


class FramePainter:
    """Draws the results of a recording, each over what came before.

    Args:
        size: (width, height) in pixels.
        in_world: the world stands still and the sensor moves; otherwise the sensor stands still.
    """

    def __init__(self, size: tuple[int, int] = SIZE, *, in_world: bool = True) -> None:
        self._canvas, self._camera = Canvas(size), Camera(size[0] / size[1])
        self._in_world = in_world
        self._map, self._path = StaticMap(), Path(3)
        self._tails: dict[int, list[tuple[float, float, float]]] = {}
        self._now: ScanResult | None = None
        self._begin = 0.0
        self._arrow = 0  # index in ARROW_SECONDS
        self._count = 0

    def add(self, result: ScanResult) -> None:
        """Remembers a result; to be called with each in their order, whether it is drawn or not."""
        self._begin = result.stamp if self._now is None else self._begin
        self._now = result
        self._count += 1
        self._map.add_scan(result)
        self._path.add(*result.pose)
        self._lengthen_tails(result)
        view = np.zeros(3) if self._in_world else se2.inverse(result.pose)
        sensor = se2.compose(view, result.pose)
        self._camera.follow(se2.apply(sensor, static_points(result)), sensor[1:])
        height = float(np.diff(np.stack(self._camera.window)[:, 1], axis=0)[0])
        fastest = max((float(np.hypot(*one.velocity)) for one in result.objects), default=0.0)
        while self._arrow + 1 < len(ARROW_SECONDS) and fastest * ARROW_SECONDS[self._arrow] > ARROW_SHARE * height:
            self._arrow += 1

    def draw(self) -> Image:
        """(height, width, 3) the picture of the result that was added last."""
        assert self._now is not None
        result = self._now
        view = np.zeros(3) if self._in_world else se2.inverse(result.pose)
        self._canvas.begin(self._camera.window)
        self._draw_ground(view)
        self._draw_scan(result, se2.compose(view, result.pose))
        self._draw_objects(result, view)
        self._draw_texts(result)
        return self._canvas.image()

    def _lengthen_tails(self, result: ScanResult) -> None:
        numbers = {one.number for one in result.objects}
        self._tails = {number: tail for number, tail in self._tails.items() if number in numbers}
        for one in result.objects:
            tail = self._tails.setdefault(one.number, [])
            tail.append((result.stamp, float(one.position[0]), float(one.position[1])))
            while len(tail) > TAIL_ROWS or result.stamp - tail[0][0] > TAIL_SECONDS:
                tail.pop(0)

    def _draw_ground(self, view: Floats) -> None:
        """The grid, the map and the sensor's path."""
        low, high = self._camera.window
        step = nice_step(float(high[1] - low[1]) / GRID_LINES)
        self._canvas.lines(_grid(low, high, step), GRID, 0.8)
        points = se2.apply(view, self._map.points())
        points = points[((points > low) & (points < high)).all(axis=1)]
        self._canvas.dots(points[:: 1 + len(points) // MAP_POINTS], MAP, 1.7, "s")
        path = se2.apply(view, self._path.rows[:, 1:])
        self._canvas.lines([path] if len(path) > 1 else [], INK, 1.3, 0.55)

    def _draw_scan(self, result: ScanResult, sensor: Floats) -> None:
        """The scan's points and the sensor."""
        scan = result.scan
        points, track = se2.apply(sensor, scan.points), result.track[scan.beam]
        moving = result.moving[scan.beam]
        self._canvas.dots(points[~moving], SEEN, 2.4)
        self._canvas.dots(points[moving & (track <= BACKGROUND)], UNSURE, 4.0)
        for number in np.unique(track[moving & (track > BACKGROUND)]).tolist():
            self._canvas.dots(points[moving & (track == number)], mover_look(number)[0], 4.6)
        low, high = self._camera.window
        self._canvas.shapes([se2.apply(sensor, 0.024 * float(high[1] - low[1]) * SENSOR)], INK)

    def _draw_objects(self, result: ScanResult, view: Floats) -> None:
        """Boxes, tails, arrows and labels of the objects."""
        objects, seconds = result.objects, ARROW_SECONDS[self._arrow]
        low, high = self._camera.window
        width = 0.009 * float(high[1] - low[1])
        colors = [mover_look(one.number)[0] for one in objects]
        tails = [se2.apply(view, np.array(self._tails[one.number])[:, 1:]) for one in objects]
        self._canvas.lines(tails, colors, 1.6, 0.5)
        for seen, style in ((True, "-"), (False, (0, (3, 2)))):
            part = [
                (se2.apply(view, box_of(one)), color)
                for one, color in zip(objects, colors, strict=True)
                if seen == (one.points > 0)
            ]
            self._canvas.lines([box for box, _ in part], [color for _, color in part], 1.4, 0.9, style)
        arrows = [(_arrow(one, seconds, width), color) for one, color in zip(objects, colors, strict=True)]
        drawn = [(se2.apply(view, arrow), color) for arrow, color in arrows if arrow is not None]
        self._canvas.shapes([arrow for arrow, _ in drawn], [color for _, color in drawn])
        for one in sorted(objects, key=lambda one: -one.points)[:LABELS]:
            self._label(one, view)

    def _label(self, one: MovingObject, view: Floats) -> None:
        """An object's number and speed, on the side of its box that it leaves."""
        box = self._canvas.to_pixels(se2.apply(view, box_of(one)))
        goes_up = bool(se2.rotate(view[:1], one.velocity[None])[0, 1] > 0)
        x, y = float(box[:, 0].mean()), float(box[:, 1].min() - 13 if goes_up else box[:, 1].max() + 13)
        width, height = self._canvas.size
        if 0 < x < width and 0 < y < height:
            place = (min(max(x, 45.0), width - 45.0), min(max(y, 50.0), height - 45.0))
            text = f"{one.number}: {np.hypot(*one.velocity):.1f} m/s"
            self._canvas.text(place, text, size=12, color=mover_look(one.number)[0], anchor="mm", bold=True)

    def _draw_texts(self, result: ScanResult) -> None:
        """Time, status, motion of the sensor, and the scale."""
        width, height = self._canvas.size
        top = height - EDGE - 8
        self._canvas.text((EDGE, top), f"{result.stamp - self._begin:.1f} s", size=18, color=INK, anchor="lm", bold=True)
        turn, speed = round(float(np.degrees(result.twist[0]))) + 0, float(np.hypot(*result.twist[1:]))
        about = f"scan {self._count}   sensor {speed:.1f} m/s, {turn:+d} deg/s   {len(result.objects)} moving"
        self._canvas.text((EDGE + 95, top), about, size=13, color=NOTE, anchor="lm")
        status = result.status if result.status == "ok" else f"{result.status}: {result.reason}"
        box = STATUS_COLORS[result.status]
        place = (width - EDGE - 4, top) if len(status) < SHORT else (width - EDGE - 4, top - 28)
        self._canvas.text(place, _short(status), size=13, color="white", anchor="rm", bold=True, box=box)
        self._draw_scale()

    def _draw_scale(self) -> None:
        low, high = self._camera.window
        metres_per_pixel = float((high[0] - low[0]) / self._canvas.size[0])
        step = nice_step(120 * metres_per_pixel)
        bar = np.array([[0, 0.4], [0, 0], [1, 0], [1, 0.4]]) * (step, 14 * metres_per_pixel)
        self._canvas.lines([low + metres_per_pixel * EDGE + bar], INK, 1.6)
        notes = f"{step:g} m" + (f"   arrows: {ARROW_SECONDS[self._arrow]:g} s of travel" if self._tails else "")
        self._canvas.text((EDGE + 1, EDGE + 10), notes, size=12, color=NOTE)


SENSOR = np.array([[1.0, 0.0], [-0.7, 0.65], [-0.4, 0.0], [-0.7, -0.65]])


def box_of(one: MovingObject) -> Floats:
    """(5, 2) the closed outline of an object's extent, in the world."""
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) / 2 * np.array(one.extent)
    return se2.apply(np.array([one.heading, *one.position]), half)


def _arrow(one: MovingObject, seconds: float, width: float) -> Floats | None:
    """(7, 2) the outline of an arrow along the way that an object goes in some seconds; None if that is less than its width."""
    length = seconds * float(np.hypot(*one.velocity))
    if length < 2 * width:
        return None
    head = min(3.2 * width, 0.6 * length)
    outline = np.array(
        [[0, 0.5], [length - head, 0.5], [length - head, 1.5], [length, 0], [length - head, -1.5], [length - head, -0.5], [0, -0.5]]
    )
    direction = float(np.arctan2(one.velocity[1], one.velocity[0]))
    return se2.apply(np.array([direction, *one.position]), outline * (1.0, width))


def _grid(low: Floats, high: Floats, step: float) -> list[Floats]:
    """The lines of a grid that cross a window."""
    xs, ys = (step * np.arange(np.ceil(a / step), np.floor(b / step) + 1) for a, b in zip(low, high, strict=True))
    return [np.array([[x, low[1]], [x, high[1]]]) for x in xs] + [np.array([[low[0], y], [high[0], y]]) for y in ys]


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
