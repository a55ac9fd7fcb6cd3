"""`torchcrf-scan simulate`: annotated pairs of simulated worlds, as files."""

from __future__ import annotations

from pathlib import Path

from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.whole_file import make_folder


def simulate(
    output: str, simulator: SimulatorConfig, *, pairs: int = 31, sequences: int = 8, drive: int | None = None, seed: int = 0
) -> int:
    """Writes simulated, annotated pair files; the same options and seed give the same bytes.

    Files of an earlier run are replaced. A folder that would then hold other .npz files beside those of this run is refused.
    With --drive it is one log instead, which `run` and the other commands on logs take.

    Args:
        output: folder of the pair files, created if necessary; with --drive the log (.csv)
        simulator: world and sensor
        pairs: number of pairs in all
        sequences: number of drives that they come from
        drive: number of scans of one drive, to be written as a log
        seed: seed of all random draws
    """
    if drive is not None:
        return _write_drive(Path(output), simulator, drive, seed)
    from torchcrf_scan.data.simulate import simulate_pairs

    simulated = {f"{pair.name}.npz": pair for pair in simulate_pairs(simulator, pairs, sequences, seed)}
    folder = make_folder("--output", output)
    others = sorted(path.name for path in folder.glob("*.npz") if path.name not in simulated)
    if others:
        got = f"{len(others)} others, the first {others[0]}"
        raise TorchCRFScanError(f"--output {output}: expected a folder without .npz files but those of this run, got {got}")
    for name, pair in simulated.items():
        write_pair(folder / name, pair)
    print(f"{len(simulated)} pairs of {sequences} sequences in {folder}")
    return 0


def _write_drive(path: Path, simulator: SimulatorConfig, scans: int, seed: int) -> int:
    from torchcrf_scan.data.drive import simulate_drive
    from torchcrf_scan.data.drive_file import write_drive

    if path.suffix.lower() != ".csv":
        raise TorchCRFScanError(f"--output: expected a name ending in .csv with --drive, got {path}")
    make_folder("--output", path.parent)
    write_drive(path, simulate_drive(simulator, scans, seed), simulator)
    print(f"{scans} scans of one drive in {path}")
    return 0
