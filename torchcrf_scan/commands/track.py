"""`torchcrf-scan track`: the moving objects of a recording, as CSV."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.commands.arguments import check_output
from torchcrf_scan.commands.recording import DEFAULTS, Options, process_one
from torchcrf_scan.whole_file import make_folder


def track(log: str, output: str, options: Options = DEFAULTS) -> int:
    """Follows the moving objects of a log: a CSV line for each in each scan (stamp, id, x, y, heading, vx, vy, ...).

    Metres, radians and m/s over ground, in the frame of the first scan. A damaged log gives everything before its fault; a bad
    scan is left out and counted.

    Args:
        log: recording
        output: file to write, e.g. tracks.csv
        options: of reading and processing
    """
    from torchcrf_scan.commands.outputs import tracks_file

    check_output(output, log)
    make_folder("--output", Path(output).parent)
    return process_one("track", log, options, lambda _: {output: tracks_file(Path(output))}, f"tracks in {output}")
