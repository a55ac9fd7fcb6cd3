"""What is made of a stream's results: files, pictures, a viewer. Each is a context that yields a function of one result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType

from torchcrf_scan.data.track_file import writing_tracks
from torchcrf_scan.data.trajectory_file import writing_trajectory
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import ScanResult
from torchcrf_scan.safe_names import one_line

Add = Callable[[ScanResult], None]
Output = AbstractContextManager[Add]


class Outputs:
    """Several outputs by name. One that fails is given up, with the reason added to `failures`; the others go on."""

    def __init__(self, outputs: Mapping[str, Output], failures: list[str]) -> None:
        self._outputs, self._failures = outputs, failures
        self._open: dict[str, tuple[Output, Add]] = {}

    def __enter__(self) -> Add:
        for name, output in self._outputs.items():
            try:
                self._open[name] = (output, output.__enter__())
            except (ValueError, OSError) as error:
                self._failures.append(f"{name}: {one_line(error)}")
        return self._add

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for name in list(self._open):
            self._end(name, kind, error, trace)

    def _add(self, result: ScanResult) -> None:
        for name, (_, add) in list(self._open.items()):
            try:
                add(result)
            except (ValueError, OSError) as error:
                self._failures.append(f"{name}: {one_line(error)}")
                self._end(name, *sys.exc_info())

    def _end(self, name: str, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Ends an output, properly if there was no error; its own error is not raised again."""
        output, _ = self._open.pop(name)
        try:
            output.__exit__(kind, error, trace)
        except (ValueError, OSError) as failure:
            if failure is not error:
                self._failures.append(f"{name}: {one_line(failure)}")


@contextmanager
def poses_file(path: Path) -> Iterator[Add]:
    """A trajectory in TUM's format."""
    with writing_trajectory(path) as write:
        yield lambda result: write(result.stamp, result.pose)


@contextmanager
def tracks_file(path: Path) -> Iterator[Add]:
    """The objects of every scan."""
    with writing_tracks(path) as write:
        yield lambda result: write(result.stamp, result.objects)


@contextmanager
def movie_file(path: Path, seconds: float, speed: float, is_in_world: bool) -> Iterator[Add]:
    """A movie of scans `seconds` apart, shown at `speed` times their own."""
    from torchcrf_scan.viz.frames import SIZE, FramePainter
    from torchcrf_scan.viz.movie import pace, writing_movie

    rate, every = pace(seconds, speed)
    painter, count = FramePainter(SIZE, in_world=is_in_world), 0
    with writing_movie(path, SIZE, rate) as write:

        def add(result: ScanResult) -> None:
            nonlocal count
            painter.add(result)
            if count % every == 0:
                write(painter.draw())
            count += 1

        yield add


def check_speed(speed: float) -> None:
    """Raises TorchCRFScanError for a speed that a movie cannot have."""
    if not 0 < speed < float("inf"):
        raise TorchCRFScanError(f"--speed: expected more than 0 times the recording's own, got {speed}")


@contextmanager
def summary_picture(path: Path, name: str) -> Iterator[Add]:
    """A picture of the whole recording."""
    from torchcrf_scan.viz.plots import save_figure
    from torchcrf_scan.viz.summary import Summary

    summary = Summary()
    yield summary.add
    if summary.tally.scans:
        save_figure(summary.plot(name), path)


def viewers(visualize: bool, rerun: str | None) -> dict[str, Output]:
    """The viewer's window and file, as far as they are asked for; raises TorchCRFScanError where it is not installed."""
    from torchcrf_scan.viz.viewer import check_viewer, showing, writing_rerun

    found: dict[str, Output] = {}
    if visualize:
        check_viewer("--visualize")
        found["--visualize"] = showing()
    if rerun is not None:
        check_viewer("--rerun")
        found["--rerun"] = writing_rerun(Path(rerun))
    return found
