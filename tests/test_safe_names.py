"""Names from files: as file names, and on the terminal."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.formats import read_recording
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.experiment.methods import METHODS
from torchcrf_scan.safe_names import LONGEST, check_name, file_name, one_line, printable, slug

ODD = [
    "",
    ".",
    "..",
    "...",
    "./.",
    "/",
    "a/b",
    "a b",
    "a_b",
    "a\\b",
    "\x1b[31m",
    "x" * 300,
    "x" * 301,
    "é" * 200,
    "\ud800",
    "..x",
    "-x",
]


def test_plain_names_stay_as_they_are() -> None:
    for name in ("run_00000", "a b", "kitti0001_f000_g2", "mañana (2), +1.5", "x" * LONGEST):
        assert file_name(name) == name


@given(st.text() | st.sampled_from(ODD))
def test_a_file_name_stays_in_its_folder(name: str) -> None:
    found = file_name(name)
    assert (Path("/folder") / found).resolve().parent == Path("/folder")
    assert not found.startswith(".")
    assert len(found) <= LONGEST
    assert len(found.encode()) <= 200  # of 255, an ending being added
    assert printable(found) == found
    assert found == file_name(name)


@given(st.lists(st.text(max_size=4) | st.sampled_from(ODD), unique=True))
def test_distinct_names_stay_distinct(names: list[str]) -> None:
    found = [file_name(name) for name in names]
    again = [file_name(name) for name in found if name not in names]  # names that look like what was made of others
    assert len({*found, *again}) == len(found) + len(again)


def test_the_packages_own_labels_differ_without_spaces() -> None:
    assert slug("K-Means (ICP), ego removed") == "K-Means_ICP_ego_removed"
    assert len({slug(method) for method in METHODS}) == len(METHODS)


def test_what_controls_a_terminal_is_escaped() -> None:
    assert printable("a b\x1b[31m\u202e\n") == "a b\\x1b[31m\\u202e\\n"
    assert printable("été 走廊 |") == "été 走廊 |"
    assert one_line(ValueError("red\x1b[31m\n ink")) == "red\\x1b[31m ink"
    check_name("a.npz: sequence", "été 走廊")
    with pytest.raises(ValueError, match=r"^a.npz: sequence: expected a name without control characters, got 'a\\\\x1b'$"):
        check_name("a.npz: sequence", "a\x1b")


@pytest.mark.parametrize("field", ["sequence", "source", "file name"])
def test_a_pair_file_with_control_characters_is_refused(field: str, tmp_path: Path) -> None:
    path = tmp_path / ("a\x1b[2J.npz" if field == "file name" else "a.npz")
    scans = {f"{side}_{what}": np.ones(3) for side in ("source", "target") for what in ("ranges", "bearings")}
    scans |= {f"{side}_bearings": np.arange(3) / 9 for side in ("source", "target")}
    np.savez(path, **scans, dt=0.1, **({} if field == "file name" else {field: "a\x1b[2J"}))
    with pytest.raises(ValueError, match=f"{field}: expected a name without control characters") as error:
        read_pair(path)
    assert "\x1b" not in str(error.value)


def test_a_log_with_control_characters_in_its_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a\x1b[2J.log"
    path.write_text("FLASER 3 1 1 1 0 0 0 0 0 0 1 host 1\nFLASER 3 1 1 1 0 0 0 0 0 0 2 host 2\n")
    with pytest.raises(ValueError, match="file name: expected a name without control characters"):
        read_recording(path)
