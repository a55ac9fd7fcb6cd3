"""The loops are ordinary Python: with the compiler switched off they give the same answer."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from torchcrf_scan import JointScanCRF, Scan

PROGRAM = """
import sys
import numpy as np
from torchcrf_scan import JointScanCRF, Scan

given = np.load(sys.argv[1])
source, target = (Scan.from_ranges(given[name], given["bearings"]) for name in ("source", "target"))
found = JointScanCRF.from_pretrained().match(source, target, 0.2)
np.savez(sys.argv[2], association=found.association, cluster=found.cluster, motions=found.motions)
"""


def seen(box: float, x: float, seed: int) -> np.ndarray:
    """(41,) ranges of a room, x metres nearer, and of a box in it at a bearing."""
    bearings = np.linspace(-1.4, 1.4, 41)
    walls = np.minimum((6.0 - x) / np.cos(bearings), 4.0 / np.abs(np.sin(bearings) + 1e-9))
    ranges = np.where(np.abs(bearings - box) < 0.17, 2.5, walls)
    return ranges + np.random.default_rng(seed).normal(0, 0.005, 41)


def test_without_the_compiler_the_answer_is_the_same(tmp_path: Path) -> None:
    given = {"source": seen(-0.3, 0.0, 1), "target": seen(0.1, 0.2, 2), "bearings": np.linspace(-1.4, 1.4, 41)}
    np.savez(tmp_path / "pair.npz", **given)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    program = [sys.executable, "-c", PROGRAM, str(tmp_path / "pair.npz"), str(tmp_path / "answer.npz")]
    subprocess.run(program, check=True, env=environment, timeout=300)
    source, target = (Scan.from_ranges(given[name], given["bearings"]) for name in ("source", "target"))
    expected = JointScanCRF.from_pretrained().match(source, target, 0.2)
    assert len(set(expected.cluster.tolist()) - {-1}) > 1  # the box moves
    with np.load(tmp_path / "answer.npz") as found:
        for name in ("association", "cluster"):
            np.testing.assert_array_equal(found[name], getattr(expected, name), err_msg=name)
        np.testing.assert_allclose(found["motions"], expected.motions, rtol=0, atol=1e-9)
