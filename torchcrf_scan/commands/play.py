"""`torchcrf-scan play`: a recording as a movie."""

from __future__ import annotations

from typing import Literal

from torchcrf_scan.commands.arguments import check_output, make_folder
from torchcrf_scan.commands.recording import Options, process_one
from torchcrf_scan.pretrained import PRETRAINED


def play(
    log: str,
    output: str,
    *,
    every: int = 1,
    start: float = 0.0,
    end: float | None = None,
    topic: str | None = None,
    odometry: str | None = None,
    no_return: float | None = None,
    model: str = PRETRAINED,
    device: str = "cpu",
    threads: int = 1,
    use_odometry: bool = False,
    frame: Literal["world", "sensor"] = "world",
    speed: float = 1.0,
    visualize: bool = False,
    rerun: str | None = None,
) -> int:
    """Draws a log as a movie: scans, the map so far, what moves with numbers and velocities, and the sensor's path.

    MP4 needs the extra `movie`. A GIF has at most 400 pictures; of more scans it shows every second, fourth ... one.

    Args:
        log: recording
        output: movie to write, .mp4 or .gif
        every: takes each N-th scan only
        start: seconds after the first scan at which to begin
        end: seconds after the first scan at which to end
        topic: topic of the scans in a bag, if there are several; of a CARMEN log the kind of lines, e.g. RLASER
        odometry: topic of odometry in a bag that has several, to be used
        no_return: readings in metres from there on mean that nothing came back; by default as the log says or shows
        model: folder of a saved model, or the name of one that the package ships
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; scans come one after the other, so more only wait for each other
        use_odometry: takes the log's odometry as the first guess of the sensor's motion
        frame: what stands still, world or sensor
        speed: of the movie, as a multiple of the log's own
        visualize: shows everything in the viewer of rerun while it is computed
        rerun: file (.rrd) to write for that viewer
    """
    from torchcrf_scan.commands.apart import Apart
    from torchcrf_scan.commands.outputs import check_speed, movie_file
    from torchcrf_scan.viz.movie import check_movie

    options = Options(every, start, end, topic, model, device, threads, use_odometry, odometry, no_return, visualize, rerun)
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
