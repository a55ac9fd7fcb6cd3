"""Scores of what a stream says of simulated drives: movers found, tracks, velocities, the sensor's own path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchcrf_scan.data.drive import Drive, DriveScan
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.metrics import FOUND_IOU, MOVER_MIN_POINTS
from torchcrf_scan.evaluation.tracking import TrackFrame, frame_of_points, frame_of_positions, track_scores
from torchcrf_scan.evaluation.trajectory import relative_error
from torchcrf_scan.geometry import se2
from torchcrf_scan.result import ScanResult
from torchcrf_scan.scan import BACKGROUND

REACH = 4.0  # metres at full size, at which objects are not the same; a car of which the rear is seen is 2 m off
PATH = 10.0  # metres at full size, over which the sensor's path is scored


def drive_scores(drives: Sequence[Drive], results: Sequence[Sequence[ScanResult]], scale: float = 1.0) -> dict[str, float]:
    """Scores over all scans of some drives.

    - The scores of `track_scores`, objects compared by their points; `hota_position`, `mota_position`: by their places.
    - `movers_found`: percent of the objects of at least five points, by scan, that a cluster covers with an IoU of at least 0.5,
      whatever its number. `movers`: how many these are.
    - `velocity_error`: median over the objects found, m/s. `false_moving`: percent of the background's points taken as moving.
    - `path_error`: root mean square of the relative pose error over 10 m, metres; NaN where no drive is as long.

    Args:
        results: what a stream says of every scan of each drive.
        scale: of the drives' world (`SimulatorConfig.scale`), by which distances of places and paths are multiplied.

    Raises:
        TorchCRFScanError: no drives, or another number of results than of scans.
    """
    if len(drives) != len(results) or any(len(a) != len(b) for a, b in zip(drives, results, strict=True)):
        raise TorchCRFScanError(f"results: expected one per scan of {len(drives)} drives, got others")
    pairs = [list(zip(drive, of, strict=True)) for drive, of in zip(drives, results, strict=True)]
    by_points = track_scores([[_by_points(*pair) for pair in drive] for drive in pairs])
    by_place = track_scores([[_by_place(*pair, scale) for pair in drive] for drive in pairs])
    every = [pair for drive in pairs for pair in drive]
    found = np.array([is_found for pair in every for is_found in _found(*pair)], dtype=bool)
    errors = [error for pair in every for error in _velocity_errors(*pair)]
    still = sum(np.count_nonzero(scan.body == BACKGROUND) for scan, _ in every)
    false = sum(np.count_nonzero((scan.body == BACKGROUND) & result.moving) for scan, result in every)
    paths = [
        relative_error(np.stack([r.pose for r in of]), drive.poses, PATH * scale) for drive, of in zip(drives, results, strict=True)
    ]
    squares = np.concatenate([path.translation**2 for path in paths])
    return {
        **by_points,
        **{f"{key}_position": by_place[key] for key in ("hota", "mota")},
        "movers_found": 100 * float(found.mean()) if len(found) else float("nan"),
        "movers": float(len(found)),
        "velocity_error": float(np.median(errors)) if errors else float("nan"),
        "false_moving": 100 * float(false / max(still, 1)),
        "path_error": float(np.sqrt(squares.mean())) if len(squares) else float("nan"),
    }


def _by_points(scan: DriveScan, result: ScanResult) -> TrackFrame:
    """The confirmed objects by their points."""
    confirmed = np.isin(result.track, [of.number for of in result.objects])
    return frame_of_points(scan.body, np.where(confirmed, result.track, BACKGROUND))


def _by_place(scan: DriveScan, result: ScanResult, scale: float) -> TrackFrame:
    """The confirmed objects by their places, predicted ones included."""
    asked = np.array([of.points >= MOVER_MIN_POINTS for of in scan.objects], dtype=bool)
    true, found = ([of.number for of in objects] for objects in (scan.objects, result.objects))
    there, here = ([of.position for of in objects] for objects in (scan.objects, result.objects))
    numbers = np.array(true, dtype=np.int64), np.array(found, dtype=np.int64)
    places = np.reshape(there, (-1, 2)), np.reshape(here, (-1, 2))
    return frame_of_positions(numbers[0], places[0], asked, numbers[1], places[1], REACH * scale)


def _found(scan: DriveScan, result: ScanResult) -> list[bool]:
    """Whether each object of enough points is covered by a cluster."""
    frame = frame_of_points(scan.body, np.where(result.moving, result.track, BACKGROUND))
    return (frame.similarity.max(1, initial=0.0) >= FOUND_IOU).tolist()


def _velocity_errors(scan: DriveScan, result: ScanResult) -> list[float]:
    """Errors of the velocities of the objects found, in the sensor's axes, which need not know its own heading in the world."""
    frame, known = _by_points(scan, result), {of.number: of for of in result.objects}
    errors = []
    for true in scan.objects:
        similarity = frame.similarity[frame.true == true.number].ravel()
        if similarity.size and similarity.max() >= FOUND_IOU:
            found = known[int(frame.found[similarity.argmax()])]
            turn = se2.rotate(scan.pose[0] - result.pose[0], found.velocity)
            errors.append(float(np.hypot(*(turn - true.velocity))))
    return errors
