"""`torchcrf-scan match`: predictions of pair files and logs by a saved model, one file and one line per pair."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from torchcrf_scan.batch import batches
from torchcrf_scan.commands.arguments import BATCH, find_pairs, load_model
from torchcrf_scan.commands.failures import LeftOut, attempt
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.pair_file import read_prediction, write_prediction
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.velocity import ground_velocity
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.scan import BACKGROUND, PairPrediction, ScanPair
from torchcrf_scan.whole_file import make_folder


def match(
    files: list[str],
    output: str,
    *,
    every: int = 1,
    topic: str | None = None,
    odometry: str | None = None,
    no_return: float | None = None,
    model: str = PRETRAINED,
    candidates: int | None = None,
    outlier_distance: float | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Matches scan pairs: writes OUTPUT/<name of the pair>.npz for each and prints the motions of the sensor and the movers.

    A pair is a file, or two consecutive scans of a log; those of run.log are named run_00000, run_00001 and so on. The format of
    a log (CARMEN, bags of ROS 1 and 2, MCAP, CSV) is recognised; a malformed scan in it is left out and counted. Earlier
    predictions are replaced, other files never. Files that cannot be read or written are skipped and reported at the end.

    Args:
        files: pair files and logs
        output: folder of the prediction files, created if necessary
        every: takes each N-th pair of a log only
        topic: topic of the scans in a bag, if there are several; of a CARMEN log the kind of lines, e.g. RLASER
        odometry: topic of odometry in a bag, or auto, for first guesses of the motions; other logs' odometry is used anyway
        no_return: readings in metres from there on mean that nothing came back; by default as the log says or shows
        model: folder of a saved model, or the name of one that the package ships
        candidates: target points considered for each source point, 0 for all; by default as the model was saved
        outlier_distance: metres; points farther from every target point, under their own motion, are outliers, and no others; by
            default as the model was saved
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; by default its own choice
    """
    failures: list[str] = []
    left_out = LeftOut()
    places = find_pairs(files, every, failures, ReadOptions(topic, odometry, no_return, left_out.add))
    targets = {place.name: _prediction_path(place.name, Path(output)) for place in places}
    network = load_model(model, candidates, device, threads, outlier_distance)
    make_folder("--output", output)
    moving: list[tuple[int, int]] = []
    with tqdm(total=len(places), unit="pair", disable=None) as bar:
        for part in batches(places, BATCH):
            pairs = {str(place): pair for place in part if (pair := attempt(failures, place.read)) is not None}
            for where, prediction in _match_batch(network, pairs, failures).items():
                pair = pairs[where]
                if attempt(failures, _write, targets[pair.name], prediction):
                    bar.write(describe(pair, prediction))
                    moving.append((int((prediction.cluster > BACKGROUND).sum()), len(pair.source)))
            bar.update(len(part))
    print(f"{len(moving)} of {len(places)} pairs matched{_shares(moving)}; predictions in {output}{left_out}")
    for failure in failures:
        print(f"torchcrf-scan match: error: {failure}", file=sys.stderr)
    return 1 if failures else 0


def _shares(moving: Sequence[tuple[int, int]]) -> str:
    """Overall share of moving points; moving: (moving, all) source points of every pair."""
    if not moving:
        return ""
    in_motion, points = (sum(counts) for counts in zip(*moving, strict=True))
    share = 100 * sum(count > 0 for count, _ in moving) / len(moving)
    return f", something moving in {share:.1f} % of them, {100 * in_motion / max(points, 1):.2f} % of their source points"


def describe(pair: ScanPair, prediction: PairPrediction) -> str:
    """One line: the sensor's motion, the movers with speed and size, and the outliers."""
    theta, x, y = se2.inverse(prediction.motions[BACKGROUND]).tolist()
    ego = f"sensor {_signed(x, 2)} m ahead, {_signed(y, 2)} m left, {_signed(math.degrees(theta), 1)} deg"
    sizes = [int((prediction.cluster == k).sum()) for k in range(1, len(prediction.motions))]
    movers = [f"{speed:.2f} m/s ({size} points)" for speed, size in zip(mover_speeds(pair, prediction), sizes, strict=True)]
    moving = f"{len(movers)} moving: {', '.join(movers)}" if movers else "nothing moving"
    outliers = int((prediction.association[pair.source.beam] < 0).sum())
    settled = "" if prediction.converged else "; not converged"
    return f"{pair.name}: {ego}; {moving}; {outliers} of {len(pair.source)} points outliers{_unobserved(prediction)}{settled}"


def _unobserved(prediction: PairPrediction) -> str:
    """The unobserved part of the background's motion, in words; directions are in the second scan's frame."""
    turn, shift = prediction.unobserved_turn, prediction.unobserved_shift
    found = "; turn not observed" if turn is not None and turn[BACKGROUND] else ""
    if shift is not None and shift[BACKGROUND].any():
        x, y = (shift[BACKGROUND] * (1 if tuple(shift[BACKGROUND]) > (0, 0) else -1)).round(2) + 0.0  # + 0.0: never -0.00
        found += f"; sliding along ({x:.2f}, {y:.2f}) not observed"
    return found


def _signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"  # + 0.0: never -0.00


def mover_speeds(pair: ScanPair, prediction: PairPrediction) -> list[float]:
    """Speed over ground of every mover's centroid, m/s."""
    points = pair.source.to_beams(pair.source.points, np.nan)
    background, *motions = prediction.motions
    centroids = [points[prediction.cluster == k].mean(axis=0) for k in range(1, len(motions) + 1)]
    velocities = [ground_velocity(c, motion, background, pair.dt) for c, motion in zip(centroids, motions, strict=True)]
    return [float(np.linalg.norm(velocity)) for velocity in velocities]


def _match_batch(network: JointScanCRF, pairs: Mapping[str, ScanPair], failures: list[str]) -> dict[str, PairPrediction]:
    """The predictions; if the batch fails, each pair alone, so that a bad one does not affect the others."""
    try:
        return dict(zip(pairs, network.match_pairs(list(pairs.values())), strict=True))
    except (ValueError, RuntimeError) as error:
        if len(pairs) == 1:
            failures.append(f"{next(iter(pairs))}: {one_line(error)}")
            return {}
    return {where: found for one in pairs for where, found in _match_batch(network, {one: pairs[one]}, failures).items()}


def _prediction_path(name: str, folder: Path) -> Path:
    """Path of the prediction of a pair; it must not exist, or be an earlier prediction."""
    target = folder / f"{name}.npz"
    if target.exists():
        try:
            read_prediction(target)
        except ValueError as error:
            raise TorchCRFScanError(f"--output {folder}: expected to replace nothing but predictions, got {target}") from error
    return target


def _write(path: Path, prediction: PairPrediction) -> bool:
    write_prediction(path, prediction)
    return True
