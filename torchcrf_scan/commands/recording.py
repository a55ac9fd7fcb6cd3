"""A recording from its first scan to its last, or to its fault, through a stream and into outputs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from time import perf_counter

import numpy as np
from tqdm import tqdm

from torchcrf_scan.commands.arguments import check_other, load_model
from torchcrf_scan.commands.failures import LeftOut
from torchcrf_scan.commands.outputs import Add, Output, Outputs, viewers
from torchcrf_scan.commands.stopping import Stopping
from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.data.options import AUTO, ReadOptions
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.recording import log_name
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.result import Stream
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.stream.clock import Clock
from torchcrf_scan.stream.stream import ScanStream
from torchcrf_scan.viz.history import Tally

MakeOutputs = Callable[[float], Mapping[str, Output]]  # of the seconds between two scans

LOOK_AHEAD = 21  # readings from whose stamps the time between scans is found
ROUNDING = 1e-6  # seconds; stamps have no more digits
SECONDS = (0.005, 5.0)  # between scans, plausible ones


@dataclass(frozen=True)
class Options:
    """How recordings are read and processed: options that `run`, `odometry`, `track` and `play` share.

    Attributes:
        every: takes each N-th scan only
        start: seconds after the first scan at which to begin
        end: seconds after the first scan at which to end
        topic: topic of the scans in a bag, if there are several; of a CARMEN log the kind of lines, e.g. RLASER
        odometry: topic of odometry in a bag that has several, to be used
        no_return: readings in metres from there on mean that nothing came back; by default as the log says or shows
        model: folder of a saved model, or the name of one that the package ships
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; scans come one after the other, so more only wait for each other
        outlier_distance: metres; points farther from every point of the next scan, under their own motion, are outliers, and no
            others; by default as the model was saved
        use_odometry: takes the log's odometry as the first guess of the sensor's motion
        visualize: shows everything in the viewer of rerun while it is computed
        rerun: file (.rrd) to write for that viewer
    """

    every: int = 1
    start: float = 0.0
    end: float | None = None
    topic: str | None = None
    odometry: str | None = None
    no_return: float | None = None
    model: str = PRETRAINED
    device: str = "cpu"
    threads: int = 1
    outlier_distance: float | None = None
    use_odometry: bool = False
    visualize: bool = False
    rerun: str | None = None

    def __post_init__(self) -> None:
        if self.every < 1:
            raise TorchCRFScanError(f"--every: expected at least 1, got {self.every}")
        if not 0 <= self.start < np.inf:
            raise TorchCRFScanError(f"--start: expected seconds from the first scan on, at least 0, got {self.start}")
        if self.end is not None and not self.end > self.start:
            raise TorchCRFScanError(f"--end: expected more seconds than --start = {self.start}, got {self.end}")

    @property
    def reading(self) -> ReadOptions:
        """The options of the reader."""
        return ReadOptions(self.topic, self.odometry or (AUTO if self.use_odometry else None), self.no_return)

    @property
    def has_odometry(self) -> bool:
        """Whether the recording's odometry is used."""
        return self.use_odometry or self.odometry is not None

    def make_stream(self) -> Callable[[], Stream]:
        """A maker of streams that share one model; raises TorchCRFScanError for a model or device that is not there."""
        model = load_model(self.model, None, self.device, self.threads, self.outlier_distance)
        return lambda: ScanStream(model)


DEFAULTS = Options()


@dataclass
class Report:
    """What became of a recording.

    Attributes:
        tally: counts of its results. left_out: scans and messages that are none.
        failures: what went wrong, one line each. rate: scans a second, until all is written.
    """

    tally: Tally = field(default_factory=Tally)
    left_out: LeftOut = field(default_factory=LeftOut)
    failures: list[str] = field(default_factory=list)
    rate: float = 0.0

    def describe(self) -> str:
        """One line."""
        return f"{self.tally.describe()}; {self.rate:.1f} scans/s{self.left_out}"


