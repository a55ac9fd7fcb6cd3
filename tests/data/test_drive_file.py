"""A simulated drive comes back from its file as a recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, run

from torchcrf_scan.data.drive import simulate_drive
from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.data.worlds import SimulatorConfig


@pytest.mark.parametrize("fov", [180.0, 360.0])
def test_a_drive_comes_back(tmp_path: Path, fov: float) -> None:
    options = ["--simulator.beams=91", f"--simulator.fov={fov}"]
    assert run("simulate", "--output", tmp_path / "a.csv", "--drive=6", "--seed=4", *options) == 0
    drive = simulate_drive(replace(SimulatorConfig(), beams=91, fov=fov), 6, 4)
    readings = list(read_scans(tmp_path / "a.csv"))
    assert len(readings) == 6
    for told, true in zip(readings, drive, strict=True):
        assert told.stamp == pytest.approx(true.stamp)
        assert told.scan.n_beams == 91
        np.testing.assert_allclose(told.scan.points, true.scan.points, atol=1e-4)


def test_another_name_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ".csv with --drive" in fail(capsys, "simulate", "--output", tmp_path / "a", "--drive=6")
