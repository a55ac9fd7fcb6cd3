"""`torchcrf-scan odometry`: the sensor's path of a recording, as TUM lines."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.commands.arguments import check_output
from torchcrf_scan.commands.recording import DEFAULTS, Options, process_one
from torchcrf_scan.whole_file import make_folder


def odometry(log: str, output: str, options: Options = DEFAULTS) -> int:
    """Finds the sensor's path of a log, in the frame of its first scan, as TUM lines (stamp x y z qx qy qz qw).

    A damaged log gives everything before its fault; a bad scan is left out and counted.

    Args:
        log: recording
        output: file to write, e.g. poses.tum
        options: of reading and processing
    """
    from torchcrf_scan.commands.outputs import poses_file

    check_output(output, log)
    make_folder("--output", Path(output).parent)
    return process_one("odometry", log, options, lambda _: {output: poses_file(Path(output))}, f"path in {output}")
