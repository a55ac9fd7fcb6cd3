"""`torchcrf-scan match`: predictions of pair files by a saved model, a file and a line each."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from tqdm import tqdm

from torchcrf_scan.commands.arguments import batches, find_files, load_model, make_folder
from torchcrf_scan.commands.failures import attempt, one_line
from torchcrf_scan.data.pair_file import read_pair, read_prediction, write_prediction
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.velocity import ground_velocity
from torchcrf_scan.model import PRETRAINED, JointScanCRF
from torchcrf_scan.scan import BACKGROUND, PairPrediction, ScanPair


def match(
    files: list[str],
    output: str,
    *,
    model: str = PRETRAINED,
    candidates: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Matches scan pairs: writes OUTPUT/<same name>.npz for each and prints how the sensor and the movers went.

    Earlier predictions are replaced, other files never. A file that cannot be read or written does not stop the others; it is
    reported at the end.

    Args:
        files: pair files
        output: folder of the prediction files, made if need be
        model: folder of a saved model, or the name of one that the package ships
        candidates: target points considered for each source point, 0 for all; as the model was saved where absent
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; its own choice where absent
    """
    paths = find_files(files)
    targets = {path: _prediction_path(path, Path(output)) for path in paths}
    network = load_model(model, candidates, device, threads)
    make_folder("--output", output)
    failures: list[str] = []
    with tqdm(total=len(paths), unit="pair", disable=None) as bar:
        for part in batches(paths):
            pairs = {path: pair for path in part if (pair := attempt(failures, read_pair, path)) is not None}
            for path, prediction in _match_batch(network, pairs, failures).items():
                if attempt(failures, _write, targets[path], prediction):
                    bar.write(describe(pairs[path], prediction))
            bar.update(len(part))
    print(f"{len(paths) - len(failures)} of {len(paths)} pairs matched, predictions in {output}")
    for failure in failures:
        print(f"torchcrf-scan match: error: {failure}", file=sys.stderr)
    return 1 if failures else 0


def describe(pair: ScanPair, prediction: PairPrediction) -> str:
    """One line: the sensor's motion, the movers with speed and size, and the outliers."""
    theta, x, y = se2.inverse(prediction.motions[BACKGROUND]).tolist()
    ego = f"sensor {_signed(x, 2)} m ahead, {_signed(y, 2)} m left, {_signed(math.degrees(theta), 1)} deg"
    sizes = [int((prediction.cluster == k).sum()) for k in range(1, len(prediction.motions))]
    movers = [f"{speed:.2f} m/s ({size} points)" for speed, size in zip(mover_speeds(pair, prediction), sizes, strict=True)]
    moving = f"{len(movers)} moving: {', '.join(movers)}" if movers else "nothing moving"
    outliers = int((prediction.association[pair.source.beam] < 0).sum())
    settled = "" if prediction.converged else "; not converged"
    return f"{pair.name}: {ego}; {moving}; {outliers} of {len(pair.source)} points outliers{settled}"


def _signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"  # + 0.0: never -0.00


def mover_speeds(pair: ScanPair, prediction: PairPrediction) -> list[float]:
    """Speed over ground of every mover, m/s, where its centroid goes."""
    points = pair.source.to_beams(pair.source.points, np.nan)
    background, *motions = prediction.motions
    centroids = [points[prediction.cluster == k].mean(axis=0) for k in range(1, len(motions) + 1)]
    velocities = [ground_velocity(c, motion, background, pair.dt) for c, motion in zip(centroids, motions, strict=True)]
    return [float(np.linalg.norm(velocity)) for velocity in velocities]


def _match_batch(network: JointScanCRF, pairs: Mapping[Path, ScanPair], failures: list[str]) -> dict[Path, PairPrediction]:
    """The predictions; where the batch fails, those of each pair alone, so that a bad one does not lose the others."""
    try:
        return dict(zip(pairs, network.match_pairs(list(pairs.values())), strict=True))
    except (ValueError, RuntimeError) as error:
        if len(pairs) == 1:
            failures.append(f"{next(iter(pairs))}: {one_line(error)}")
            return {}
    return {path: found for one in pairs for path, found in _match_batch(network, {one: pairs[one]}, failures).items()}


def _prediction_path(path: Path, folder: Path) -> Path:
    """Where the prediction of a pair file goes: nothing there yet, or an earlier prediction."""
    target = folder / f"{path.stem}.npz"
    if target.exists():
        try:
            read_prediction(target)
        except ValueError as error:
            raise ValueError(f"--output {folder}: expected to replace nothing but predictions, got {target}") from error
    return target


def _write(path: Path, prediction: PairPrediction) -> bool:
    write_prediction(path, prediction)
    return True
