"""`torchcrf-scan odometry`: the sensor's path of a recording, as TUM lines."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.commands.arguments import check_output, make_folder
from torchcrf_scan.commands.recording import Options, process_one
from torchcrf_scan.pretrained import PRETRAINED


def odometry(
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
    visualize: bool = False,
    rerun: str | None = None,
) -> int:
    """Finds the sensor's path of a log, in the frame of its first scan, as TUM lines (stamp x y z qx qy qz qw).

    A damaged log gives everything before its fault; a bad scan is left out and counted.

    Args:
        log: recording
        output: file to write, e.g. poses.tum
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
        visualize: shows everything in the viewer of rerun while it is computed
        rerun: file (.rrd) to write for that viewer
    """
    from torchcrf_scan.commands.outputs import poses_file

    options = Options(every, start, end, topic, model, device, threads, use_odometry, odometry, no_return, visualize, rerun)
    check_output(output, log)
    make_folder("--output", Path(output).parent)
    return process_one("odometry", log, options, lambda _: {output: poses_file(Path(output))}, f"path in {output}")
