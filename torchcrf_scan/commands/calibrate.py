"""`torchcrf-scan calibrate`: a model fitted to one's own laser on a few annotated pairs."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.commands.arguments import annotated_pairs, load_model
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.pretrained import PRETRAINED, WEIGHTS
from torchcrf_scan.whole_file import make_folder


def calibrate(pair_files: list[str], output: str, *, model: str = PRETRAINED, threads: int | None = None) -> int:
    """Fits a model to one's own laser on annotated pairs, of which ten suffice, and saves it as a folder for `--model`.

    Fitted are the distance in metres beyond which a point is an outlier, the scales of the features, the worth of movers and the
    confidences; weights and boosters stay those of the model. Every part is measured on pairs left out in turn and kept only if
    it helps there; the table printed says what each part gains.

    Args:
        pair_files: pair files with annotation
        output: folder of the fitted model, created if necessary
        model: folder of a saved model to start from, or the name of one that the package ships
        threads: number of threads that torch computes with; by default its own choice
    """
    from torchcrf_scan.learning.leaks import TrainedOn
    from torchcrf_scan.learning.own_laser import calibrate_on

    pairs = annotated_pairs(pair_files)
    network = load_model(model, threads=threads)
    folder = make_folder("--output", output)
    if any(folder.iterdir()) and not (folder / WEIGHTS).is_file():
        raise TorchCRFScanError(f"--output: expected a new folder or one of a saved model, got {output} with other files")
    fitted, parts = calibrate_on(network, list(pairs.values()))
    trained_on = TrainedOn.of_model(model).plus(pairs.values())
    fitted.save_pretrained(folder)
    trained_on.write(folder)
    print(f"| part | fitted | {len(pairs)} pairs left out in turn: before | after | |\n|---|---|---|---|---|")
    for part in parts:
        told = "kept" if part.is_kept else "not kept: the pairs left out do not gain"
        print(f"| {part.name} | {part.value} | {part.before:.0f} {part.measure} | {part.after:.0f} | {told} |")
    print(f"model in {Path(output)}")
    return 0
