"""The command `torchcrf-scan`: every subcommand is a typed function, its options and help come from signature and docstring.

Exit codes: 0 done, 1 bad input (one line on stderr says which), 2 bad usage. What only one command needs is imported there.
"""

from __future__ import annotations

import inspect
import json as json_format
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from jsonargparse import ArgumentParser
from safetensors import SafetensorError
from tqdm import tqdm

from torchcrf_scan import __version__
from torchcrf_scan.baselines.start import match_start, match_static
from torchcrf_scan.config import SimulatorConfig
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, read_prediction, write_pair, write_prediction
from torchcrf_scan.geometry import se2
from torchcrf_scan.model import PRETRAINED, JointScanCRF
from torchcrf_scan.scan import BACKGROUND, PairPrediction, ScanPair

if TYPE_CHECKING:
    from torchcrf_scan.evaluation.metrics import PairScore

Result = TypeVar("Result")
Method = Callable[[Sequence[ScanPair]], list[PairPrediction]]
Loader = Callable[[], JointScanCRF]

BATCH = 4  # pairs that are matched at once: more are hardly faster, but the progress bar moves less often

METHODS: dict[str, Callable[[Loader], Method]] = {
    "joint": lambda load: load().match_pairs,
    "start": lambda load: partial(match_start, load()),
    "static": lambda load: match_static,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code; bad usage and `--help` leave through `SystemExit`, as argparse does.

    Args:
        argv: arguments without the program's name; those of the process where absent.
    """
    parser = make_parser()
    parsed = parser.parse_args(None if argv is None else list(argv))
    try:
        options = parser.instantiate(parsed)[parsed.command]
        code = COMMANDS[parsed.command](**vars(options))
        sys.stdout.flush()
    except BrokenPipeError:  # whoever reads our output has seen enough (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError) as error:
        print(f"torchcrf-scan {parsed.command}: error: {_one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def make_parser() -> ArgumentParser:
    """The parser of all commands."""
    description = "Associations, moving objects and motions between two consecutive planar laser scans."
    parser = ArgumentParser(prog="torchcrf-scan", description=description, version=__version__)
    subcommands = parser.add_subcommands(dest="command")
    for name, command in COMMANDS.items():
        summary = (inspect.getdoc(command) or "").split("\n\nArgs:")[0]
        subparser = _command_parser(name, command, summary)
        subcommands.add_subcommand(name, subparser, help=summary.split("\n")[0])
    return parser


def _command_parser(name: str, command: Callable[..., int], summary: str) -> ArgumentParser:
    """Options from the signature; a parameter `files` or `file` is given without a dash."""
    parameters = inspect.signature(command).parameters
    forms = {"files": "PAIR.npz ...", "file": "PAIR.npz", "output": "--output OUTPUT"}
    shown = [form for key, form in forms.items() if key in parameters]
    parser = ArgumentParser(description=summary, usage=" ".join(["torchcrf-scan", name, *shown, "[options]"]))
    if "files" in parameters:
        several = "pair files (.npz), folders of them, or glob patterns"
        parser.add_argument("files", type=str, metavar="PAIR.npz", nargs="+", help=several)
    if "file" in parameters:
        parser.add_argument("file", type=str, metavar="PAIR.npz", help="a pair file (.npz)")
    parser.add_function_arguments(command, as_group=False, as_positional=False, skip={"files", "file"})
    return parser


# --- simulate -----------------------------------------------------------------------------------------------------------------


def simulate(output: str, simulator: SimulatorConfig, *, pairs: int = 31, sequences: int = 8, seed: int = 0) -> int:
    """Writes simulated, annotated pair files; the same options and seed give the same bytes.

    Files of an earlier run are replaced. A folder that would then hold other .npz files beside those of this run is refused.

    Args:
        output: folder of the pair files, made if need be
        simulator: world and sensor
        pairs: number of pairs in all
        sequences: number of drives that they come from
        seed: seed of everything drawn
    """
    from torchcrf_scan.data.simulate import simulate_pairs

    simulated = {f"{pair.name}.npz": pair for pair in simulate_pairs(simulator, pairs, sequences, seed)}
    folder = _make_folder("--output", output)
    others = sorted(path.name for path in folder.glob("*.npz") if path.name not in simulated)
    if others:
        got = f"{len(others)} others, the first {others[0]}"
        raise ValueError(f"--output {output}: expected a folder without .npz files but those of this run, got {got}")
    for name, pair in simulated.items():
        write_pair(folder / name, pair)
    print(f"{len(simulated)} pairs of {sequences} sequences in {folder}")
    return 0


# --- match --------------------------------------------------------------------------------------------------------------------


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
    _make_folder("--output", output)
    failures: list[str] = []
    with tqdm(total=len(paths), unit="pair", disable=None) as bar:
        for part in _parts(paths):
            pairs = {path: pair for path in part if (pair := _attempt(failures, read_pair, path)) is not None}
            for path, prediction in _match_batch(network, pairs, failures).items():
                if _attempt(failures, _write, targets[path], prediction):
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
    """Speed over ground of every mover, m/s: its centroid's way in the source frame, the sensor's own motion undone."""
    points = pair.source.to_beams(pair.source.points, np.nan)
    to_source = se2.inverse(prediction.motions[BACKGROUND])
    speeds = []
    for k, motion in enumerate(prediction.motions[1:], start=1):
        centroid = points[prediction.cluster == k].mean(axis=0)
        end = se2.apply(se2.compose(to_source, motion), centroid[None])[0]
        speeds.append(float(np.linalg.norm(end - centroid)) / pair.dt)
    return speeds


def _match_batch(network: JointScanCRF, pairs: Mapping[Path, ScanPair], failures: list[str]) -> dict[Path, PairPrediction]:
    """The predictions; where the batch fails, those of each pair alone, so that a bad one does not lose the others."""
    try:
        return dict(zip(pairs, network.match_pairs(list(pairs.values())), strict=True))
    except (ValueError, RuntimeError) as error:
        if len(pairs) == 1:
            failures.append(f"{next(iter(pairs))}: {_one_line(error)}")
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


# --- evaluate -----------------------------------------------------------------------------------------------------------------


def evaluate(
    files: list[str],
    *,
    predictions: str | None = None,
    method: str | None = None,
    model: str | None = None,
    json: str | None = None,
    candidates: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Prints how good predictions of annotated pairs are: an overview and the paper's Tables I to III, by sequence and in all.

    The predictions are read from files, or made here by a method.

    Args:
        files: pair files with annotation
        predictions: folder of prediction files named like the pair files, instead of a method
        method: joint (the model), start (its start and nearest points, no field) or static (nothing moves); joint where absent
        model: folder of a saved model, or the name of one that the package ships; simulated where absent
        json: file for all figures with all digits
        candidates: target points considered for each source point, 0 for all; as the model was saved where absent
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; its own choice where absent
    """
    from torchcrf_scan.evaluation.metrics import score_pair
    from torchcrf_scan.evaluation.report import report

    if predictions is not None and (method, model) != (None, None):
        raise ValueError("--predictions: expected no --method and no --model beside it, got both")
    if json is not None:
        _make_folder("--json", Path(json).parent)
    pairs = _annotated_pairs(files)
    if predictions is not None:
        name, answers = Path(predictions).resolve().name, _read_predictions(list(pairs), Path(predictions))
    else:
        name = "joint" if method is None else method
        load = partial(load_model, PRETRAINED if model is None else model, candidates, device, threads)
        answers = _run(name, load, list(pairs.values()))
    scores = [score_pair(pair, answer) for pair, answer in zip(pairs.values(), answers, strict=True)]
    print("\n".join(table.to_markdown() for table in report(_rows(name, scores))), end="")
    if json is not None:
        Path(json).write_text(json_format.dumps(_figures(name, scores), indent=2) + "\n")
    return 0


def _annotated_pairs(patterns: Sequence[str]) -> dict[Path, ScanPair]:
    pairs = {path: read_pair(path) for path in find_files(patterns)}
    for path, pair in pairs.items():
        if pair.annotation is None:
            raise ValueError(f"{path}: expected an annotated pair (keys association and cluster), got one without")
    return pairs


def _read_predictions(paths: Sequence[Path], folder: Path) -> list[PairPrediction]:
    files = [folder / f"{path.stem}.npz" for path in paths]
    missing = [file for file in files if not file.is_file()]
    if missing:
        got = f"none for {len(missing)} of {len(files)}, the first {missing[0].name}"
        raise ValueError(f"--predictions {folder}: expected a file for every pair, got {got}")
    return [read_prediction(file) for file in files]


def _run(name: str, load: Loader, pairs: Sequence[ScanPair]) -> list[PairPrediction]:
    if name not in METHODS:
        raise ValueError(f"--method: expected one of {', '.join(METHODS)}, got {name}")
    method = METHODS[name](load)
    found: list[PairPrediction] = []
    with tqdm(total=len(pairs), unit="pair", disable=None) as bar:
        for part in _parts(pairs):
            found += method(part)
            bar.update(len(part))
    return found


def _by_sequence(scores: Sequence[PairScore]) -> dict[str, list[PairScore]]:
    sequences = sorted({score.sequence for score in scores})
    return {sequence: [score for score in scores if score.sequence == sequence] for sequence in sequences}


def _rows(name: str, scores: list[PairScore]) -> dict[str, list[PairScore]]:
    """Row of a table -> its scores: every sequence, where there are several, then all."""
    rows = {f"{name}, {sequence or 'no sequence'}": part for sequence, part in _by_sequence(scores).items()}
    return {**(rows if len(rows) > 1 else {}), f"{name}, all": scores}


def _figures(name: str, scores: list[PairScore]) -> dict[str, Any]:
    """What `--json` writes: `method`, `all` and `sequences`, every figure of `summarise`, null where there is nothing to tell."""
    from torchcrf_scan.evaluation.metrics import summarise

    def figures(part: Sequence[PairScore]) -> dict[str, float | None]:
        return {key: None if math.isnan(value) else value for key, value in summarise(part).items()}

    return {"method": name, "all": figures(scores), "sequences": {k: figures(part) for k, part in _by_sequence(scores).items()}}


# --- plot ---------------------------------------------------------------------------------------------------------------------


def plot(file: str, output: str, *, prediction: str | None = None, model: str | None = None) -> int:
    """Draws a pair with its prediction, from a file or by a model, and its annotation, as far as they are there.

    Args:
        file: pair file
        output: picture (.png) to write
        prediction: prediction file
        model: folder of a saved model, or the name of one that the package ships; matches the pair
    """
    from torchcrf_scan.viz.plots import plot_pair, save_figure

    if prediction is not None and model is not None:
        raise ValueError("--prediction: expected no --model beside it, got both")
    if Path(output).suffix.lower() != ".png":
        raise ValueError(f"--output: expected a name ending in .png, got {output}")
    pair = read_pair(file)
    answer = read_prediction(prediction) if prediction is not None else None
    if model is not None:
        answer = load_model(model).match_pairs([pair])[0]
    save_figure(plot_pair(pair, answer), output)
    print(f"{pair.name} drawn in {output}")
    return 0


# --- what several commands need -----------------------------------------------------------------------------------------------


def load_model(name: str, candidates: int | None = None, device: str = "cpu", threads: int | None = None) -> JointScanCRF:
    """A saved model, ready on a device; a damaged one, a device that is not there or no threads raise ValueError."""
    if threads is not None:
        if threads < 1:
            raise ValueError(f"--threads: expected at least 1, got {threads}")
        torch.set_num_threads(threads)
    changes = {} if candidates is None else {"candidates": candidates}
    try:
        model = JointScanCRF.from_pretrained(name, **changes)
    except (ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        raise ValueError(f"--model {name}: {error}") from error
    try:
        return model.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device: expected one that torch can use here, got {device} ({error})") from error


def find_files(patterns: Sequence[str]) -> list[Path]:
    """The files that match, each once; two of the same name raise ValueError: predictions are named like their pairs."""
    found: dict[str, Path] = {}
    for path in PairFiles(*patterns).paths:
        first = found.setdefault(path.stem, path)
        if not first.samefile(path):
            raise ValueError(f"{path}: expected file names that differ, got the name of {first} again")
    return list(found.values())


def _make_folder(option: str, folder: str | Path) -> Path:
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{option}: expected a folder, got {folder}, where a file is in the way") from error
    return Path(folder)


def _parts(items: Sequence[Result]) -> Iterator[Sequence[Result]]:
    for begin in range(0, len(items), BATCH):
        yield items[begin : begin + BATCH]


def _attempt(failures: list[str], run: Callable[..., Result], *arguments: Any) -> Result | None:
    """What `run` returns, None where the input is bad; then `failures` gets the reason."""
    try:
        return run(*arguments)
    except (ValueError, OSError) as error:
        failures.append(_one_line(error))
        return None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


COMMANDS: Mapping[str, Callable[..., int]] = {"simulate": simulate, "match": match, "evaluate": evaluate, "plot": plot}

if __name__ == "__main__":
    sys.exit(main())
