"""`torchcrf-scan run`: everything that can be known of recordings, without any preparation."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from torchcrf_scan.commands.arguments import make_folder
from torchcrf_scan.commands.failures import one_line
from torchcrf_scan.commands.outputs import Output, clean_log, movie_file, poses_file, summary_picture, tracks_file, viewers
from torchcrf_scan.commands.recording import Options, Stream, log_name, process
from torchcrf_scan.commands.stopping import INTERRUPTED, Stopping
from torchcrf_scan.pretrained import PRETRAINED


def run(
    logs: list[str],
    output: str,
    *,
    every: int = 1,
    start: float = 0.0,
    end: float | None = None,
    topic: str | None = None,
    model: str = PRETRAINED,
    device: str = "cpu",
    threads: int | None = None,
    use_odometry: bool = False,
    clean: bool = False,
    frame: Literal["world", "sensor"] = "world",
    speed: float = 1.0,
    visualize: bool = False,
    rerun: str | None = None,
) -> int:
    """Finds the sensor's path and the moving objects of logs: poses.tum, tracks.csv, summary.png and movie.mp4 in OUTPUT.

    Of several logs each has a folder of its own in OUTPUT, named like the log; `torchrun --nproc-per-node N -m torchcrf_scan run
    LOG ...` deals them out to N processes. A log with a fault gives everything up to there, and does not stop the others.
    Without the extra `movie` the movie is a short GIF.

    Args:
        logs: recordings
        output: folder of the files, created if necessary; earlier ones of the same names are replaced
        every: takes each N-th scan only
        start: seconds after the first scan at which to begin
        end: seconds after the first scan at which to end
        topic: topic of the scans in a bag that has several
        model: folder of a saved model, or the name of one that the package ships
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; by default its own choice
        use_odometry: begins each search at the motion that the log's odometry tells
        clean: also writes the log again without the beams that hit moving objects
        frame: what stands still in the movie, world or sensor
        speed: of the movie, as a multiple of the recording's own
        visualize: shows everything in the viewer of rerun while it is computed
        rerun: file (.rrd) for that viewer to write
    """
    options = Options(every, start, end, topic, model, device, threads, use_odometry, visualize, rerun)
    folders = _folders(logs, Path(output))
    if rerun is not None and len(logs) > 1:
        raise ValueError(f"--rerun: expected one log, got {len(logs)}")
