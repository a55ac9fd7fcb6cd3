"""Frames show what is there, and movies hold them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from results import lost, true_results

from torchcrf_scan.viz import movie
from torchcrf_scan.viz.frames import STATUS_COLORS, FramePainter
from torchcrf_scan.viz.marks import mover_look
from torchcrf_scan.viz.movie import check_movie, pace, writing_movie

SIZE = (320, 240)


def rgb(color: str) -> list[int]:
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


def count(image: np.ndarray, color: str) -> int:
    return int((image == rgb(color)).all(axis=-1).sum())


def drawn(is_in_world: bool) -> tuple[np.ndarray, list[int]]:
    painter, results = FramePainter(SIZE, in_world=is_in_world), true_results(12)
    for result in results:
        painter.add(result)
    return painter.draw(), [one.number for one in results[-1].objects]


@pytest.mark.parametrize("is_in_world", [True, False])
def test_a_frame_shows_objects_in_their_colours_and_the_status(is_in_world: bool) -> None:
    image, numbers = drawn(is_in_world)
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    assert (image == 255).mean() > 0.6
    assert count(image, STATUS_COLORS["ok"]) > 20
    assert any(count(image, mover_look(number)[0]) > 15 for number in numbers)


def test_what_is_lost_is_told_in_red() -> None:
    painter = FramePainter(SIZE)
    for result in true_results(3):
        painter.add(lost(result, "nothing explained " * 9))
    image = painter.draw()
    assert count(image, STATUS_COLORS["lost"]) > 200
    assert count(image, STATUS_COLORS["ok"]) == 0


def test_an_empty_scan_and_a_jump_are_drawn() -> None:
    painter, (first, second) = FramePainter(SIZE), true_results(2)
    painter.add(replace(first, scan=first.scan.only(np.zeros(len(first.scan), dtype=bool))))
    painter.draw()
    painter.add(replace(second, pose=np.array([1.0, 1e4, -1e4])))
    assert (painter.draw() != 255).any()


@pytest.mark.parametrize(
    ("seconds", "speed", "expected"),
    [(0.1, 1, (10, 1)), (0.025, 1, (20, 2)), (1.0, 1, (8, 1)), (0.1, 5, (25, 2)), (0.04, 1, (25, 1))],
)
def test_movies_keep_the_pace_of_the_recording(seconds: float, speed: float, expected: tuple[float, int]) -> None:
    assert pace(seconds, speed) == (pytest.approx(expected[0]), expected[1])


def frames(number: int) -> list[np.ndarray]:
    images = [np.full((240, 320, 3), 255, dtype=np.uint8) for _ in range(number)]
    for k, image in enumerate(images):
        image[:, : 2 * k + 2] = rgb(mover_look(1)[0])
    return images


def test_a_gif_holds_the_frames_in_their_colours(tmp_path: Path) -> None:
    with writing_movie(tmp_path / "a.gif", SIZE, 10.0) as write:
        for image in frames(9):
            write(image)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == 9
        assert picture.info["duration"] == 100
        picture.seek(8)
        np.testing.assert_allclose(np.asarray(picture.convert("RGB"))[5, 3], rgb(mover_look(1)[0]), atol=2)
        assert (np.asarray(picture.convert("RGB"))[:, 100:] == 255).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_a_long_gif_is_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(movie, "GIF_FRAMES", 8)
    with writing_movie(tmp_path / "a.gif", SIZE, 25.0) as write:
        for image in frames(30):
            write(image)
    with Image.open(tmp_path / "a.gif") as picture:
        assert 4 < picture.n_frames <= 8


def test_an_mp4_holds_the_frames(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the library imageio-ffmpeg is not installed (extra `movie`)")
    with writing_movie(tmp_path / "a.mp4", SIZE, 10.0) as write:
        for image in frames(20):
            write(image)
    number, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert (number, seconds) == (20, pytest.approx(2.0))
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_movie_that_fails_leaves_the_one_before(tmp_path: Path, name: str) -> None:
    if name == "a.mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the library imageio-ffmpeg is not installed (extra `movie`)")
    (tmp_path / name).write_bytes(b"before")

    def fail() -> None:
        with writing_movie(tmp_path / name, SIZE, 10.0) as write:
            write(frames(1)[0])
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fail()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"before"]


@pytest.mark.parametrize("length", [10, 0.5])
def test_a_movie_that_ffmpeg_cuts_is_told(tmp_path: Path, length: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a full disk: ffmpeg ends with an error, which imageio-ffmpeg keeps to itself."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the library imageio-ffmpeg is not installed (extra `movie`)")
    write_frames = ffmpeg.write_frames

    def cut(path: str, *arguments: Any, **options: Any) -> Iterator[None]:
        inner = write_frames(path, *arguments, **options)
        inner.send(None)
        try:
            while True:
                inner.send((yield))
        finally:
            inner.close()
            whole = Path(path).read_bytes()
            Path(path).write_bytes(whole[: int(length if length >= 1 else length * len(whole))])

    monkeypatch.setattr(ffmpeg, "write_frames", cut)

    def draw() -> None:
        with writing_movie(tmp_path / "a.mp4", SIZE, 10.0) as write:
            for frame in frames(5):
                write(frame)

    with pytest.raises(OSError, match=r"a\.mp4: expected ffmpeg to write"):
        draw()
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"--output: expected a name ending in \.mp4 or \.gif, got a\.avi"):
        check_movie("--output", "a.avi")
    monkeypatch.setattr(movie, "can_write_mp4", lambda: False)
    with pytest.raises(ValueError, match=r"expected the extra torchcrf-scan\[movie\]"):
        check_movie("--output", "a.mp4")
    assert check_movie("--output", "a.gif") == Path("a.gif")
