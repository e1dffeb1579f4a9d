"""Write frames to MP4 and animated WebP files.

MP4 is encoded by the ffmpeg of the package imageio-ffmpeg (extra `video`), with one frame in memory at a time. WebP is
encoded by Pillow, which keeps all frames in memory.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import replace_file

__all__ = ["require_encoder", "write_mp4", "write_webp"]

Pixels = NDArray[np.uint8]

QUALITY = 7
"""Quality of an MP4, 0 to 10, by which imageio-ffmpeg finds the bit rate; text stays legible."""

WEBP_QUALITY = 80


def require_encoder(suffix: str) -> None:
    """Raise ValueError, in one line, if files of a suffix need a package that is missing."""
    if suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise ValueError("an MP4 needs the package imageio-ffmpeg: pip install 'flockenv[video]'") from None


def write_mp4(path: str | os.PathLike[str], frames: Iterable[Pixels], fps: float) -> int:
    """Write frames, (H, W, 3) uint8 and all of one shape, as MP4 (H.264); return the number of frames.

    An odd width or height gets a further column or row, as H.264 needs even ones. The file is written completely or not
    at all.
    Raises ValueError without imageio-ffmpeg, or without a frame.
    """
    require_encoder(".mp4")
    import imageio_ffmpeg

    first, rest = _first_and_rest(frames)
    count, size = 0, (first.shape[1] + first.shape[1] % 2, first.shape[0] + first.shape[0] % 2)
    with TemporaryDirectory(prefix="flockenv-video-") as folder:
        film = Path(folder) / "film.mp4"
        writer = imageio_ffmpeg.write_frames(
            str(film), size, fps=fps, quality=QUALITY, macro_block_size=1, output_params=["-movflags", "+faststart"]
        )
        writer.send(None)
        try:
            for frame in itertools.chain([first], rest):
                writer.send(np.ascontiguousarray(_even(frame)))
                count += 1
        finally:
            writer.close()
        with replace_file(path) as file:
            file.write(film.read_bytes())
    return count


def write_webp(path: str | os.PathLike[str], frames: Iterable[Pixels], fps: float) -> int:
    """Write frames, (H, W, 3) uint8 and all of one shape, as a WebP that repeats endlessly; return their number.

    Durations are whole milliseconds, rounded so that the total is right. The file is written completely or not at all.
    Raises ValueError without a frame.
    """
    from PIL import Image

    first, rest = _first_and_rest(frames)
    pictures = [Image.fromarray(frame) for frame in itertools.chain([first], rest)]
    instants = [round(1000 * k / fps) for k in range(len(pictures) + 1)]
    durations = [after - before for before, after in itertools.pairwise(instants)]
    with replace_file(path) as file:
        pictures[0].save(
            file, "WEBP", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=WEBP_QUALITY,
        )  # fmt: skip
    return len(pictures)


def _first_and_rest(frames: Iterable[Pixels]) -> tuple[Pixels, Iterator[Pixels]]:
    """Return the first frame and an iterator of the others; raise ValueError if there is none."""
    rest = iter(frames)
    first = next(rest, None)
    if first is None:
        raise ValueError("frames: there must be at least one, got none")
    return first, rest


def _even(frame: Pixels) -> Pixels:
    """Return a frame of even height and width: the last row or column is repeated if needed."""
    return np.pad(frame, [(0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)], mode="edge")
