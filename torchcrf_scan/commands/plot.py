"""`torchcrf-scan plot`: a picture of one pair."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.commands.arguments import load_model, read_one
from torchcrf_scan.commands.failures import LeftOut
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.pair_file import read_prediction
from torchcrf_scan.errors import TorchCRFScanError


def plot(
    file: str,
    output: str,
    *,
    number: int | None = None,
    topic: str | None = None,
    prediction: str | None = None,
    model: str | None = None,
) -> int:
    """Draws a pair with its prediction, from a file or by a model, and its annotation, if there are any.

    Args:
        file: pair file, or log
        output: picture (.png) to write
        number: number of a pair of the log, counted from 0 as in the names of its pairs
        topic: topic of the scans in a bag, if there are several
        prediction: prediction file
        model: folder of a saved model, or the name of one that the package ships; matches the pair
    """
    from torchcrf_scan.viz.plots import plot_pair, save_figure

    if prediction is not None and model is not None:
        raise TorchCRFScanError("--prediction: expected no --model beside it, got both")
    if Path(output).suffix.lower() != ".png":
        raise TorchCRFScanError(f"--output: expected a name ending in .png, got {output}")
    left_out = LeftOut()
    pair = read_one(file, number, ReadOptions(topic, on_bad=left_out.add))
    answer = read_prediction(prediction) if prediction is not None else None
    if model is not None:
        answer = load_model(model).match_pairs([pair])[0]
    save_figure(plot_pair(pair, answer), output)
    print(f"{pair.name} drawn in {output}{left_out}")
    return 0
