"""What is known after each scan, for the viewer of rerun: live in its window, or in a file (.rrd) for later.

What is sent to a viewer waits for it without limit once rerun's buffers are full. So it is sent by a process of its own, and what
that does not take in time is left out: a viewer that is slow, stuck or closed neither slows nor stops the run.
"""

from __future__ import annotations

import multiprocessing
import queue
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.result import ScanResult
from torchcrf_scan.scan import BACKGROUND, Bools, Floats
from torchcrf_scan.viz.frames import MAP, SEEN, UNSURE
from torchcrf_scan.viz.marks import INK, mover_look
from torchcrf_scan.whole_file import whole_file

if TYPE_CHECKING:
    from rerun import RecordingStream

LEVELS = {"ok": "INFO", "degenerate": "WARN", "lost": "ERROR"}
WAITING = 300  # results that wait for the viewer at most
PATIENCE = 3.0  # seconds that the end of a run waits for it
MAP_SECONDS = 30.0  # of static points that the viewer shows

Show = Callable[[ScanResult], None]


def check_viewer(option: str) -> None:
    """Raises TorchCRFScanError if the extra `viewer` is not installed."""
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise TorchCRFScanError(f"{option}: expected the extra torchcrf-scan[viewer] to be installed, got {error}") from error


@contextmanager
def writing_rerun(path: Path) -> Iterator[Show]:
    """A file for the viewer; there when the block ends, and only if it ends without error. Raises OSError on a full disk."""
    from rerun import binary_stream

    with whole_file(path) as file:
        stream = _new_stream()
        content = binary_stream(stream)  # a file written here: rerun's own writer does not tell of a full disk
        stream.send_blueprint(_blueprint(), make_active=False)
        log = ResultLog(stream)

        def show(result: ScanResult) -> None:
            log.add(result)
            file.write(content.read() or b"")

        yield show
        file.write(content.read() or b"")


@contextmanager
def showing(address: str | None = None) -> Iterator[Show]:
    """A viewer in a window of its own, or the one at an address (`rerun+http://host:port/proxy`)."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue(WAITING)
    process = context.Process(target=_show, args=(results, address), daemon=True)
    process.start()

    def show(result: ScanResult) -> None:
        if process.is_alive():
            _offer(results, result)

    try:
        yield show
    finally:
        _offer(results, None)
        process.join(PATIENCE)
        process.kill()
        process.join()
        results.close()
        results.cancel_join_thread()


def _offer(results: Any, item: ScanResult | None) -> None:
    try:
        results.put_nowait(item)
    except queue.Full:
        return


def _show(results: Any, address: str | None) -> None:
    """The process that sends results to the viewer until None comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the run's; it ends us
    stream = _new_stream()
    if address is None:
        stream.spawn(default_blueprint=_blueprint())
    else:
        stream.connect_grpc(address, default_blueprint=_blueprint())
    log = ResultLog(stream)
    while (result := results.get()) is not None:
        log.add(result)
    stream.flush(timeout_sec=PATIENCE)


