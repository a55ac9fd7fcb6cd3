"""Which files are recordings, and what reads them."""

from pathlib import Path

import pytest

from torchcrf_scan.data.carmen import CarmenLog
from torchcrf_scan.data.formats import read_recording, reader_of

READING = "FLASER 3 1.00 1.10 1.20 0 0 0 0 0 0 {stamp:.2f} robot {stamp:.2f}\n"


@pytest.mark.parametrize("name", ["run.log", "run.log.gz", "2003.10.12.log"])
def test_a_carmen_log_is_known_by_its_name(name: str) -> None:
    assert reader_of(Path("folder") / name) is CarmenLog


@pytest.mark.parametrize("name", ["log.npz", "a.gz", "log", "run.log.txt"])
def test_other_files_are_no_recordings(name: str) -> None:
    assert reader_of(Path("folder.log") / name) is None
    with pytest.raises(ValueError, match=r"expected a recording \(\.log, \.log\.gz\)"):
        read_recording(Path("folder.log") / name)


def test_a_recording_has_the_pairs_of_consecutive_scans(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text("".join(READING.format(stamp=k / 10) for k in range(3)))
    recording = read_recording(path)
    assert len(recording) == 2
    assert recording[1].name == recording.pair_name(1) == "run_00001"
    assert recording[1].dt == pytest.approx(0.1)


def test_one_scan_makes_no_pair(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text(READING.format(stamp=0.0))
    with pytest.raises(ValueError, match=r"run\.log: expected at least two scans, got one$"):
        read_recording(path)
