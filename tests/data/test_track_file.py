"""Files of tracks keep what was written, and a wrong line is named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.track_file import COLUMNS, read_tracks, writing_tracks
from torchcrf_scan.result import MovingObject

METRES = st.floats(-1e4, 1e4)


def thing(number: int, *, x: float = 1.0, y: float = 2.0, heading: float = 0.5, points: int = 7) -> MovingObject:
    return MovingObject(number, np.array([x, y]), np.array([1.5, -0.25]), np.eye(4), heading, (4.2, 1.8), points, 3.0)


@given(st.lists(st.tuples(st.floats(0, 2e9), st.integers(1, 10**9), METRES, METRES, st.integers(0, 5000)), max_size=5))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, int, float, float, int]]
) -> None:
    path = tmp_path_factory.mktemp("tracks") / "tracks.csv"
    with writing_tracks(path) as write:
        for stamp, number, x, y, points in rows:
            write(stamp, [thing(number, x=x, y=y, points=points)])
    table = read_tracks(path)
    assert len(table) == len(rows)
    np.testing.assert_allclose(table.stamp, [row[0] for row in rows], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(table.number, [row[1] for row in rows])
    np.testing.assert_allclose(table.position, np.array([row[2:4] for row in rows]).reshape(-1, 2), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(table.points, [row[4] for row in rows])


def test_the_lines_of_a_scan(tmp_path: Path) -> None:
    with writing_tracks(tmp_path / "tracks.csv") as write:
        write(1.25, [thing(3), thing(4, points=0)])
        write(1.35, [])
    header, first, second = (tmp_path / "tracks.csv").read_text().splitlines()
    assert header == ",".join(COLUMNS) == "stamp,id,x,y,heading,vx,vy,length,width,points"
    assert first == "1.250000000,3,1.000000,2.000000,0.500000,1.500000,-0.250000,4.200000,1.800000,7"
    assert second.startswith("1.250000000,4,")
    table = read_tracks(tmp_path / "tracks.csv")
    np.testing.assert_array_equal(table.extent, [[4.2, 1.8]] * 2)
    np.testing.assert_array_equal(table.velocity, [[1.5, -0.25]] * 2)


def test_a_run_that_ends_with_an_error_leaves_the_file_before(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("before")

    def run() -> None:
        with writing_tracks(path) as write:
            write(1.0, [thing(1)])
            raise RuntimeError("no power")

    with pytest.raises(RuntimeError, match="power"):
        run()
    assert path.read_text() == "before"
    assert [of.name for of in tmp_path.iterdir()] == ["tracks.csv"]


def test_other_orders_and_further_columns(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("kind," + ",".join(reversed(COLUMNS)) + "\ncar,9,8,7,6,5,4,3,2,1,0\n\n")
    table = read_tracks(path)
    assert (table.stamp[0], table.number[0], table.points[0]) == (0, 1, 9)
    np.testing.assert_array_equal(table.position, [[2, 3]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: expected the columns stamp, id"),
        ("stamp,id\n1,2\n", "line 1: .* got none named x, y"),
        (",".join(COLUMNS) + "\n1,2\n", "line 2: expected at least 10 fields, got 2"),
        (",".join(COLUMNS) + "\n1,2,3,4,5,6,7,8,nan,10\n", "line 2: width: expected a finite number, got 'nan'"),
        (",".join(COLUMNS) + "\n1,2.5,3,4,5,6,7,8,9,10\n", "line 2: id: expected a whole number, got '2.5'"),
        (",".join(COLUMNS) + "\n1,99999999999999999999,3,4,5,6,7,8,9,10\n", "line 2: id: expected a whole number, got '9{20}'"),
    ],
)
def test_a_wrong_file_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        read_tracks(path)
    assert str(path) in str(raised.value)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="expected a CSV file of tracks"):
        read_tracks(tmp_path / "tracks.csv")
