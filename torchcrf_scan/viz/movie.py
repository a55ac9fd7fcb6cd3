"""Movies: MP4 by the ffmpeg that comes with imageio-ffmpeg, frames piped as they come; GIF by Pillow, kept short."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.viz.canvas import Image
from torchcrf_scan.viz.frames import SEEN, STATUS_COLORS
from torchcrf_scan.viz.marks import INK, MOVERS
from torchcrf_scan.whole_file import whole_path

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

ENDINGS = (".mp4", ".gif")
RATES = (8.0, 25.0)  # frames a second, the fewest and the most
GIF_FRAMES = 400  # at most; of more every second one is left out
QUALITY = 7.0  # of imageio-ffmpeg, 1 to 10
SHADES = 12  # of every colour in the palette of a GIF

Write = Callable[[Image], None]


def can_write_mp4() -> bool:
    """Whether the extra `movie` is installed."""
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        return False
    return True


def check_movie(option: str, path: str | Path) -> Path:
    """The path of a movie that can be written here; raises TorchCRFScanError otherwise."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise TorchCRFScanError(f"{option}: expected a name ending in {' or '.join(ENDINGS)}, got {path}")
    if ending == ".mp4" and not can_write_mp4():
        raise TorchCRFScanError(
            f"{option}: expected the extra torchcrf-scan[movie] to be installed, or a name ending in .gif, got {path}"
        )
    return Path(path)


def pace(seconds: float, speed: float) -> tuple[float, int]:
    """Frames a second, and of how many scans one is drawn, for scans `seconds` apart shown at `speed` times their own."""
    wanted = speed / seconds
    every = max(math.ceil(wanted / RATES[1] - 1e-9), 1)
    return max(wanted / every, RATES[0]), every


@contextmanager
def writing_movie(path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    """A movie under construction; yields `write(image)`. The file is there when the block ends, and only if it ends without error.

    Args:
        path: ends in .mp4 or .gif.
        size: (width, height), even numbers.
        rate: frames a second.
    """
    with whole_path(path) as temporary:
        writing = _writing_gif if path.suffix.lower() == ".gif" else _writing_mp4
        with writing(temporary, size, rate) as write:
            yield write


@contextmanager
def _writing_mp4(path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    """Pipes frames to ffmpeg, which is not in our process group: Ctrl-C stops us, and we end the movie."""
    from imageio_ffmpeg import count_frames_and_secs, write_frames

    output = ["-preset", "veryfast", "-movflags", "+faststart", "-f", "mp4"]
    frames = write_frames(
        str(path),
        size,
        fps=rate,
        quality=QUALITY,
        codec="libx264",
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=output,
    )
    frames.send(None)
    count = 0

    def write(image: Image) -> None:
        nonlocal count
        frames.send(np.ascontiguousarray(image))
        count += 1

    try:
        yield write
    finally:
        frames.close()
    try:  # imageio-ffmpeg keeps it to itself when ffmpeg fails, e.g. because the disk is full
        written, _ = count_frames_and_secs(path) if count else (0, 0)
    except RuntimeError as error:
        raise OSError(f"{path}: expected ffmpeg to write a movie, got one that cannot be read; is the disk full?") from error
    if written != count or not count:
        raise OSError(f"{path}: expected ffmpeg to write {max(count, 1)} pictures, got {written}")


@contextmanager
def _writing_gif(path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    """Keeps the frames with few colours until the end."""
    from PIL import Image as Images

    frames: list[Picture] = []
    palette, stride, count = _palette(), 1, 0

    def write(image: Image) -> None:
        nonlocal count, stride
        if count % stride == 0:
            if len(frames) == GIF_FRAMES:
                del frames[1::2]
                stride *= 2
            if count % stride == 0:
                frames.append(Images.fromarray(image).quantize(palette=palette, dither=Images.Dither.NONE))
        count += 1

    yield write
    if frames:
        milliseconds = max(round(100 / rate), 2) * 10  # in a GIF a hundredth of a second is the unit, and 1 is played as 10
        first, *others = frames
        first.save(path, format="GIF", save_all=True, append_images=others, duration=milliseconds, loop=0)


def _palette() -> Picture:
    """The colours of the frames and their mixtures with white, and black with white."""
    from matplotlib.colors import to_rgb
    from PIL import Image as Images

    colors = [to_rgb(color) for color in (INK, SEEN, *STATUS_COLORS.values(), *MOVERS)]
    shares = np.linspace(0, 1, SHADES, endpoint=False)[:, None, None]
    greys = np.append(np.linspace(0, 0.95, 32), 1.0)  # nothing close to white, for which Pillow would take it
    mixed = np.concatenate([(np.array(colors) * (1 - shares) + shares).reshape(-1, 3), greys[:, None].repeat(3, axis=1)])
    picture = Images.new("P", (1, 1))
    picture.putpalette((255 * mixed[:256]).round().astype(np.uint8).tobytes())
    return picture