class ResultLog:
    """Logs results to a stream of rerun; the plane is z = 0, x and y are the world's."""

    def __init__(self, stream: RecordingStream) -> None:
        self._stream = stream
        self._begin: float | None = None
        self._count = 0
        self._last: tuple[Floats, str] = np.zeros(2), ""

    def add(self, result: ScanResult) -> None:
        """Logs one result."""
        self._begin = result.stamp if self._begin is None else self._begin
        self._stream.set_time("scan", sequence=self._count)
        self._stream.set_time("time", duration=result.stamp - self._begin)
        self._log_points(result)
        self._log_objects(result)
        self._log_sensor(result)
        self._count += 1

    def _log_points(self, result: ScanResult) -> None:
        import rerun

        scan = result.scan
        points, track = se2.apply(result.pose, scan.points), result.track[scan.beam]
        moving = result.moving[scan.beam]
        groups: dict[str, tuple[Bools, str]] = {
            "static": (~moving & (track == BACKGROUND), SEEN),
            "unmatched": (~moving & (track != BACKGROUND), MAP),
        }
        for name, (mask, color) in groups.items():
            self._log(f"world/{name}", rerun.Points3D(_raised(points[mask]), colors=[_rgb(color)], radii=-1.5))
        colors = [_rgb(mover_look(number)[0] if number > BACKGROUND else UNSURE) for number in track[moving].tolist()]
        self._log("world/moving", rerun.Points3D(_raised(points[moving]), colors=colors or None, radii=-3.0))

    def _log_objects(self, result: ScanResult) -> None:
        import rerun

        objects = result.objects
        places = _raised(np.array([one.position for one in objects]).reshape(-1, 2))
        colors = [_rgb(mover_look(one.number)[0]) for one in objects] or None
        turns = [rerun.RotationAxisAngle(axis=(0, 0, 1), radians=one.heading) for one in objects]
        halves = np.array([(*one.extent, 0.0) for one in objects]).reshape(-1, 3) / 2
        labels = [f"{one.number}: {np.hypot(*one.velocity):.1f} m/s" for one in objects]
        boxes = rerun.Boxes3D(centers=places, half_sizes=halves, rotation_axis_angles=turns or None, colors=colors, labels=labels)
        self._log("world/objects", boxes)
        vectors = _raised(np.array([one.velocity for one in objects]).reshape(-1, 2))
        self._log("world/velocities", rerun.Arrows3D(origins=places, vectors=vectors, colors=colors))

    def _log_sensor(self, result: ScanResult) -> None:
        import rerun

        theta, x, y = result.pose.tolist()
        rotation = rerun.RotationAxisAngle(axis=(0, 0, 1), radians=theta)
        self._log("world/sensor", rerun.Transform3D(translation=(x, y, 0.0), rotation=rotation), rerun.TransformAxes3D(0.5))
        before, status = self._last
        if self._count:
            self._log("world/path", rerun.LineStrips3D([_raised(np.stack([before, result.pose[1:]]))], colors=[_rgb(INK)]))
        said = f"{result.status}: {result.reason}" if result.reason else result.status
        if said != status:
            self._log("status", rerun.TextLog(said, level=LEVELS[result.status]))
        self._log("speed", rerun.Scalars([float(np.hypot(*result.twist[1:]))]))
        self._log("turn", rerun.Scalars([float(np.degrees(result.twist[0]))]))
        self._last = result.pose[1:].copy(), said

    def _log(self, place: str, *what: Any) -> None:
        self._stream.log(place, *what)


def _new_stream() -> RecordingStream:
    from rerun import RecordingStream

    return RecordingStream("torchcrf_scan")


def _blueprint() -> Any:
    """How the viewer begins: the world, and beside it speeds and status."""
    from rerun import TimeRangeBoundary, VisibleTimeRange
    from rerun import blueprint as view

    def since(boundary: Any) -> Any:
        return view.VisibleTimeRanges([VisibleTimeRange("time", start=boundary, end=TimeRangeBoundary.cursor_relative())])

    shown: Any = {
        "world/path": since(TimeRangeBoundary.infinite()),
        "world/static": since(TimeRangeBoundary.cursor_relative(seconds=-MAP_SECONDS)),
    }
    world = view.Spatial3DView(origin="world", name="world", background=(255, 255, 255), overrides=shown)
    speed = view.TimeSeriesView(contents=["speed"], name="speed, m/s")
    turn = view.TimeSeriesView(contents=["turn"], name="turn, deg/s")
    status = view.TextLogView(origin="status", name="status")
    return view.Blueprint(view.Horizontal(world, view.Vertical(speed, turn, status), column_shares=[3, 1]), collapse_panels=True)


def _raised(points: Floats) -> Floats:
    """(N, 3) points of the plane z = 0."""
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(int(color[k : k + 2], 16) for k in (1, 3, 5))