def chosen(readings: Iterable[Reading], options: Options) -> Iterator[Reading]:
    """Every N-th reading between two times, seconds after the first one.

    Time is the stream's own: a stamp that goes back or is far off neither drops a reading nor ends the recording.
    """
    clock, count = Clock(warns=False), 0  # the stream warns
    for reading in readings:
        clock.advance(reading.stamp)
        since = clock.elapsed
        if options.end is not None and since > options.end + ROUNDING:
            return
        if since >= options.start - ROUNDING:
            if count % options.every == 0:
                yield reading
            count += 1


def until_fault(readings: Iterator[Reading], failures: list[str]) -> Iterator[Reading]:
    """The readings before a fault, which is added to `failures`."""
    try:
        yield from readings
    except (ValueError, OSError) as error:
        failures.append(one_line(error))


def process(
    log: str,
    options: Options,
    stream: Stream,
    outputs: MakeOutputs,
    stopping: Stopping,
    position: int = 0,
) -> Report:
    """Feeds a recording to a stream and its results to outputs; what came before a fault is processed.

    Args:
        outputs: makes them, once there is a scan.
        position: line of the progress bar.

    Raises:
        TorchCRFScanError: a recording without a scan; then there are no outputs.
    """
    report, told = Report(), options.reading
    topic, odometry, no_return = told.topic, told.odometry, told.no_return
    scans = read_scans(log, topic, odometry=odometry, no_return=no_return, on_bad=report.left_out.add)
    readings = until_fault(chosen(scans, options), report.failures)
    ahead = list(islice(readings, LOOK_AHEAD))
    if not ahead:
        nothing = f"{log}: expected scans in the chosen time, got none"
        raise TorchCRFScanError(next(iter(report.failures), report.left_out.first or nothing))
    if options.has_odometry and all(reading.odometry is None for reading in ahead):
        raise TorchCRFScanError(f"--use_odometry: expected a recording with odometry, got none in {log}")
    begin = perf_counter()
    with (
        Outputs(outputs(typical_seconds(ahead)), report.failures) as add,
        tqdm(unit="scan", desc=log_name(Path(log)), disable=None, position=position, smoothing=0.1) as bar,
    ):
        for reading in chain(ahead, readings):
            _feed(stream, reading, options, add, report)
            bar.update()
            if stopping.is_asked:
                break
    report.rate = report.tally.scans / (perf_counter() - begin)
    return report


def _feed(stream: Stream, reading: Reading, options: Options, add: Add, report: Report) -> None:
    """One reading; a bad one is counted and left out."""
    try:
        result = stream.feed(reading.scan, reading.stamp, reading.odometry if options.has_odometry else None)
    except ValueError as error:
        report.left_out.add(error)
        return
    report.tally.add(result)
    add(result)


def typical_seconds(readings: list[Reading]) -> float:
    """The median time between readings, where it is plausible; 0.1 s otherwise."""
    steps = np.diff([reading.stamp for reading in readings])
    plausible = steps[(steps >= SECONDS[0]) & (steps <= SECONDS[1])]
    return float(np.median(plausible)) if len(plausible) else 0.1


def process_one(command: str, log: str, options: Options, outputs: MakeOutputs, made: str) -> int:
    """Processes one recording for a command, says what was made, and returns the command's exit code."""
    viewers(options.visualize, options.rerun)  # an error now, not after the first scans
    if options.rerun is not None:
        check_other("--rerun", options.rerun, log)
    make_stream = options.make_stream()

    def all_outputs(seconds: float) -> Mapping[str, Output]:
        return {**outputs(seconds), **viewers(options.visualize, options.rerun)}

    with Stopping() as stopping:
        report = process(log, options, make_stream(), all_outputs, stopping)
    print(f"{log}: {report.describe()}; {made}")
    for failure in report.failures:
        print(f"torchcrf-scan {command}: error: {failure}", file=sys.stderr)
    return stopping.code or (1 if report.failures else 0)
