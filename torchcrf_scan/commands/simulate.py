"""`torchcrf-scan simulate`: annotated pairs of simulated worlds, as files."""

from __future__ import annotations

from torchcrf_scan.commands.arguments import make_folder
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.worlds import SimulatorConfig


def simulate(output: str, simulator: SimulatorConfig, *, pairs: int = 31, sequences: int = 8, seed: int = 0) -> int:
    """Writes simulated, annotated pair files; the same options and seed give the same bytes.

    Files of an earlier run are replaced. A folder that would then hold other .npz files beside those of this run is refused.

    Args:
        output: folder of the pair files, created if necessary
        simulator: world and sensor
        pairs: number of pairs in all
        sequences: number of drives that they come from
        seed: seed of all random draws
    """
    from torchcrf_scan.data.simulate import simulate_pairs

    simulated = {f"{pair.name}.npz": pair for pair in simulate_pairs(simulator, pairs, sequences, seed)}
    folder = make_folder("--output", output)
    others = sorted(path.name for path in folder.glob("*.npz") if path.name not in simulated)
    if others:
        got = f"{len(others)} others, the first {others[0]}"
        raise ValueError(f"--output {output}: expected a folder without .npz files but those of this run, got {got}")
    for name, pair in simulated.items():
        write_pair(folder / name, pair)
    print(f"{len(simulated)} pairs of {sequences} sequences in {folder}")
    return 0
