"""TUM lines: what is written is read, here and by evo."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.trajectory_file import Trajectory, read_trajectory, write_trajectory, writing_trajectory

POSE = st.tuples(st.floats(-3.14, 3.14), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))


@given(st.lists(st.tuples(st.floats(0, 2e9), POSE), max_size=5))
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    path = tmp_path_factory.mktemp("poses") / "poses.tum"
    poses = np.array([pose for _, pose in rows]).reshape(-1, 3)
    write_trajectory(path, Trajectory(np.array([stamp for stamp, _ in rows]), poses))
    found = read_trajectory(path)
    np.testing.assert_allclose(found.stamps, [stamp for stamp, _ in rows], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.poses, poses, rtol=0, atol=1e-8)


def test_evo_reads_the_same(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="needs evo (extra test)")
    poses = np.array([[0.3, 1.0, 2.0], [-3.0, 4.0, -5.0]])
    write_trajectory(tmp_path / "poses.tum", Trajectory(np.array([1600000000.25, 1600000000.5]), poses))
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "poses.tum")
    np.testing.assert_allclose(theirs.timestamps, [1600000000.25, 1600000000.5], rtol=0, atol=0)
    np.testing.assert_allclose(theirs.positions_xyz, [[1, 2, 0], [4, -5, 0]], atol=1e-9)
    np.testing.assert_allclose(
        [matrix[:2, 0] for matrix in theirs.poses_se3], [[np.cos(t), np.sin(t)] for t in (0.3, -3.0)], atol=1e-9
    )


def test_a_run_that_ends_with_an_error_leaves_the_file_before(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text("before")

    def run() -> None:
        with writing_trajectory(path) as write:
            write(0.0, np.zeros(3))
            raise RuntimeError("no power")

    with pytest.raises(RuntimeError, match="power"):
        run()
    assert path.read_text() == "before"


def test_comments_and_either_sign_of_a_quaternion(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text("# stamp x y z qx qy qz qw\n\n1 2 3 9 0 0 0.6 0.8 # a pose\n2 2 3 9 0 0 -0.6 -0.8\n")
    found = read_trajectory(path)
    np.testing.assert_allclose(found.poses, [[2 * np.arctan2(0.6, 0.8), 2, 3]] * 2)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3", "line 2: expected eight finite numbers .* got '1 2 3'"),
        ("1 2 3 0 0 0 nan 1", "line 2: expected eight finite numbers"),
        ("1 2 x 0 0 0 0 1", "line 2: expected eight finite numbers"),
        ("1 2 3 0 1 0 0 0", "line 2: expected a rotation about z"),
    ],
)
def test_a_wrong_line_is_named(line: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(ValueError, match=message) as raised:
        read_trajectory(path)
    assert str(path) in str(raised.value)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "poses.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="expected lines of text"):
        read_trajectory(tmp_path / "poses.tum")
