"""`torchcrf-scan run`: the sensor's path, the moving objects, pictures and movies of recordings."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

from torchcrf_scan.commands.apart import Apart
from torchcrf_scan.commands.arguments import check_other
from torchcrf_scan.commands.outputs import Output, check_speed, movie_file, poses_file, summary_picture, tracks_file, viewers
from torchcrf_scan.commands.recording import DEFAULTS, MakeOutputs, Options, process
from torchcrf_scan.commands.stopping import Stopping
from torchcrf_scan.data.clean_log import clean_name, writing_clean
from torchcrf_scan.data.recording import log_name
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.learning.ranks import join
from torchcrf_scan.result import Stream
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.whole_file import make_folder


def run(
    logs: list[str],
    output: str,
    options: Options = DEFAULTS,
    *,
    clean: bool = False,
    frame: Literal["world", "sensor"] = "world",
    speed: float = 1.0,
) -> int:
    """Finds the sensor's path and the moving objects of logs: poses.tum, tracks.csv, summary.png and movie.mp4 in OUTPUT.

    Of several logs each gets a folder in OUTPUT, named like the log, and `torchrun --nproc-per-node N -m torchcrf_scan run LOG
    ...` deals them out to N processes. A damaged log gives everything before its fault; a bad scan is left out and counted.
    Without the extra `movie` there is a short movie.gif instead.

    Args:
        logs: recordings
        output: folder of the files, created if necessary; earlier ones of the same names are replaced
        options: of reading and processing
        clean: also writes the log again without the beams that hit moving objects, and a bag with the odometry found
        frame: what stands still in the movie, world or sensor
        speed: of the movie, as a multiple of the log's own
    """
    folders = _folders(logs, Path(output))
    check_speed(speed)
    if options.rerun is not None and len(logs) > 1:
        raise TorchCRFScanError(f"--rerun: expected one log to write {options.rerun} of, got {len(logs)}")
    if clean and options.every > 1:
        raise TorchCRFScanError(f"--clean: expected every scan to be taken, got --every {options.every}")
    viewers(options.visualize, options.rerun)  # an error now, not after the first scans
    make_stream = options.make_stream()
    failures: list[str] = []
    with join("cpu") as ranks, Stopping() as stopping:
        for log, folder in list(folders.items())[ranks.rank :: ranks.world]:
            if not stopping.is_asked:
                make = partial(_outputs, Path(log), folder, options, clean, frame == "world", speed)
                failures += _run_one(log, folder, options, make_stream(), make, stopping, ranks.rank)
        everyone = [failure for part in ranks.gather(failures) for failure in part]
        is_first = ranks.is_first
    for failure in everyone if is_first else []:
        print(f"torchcrf-scan run: error: {failure}", file=sys.stderr)
    return stopping.code or (1 if everyone else 0)


def _folders(logs: Sequence[str], output: Path) -> dict[str, Path]:
    """The folder of every log; raises TorchCRFScanError for two logs of the same name."""
    if len(logs) == 1:
        return {logs[0]: output}
    folders = {log: output / log_name(Path(log)) for log in logs}
    if len(set(folders.values())) < len(logs):
        raise TorchCRFScanError(f"logs: expected logs whose names differ, got {', '.join(logs)}")
    return folders


def _outputs(
    log: Path, folder: Path, options: Options, clean: bool, is_in_world: bool, speed: float, seconds: float
) -> Mapping[str, Output]:
    """All that is made of a log whose scans are `seconds` apart."""
    from torchcrf_scan.viz.movie import can_write_mp4

    make_folder("--output", folder)
    names = ("poses.tum", "tracks.csv", "summary.png", "movie.mp4", "movie.gif")
    for name in (*names, clean_name(log)) if clean else names:
        check_other("--output", folder / name, log)
    if options.rerun is not None:
        check_other("--rerun", options.rerun, log)
    movie = folder / ("movie.mp4" if can_write_mp4() else "movie.gif")
    outputs: dict[str, Output] = {
        "poses.tum": poses_file(folder / "poses.tum"),
        "tracks.csv": tracks_file(folder / "tracks.csv"),
        "summary.png": summary_picture(folder / "summary.png", log_name(log)),
        movie.name: Apart(movie_file, movie, seconds, speed, is_in_world),
        **viewers(options.visualize, options.rerun),
    }
    if clean:
        outputs["--clean"] = writing_clean(log, folder / clean_name(log), options.reading)
    return outputs


def _run_one(
    log: str, folder: Path, options: Options, stream: Stream, make: MakeOutputs, stopping: Stopping, position: int
) -> list[str]:
    """Makes everything of one log, and says so; returns what went wrong."""
    try:
        report = process(log, options, stream, make, stopping, position)
    except (ValueError, OSError) as error:
        return [one_line(error)]
    print(f"{log}: {report.describe()}; in {folder}", flush=True)
    return report.failures
