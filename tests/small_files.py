"""Files of every kind that the package reads, as small as they can be: what fuzzing begins with."""

import io
from pathlib import Path

import numpy as np

from torchcrf_scan import JointScanCRF, PairPrediction
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig

POSES = b"".join(b"%d.5 0.1 0.2 0 0 0 0.1 0.9\n" % k for k in range(5))
TRACKS = b"stamp,id,x,y,heading,vx,vy,length,width,points\n" + 3 * b"1.5,2,0.1,0.2,0.3,0.4,0.5,4.1,1.7,12\n"

(PAIR,) = simulate_pairs(SimulatorConfig(beams=61), 1, 1, 0)


def pair_bytes(folder: Path) -> bytes:
    write_pair(folder / "made.npz", PAIR)
    data = (folder / "made.npz").read_bytes()
    (folder / "made.npz").unlink()
    return data


def prediction_bytes() -> bytes:
    answer, out = JointScanCRF.from_pretrained().match(PAIR.source, PAIR.target), io.BytesIO()
    values = {name: getattr(answer, name) for name in PairPrediction.__slots__}
    np.savez(out, **{name: np.asarray(value) for name, value in values.items() if value is not None})
    return out.getvalue()


def carmen(pairs: int = 4) -> bytes:
    values = " ".join(f"{value:.2f}" for value in PAIR.source.to_beams(PAIR.source.ranges, 81.91))
    lines = [f"FLASER {PAIR.source.n_beams} {values} 0 0 0 {0.1 * k:.2f} 0 0 {k}.0 host {k}.0" for k in range(pairs)]
    return ("PARAM laser_front_laser_resolution 1.0\n" + "\n".join(lines) + "\n").encode()


def csv() -> bytes:
    out = io.StringIO()
    np.savetxt(out, np.column_stack([np.arange(4.0), np.full((4, 20), 2.5)]), delimiter=",", fmt="%.3f")
    return ("stamp," + ",".join(f"{value:.3f}" for value in np.linspace(-1, 1, 20)) + "\n" + out.getvalue()).encode()


def bags(folder: Path) -> list[tuple[str, bytes]]:
    from bags import LASER, laser, room, write  # needs the extra `ros`

    drive = [("/scan", LASER, 100 + 0.1 * k, laser(100 + 0.1 * k, room(0.1 * k))) for k in range(3)]
    forms = ("ros1", "ros1 lz4", "sqlite file", "mcap file")
    made = []
    for k, form in enumerate(forms):
        (folder / str(k)).mkdir()
        path = write(folder / str(k), form, drive)
        made.append((path.name, path.read_bytes()))
    return made
