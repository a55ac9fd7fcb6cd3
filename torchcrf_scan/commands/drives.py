"""`torchcrf-scan drives`: the stream on simulated drives, beside pairs alone."""

from __future__ import annotations

import json as json_format
import math
from pathlib import Path

from torchcrf_scan.commands.arguments import listed, load_model
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.whole_file import make_folder, write_whole

HEADER = {
    "movers": "movers",
    "found_by_pairs": "found by pairs, %",
    "found": "found by the stream, %",
    "hota": "HOTA",
    "mota": "MOTA",
    "id_switches": "id switches",
    "precision": "precision, %",
    "recall": "recall, %",
    "velocity_error": "velocity error, m/s",
    "false_moving": "false moving, %",
    "path_error": "path error over 10 m, m",
    "scans_per_second": "scans/s",
}


def drives(
    *,
    worlds: tuple[str, ...] | str = ("street", "crowd_768", "cars_360", "indoor_1081"),
    scans: int = 100,
    count: int = 2,
    seed: int = 1,
    model: str = PRETRAINED,
    json: str = "",
) -> int:
    """Scores what a stream with memory says of simulated drives: movers found, tracks, velocities and the sensor's path.

    Objects in these drives keep their numbers, while they are hidden too. Needs the library trackeval
    (`pip install torchcrf-scan[tracking]`).

    Args:
        worlds: simulated world, or a list of them, [street,cars_360]
        scans: number of scans of each drive, at 10 Hz
        count: number of drives in each world
        seed: seed of the first drive; the others follow
        model: folder of a saved model, or the name of one that the package ships
        json: file for all numbers
    """
    from torchcrf_scan.benchmark.drives import score_drives
    from torchcrf_scan.data.worlds import NAMED_WORLDS

    names = listed(worlds)
    unknown = [name for name in names if name not in NAMED_WORLDS]
    if unknown or not names:
        raise TorchCRFScanError(f"--worlds: expected some of {', '.join(NAMED_WORLDS)}, got {', '.join(unknown) or 'none'}")
    for name, value, least in (("scans", scans, 2), ("count", count, 1), ("seed", seed, 0)):
        if value < least:
            raise TorchCRFScanError(f"--{name}: expected at least {least}, got {value}")
    try:
        import trackeval  # noqa: F401
    except ImportError as error:
        raise TorchCRFScanError(f"expected the library trackeval, which scores tracks (extra `tracking`), got {error}") from error
    if json:
        make_folder("--json", Path(json).parent)
    loaded = load_model(model)
    print("| world | " + " | ".join(HEADER.values()) + " |\n|" + "---|" * (len(HEADER) + 1))
    rows = {}
    for name in names:
        rows[name] = score_drives(NAMED_WORLDS[name], scans, range(seed, seed + count), loaded)
        print(f"| {name} | " + " | ".join(_shown(key, rows[name][key]) for key in HEADER) + " |", flush=True)
    if json:
        write_whole(Path(json), json_format.dumps(rows, indent=2) + "\n")
    return 0


def _shown(key: str, value: float) -> str:
    """A number of a table; nothing where there was nothing to measure, such as a path of 10 m."""
    if math.isnan(value):
        return ""
    if key in ("movers", "id_switches"):
        return f"{value:.0f}"
    return (
        f"{value:.3f}" if key == "path_error" else f"{value:.2f}" if key in ("velocity_error", "false_moving") else f"{value:.1f}"
    )
