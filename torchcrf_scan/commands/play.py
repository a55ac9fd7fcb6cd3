"""`torchcrf-scan play`: a recording as a movie."""

from __future__ import annotations

from typing import Literal

from torchcrf_scan.commands.arguments import check_output
from torchcrf_scan.commands.recording import DEFAULTS, Options, process_one
from torchcrf_scan.whole_file import make_folder


def play(
    log: str,
    output: str,
    options: Options = DEFAULTS,
    *,
    frame: Literal["world", "sensor"] = "world",
    speed: float = 1.0,
) -> int:
    """Draws a log as a movie: scans, the map so far, what moves with numbers and velocities, and the sensor's path.

    MP4 needs the extra `movie`. A GIF has at most 400 pictures; of more scans it shows every second, fourth ... one.

    Args:
        log: recording
        output: movie to write, .mp4 or .gif
        options: of reading and processing
        frame: what stands still, world or sensor
        speed: of the movie, as a multiple of the log's own
    """
    from torchcrf_scan.commands.apart import Apart
    from torchcrf_scan.commands.outputs import check_speed, movie_file
    from torchcrf_scan.viz.movie import check_movie

    path = check_movie("--output", output)
    check_speed(speed)
    check_output(output, log)
    make_folder("--output", path.parent)
    return process_one(
        "play",
        log,
        options,
        lambda seconds: {output: Apart(movie_file, path, seconds, speed, frame == "world")},
        f"movie in {output}",
    )
