"""What a stream with memory finds on simulated drives, beside the same model on pairs alone."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from torchcrf_scan.data.drive import Drive, simulate_drive
from torchcrf_scan.data.worlds import SimulatorConfig, every
from torchcrf_scan.evaluation.drives import drive_scores
from torchcrf_scan.geometry import se2
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.result import ScanResult
from torchcrf_scan.scan import BACKGROUND, OUTLIER
from torchcrf_scan.stream.stream import ScanStream

INTERVAL = 0.1  # seconds between scans
SHOWN = ("hota", "mota", "id_switches", "precision", "recall", "velocity_error", "false_moving", "path_error")


def score_drives(world: SimulatorConfig, scans: int, seeds: Sequence[int], model: JointScanCRF) -> dict[str, float]:
    """Scores of drives of `scans` scans at 10 Hz, one per seed.

    Returns:
        `movers`, how many there are to be found; `found_by_pairs` and `found`, percent found by pairs alone and by the stream;
        `SHOWN` of `drive_scores`, of the stream; `scans_per_second`, of the stream.
    """
    world = every(world, INTERVAL)
    drives = [simulate_drive(world, scans, seed) for seed in seeds]
    begun = time.perf_counter()
    streamed = [_streamed(drive, model) for drive in drives]
    seconds = time.perf_counter() - begun
    alone = drive_scores(drives, [_alone(drive, model) for drive in drives], world.scale)
    together = drive_scores(drives, streamed, world.scale)
    found = {"movers": together["movers"], "found_by_pairs": alone["movers_found"], "found": together["movers_found"]}
    return found | {key: together[key] for key in SHOWN} | {"scans_per_second": scans * len(drives) / seconds}


def _streamed(drive: Drive, model: JointScanCRF) -> list[ScanResult]:
    """What the stream says of every scan."""
    stream = ScanStream(model)
    return [stream.feed(reading.scan, reading.stamp) for reading in drive.readings()]


def _alone(drive: Drive, model: JointScanCRF) -> list[ScanResult]:
    """Every scan matched to the one two before, as the stream's lag has it, with the motion before as initial guess."""
    none, eye = np.zeros(3), np.eye(3)
    poses, results = [np.zeros(3)], []
    for i, scan in enumerate(drive):
        cluster = scan.scan.to_beams(np.zeros(len(scan.scan), dtype=np.int64), OUTLIER)
        if i > 0:
            j = max(i - 2, 0)
            step = se2.compose(se2.inverse(poses[-2]), poses[-1]) if i > 1 else none
            guess = se2.compose(se2.inverse(poses[j]), se2.compose(poses[-1], step))
            found = model.match(scan.scan, drive[j].scan, scan.stamp - drive[j].stamp, initial_motion=guess.tolist())
            cluster = found.cluster
            poses.append(se2.compose(poses[j], found.motions[BACKGROUND]))
        results.append(ScanResult(scan.scan, scan.stamp, poses[-1], eye, none, eye, cluster > BACKGROUND, cluster, (), "ok", ""))
    return results
