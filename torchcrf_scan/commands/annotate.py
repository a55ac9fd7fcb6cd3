"""`torchcrf-scan annotate`: pairs annotated by hand, on a page in the browser."""

from __future__ import annotations

import sys
import webbrowser
from typing import TYPE_CHECKING

from tqdm import tqdm

from torchcrf_scan.annotate.store import Store
from torchcrf_scan.commands.arguments import PairPlace, find_pairs, load_model
from torchcrf_scan.commands.failures import LeftOut, attempt
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.whole_file import make_folder

if TYPE_CHECKING:
    from torchcrf_scan.annotate.desk import Case


def annotate(
    files: list[str],
    output: str,
    *,
    every: int = 1,
    topic: str | None = None,
    odometry: str | None = None,
    no_return: float | None = None,
    model: str = PRETRAINED,
    outlier_distance: float | None = None,
    port: int = 0,
    open: bool = False,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Opens a page on 127.0.0.1 to annotate scan pairs by hand, starting from the model's answer: OUTPUT/<name of the pair>.npz.

    Give points that the mouse or a key selects to the background, to movers, outliers or unknown; motions and associations follow.
    The pair the model is least sure of comes first. Every change is saved at once, in OUTPUT/.annotate with the older versions
    until the pair is finished; annotations already there are gone on with. Extra `annotate`: pip install torchcrf-scan[annotate].

    Args:
        files: pair files and logs
        output: folder of the annotations, created if necessary
        every: takes each N-th pair of a log only
        topic: topic of the scans in a bag, if there are several; of a CARMEN log the kind of lines, e.g. RLASER
        odometry: topic of odometry in a bag, or auto, for first guesses of the motions; other logs' odometry is used anyway
        no_return: readings in metres from there on mean that nothing came back; by default as the log says or shows
        model: folder of a saved model, or the name of one that the package ships
        outlier_distance: metres; points farther from every target point, under their own motion, get no counterpart; by default
            3.2 times half the target's spacing plus twice the noise of a range
        port: of the page; 0 for any that is free
        open: also opens the page in the browser
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; by default its own choice
    """
    from torchcrf_scan.annotate.desk import Desk

    try:
        from torchcrf_scan.annotate.server import ADDRESS, make_server, serve
    except ImportError as error:
        raise TorchCRFScanError(f"annotate: expected bokeh (pip install torchcrf-scan[annotate]), got {error}") from error
    failures: list[str] = []
    left_out = LeftOut()
    places = find_pairs(files, every, failures, ReadOptions(topic, odometry, no_return, left_out.add))
    store = Store(make_folder("--output", output))
    _check(port, outlier_distance, places, store)
    with store.alone():
        cases = _cases(places, load_model(model, None, device, threads), failures)
        for failure in failures:
            print(f"torchcrf-scan annotate: error: {failure}", file=sys.stderr)
        if not cases:
            raise TorchCRFScanError(f"files: expected pairs to annotate, got none{left_out}")
        server, port = make_server(Desk(cases, store, outlier_distance), port)
        address, pairs = f"http://{ADDRESS}:{port}/", f"{len(cases)} pair{'s' if len(cases) > 1 else ''}"
        print(f"{pairs}, annotations in {output}, Ctrl-C ends{left_out}: {address}", flush=True)
        if open:
            webbrowser.open(address)
        serve(server)
    return 0


def _check(port: int, outlier_distance: float | None, places: list[PairPlace], store: Store) -> None:
    """Raises TorchCRFScanError for an impossible port or distance, or if an annotation would replace a file that it is made of."""
    if not 0 <= port < 1 << 16:
        raise TorchCRFScanError(f"--port: expected 0 to {(1 << 16) - 1}, got {port}")
    if outlier_distance is not None and not 0 < outlier_distance < float("inf"):
        raise TorchCRFScanError(f"--outlier_distance: expected metres above 0, got {outlier_distance}")
    for place in places:
        for path in (store.finished(place.name), store.unfinished(place.name)):
            if path.exists() and path.samefile(place.path):
                raise TorchCRFScanError(f"--output: expected another folder than that of the pairs, got {store.folder}")


def _cases(places: list[PairPlace], network: JointScanCRF, failures: list[str]) -> list[Case]:
    """All pairs with the model's answers; one that the model refuses has none."""
    from torchcrf_scan.annotate.desk import Case

    found: list[Case] = []
    for place in tqdm(places, unit="pair", disable=None):
        pair = attempt(failures, place.read)
        if pair is not None:
            answer = attempt(failures, network.match_pairs, [pair])
            found.append(Case(pair, answer[0] if answer else None))
    return found
