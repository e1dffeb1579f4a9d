"""write_gif() and write_png(): frames into files, one frame in memory at a time.

Pillow's own GIF writer keeps every frame until the end; here each one is encoded by Pillow as a picture of its own and
its blocks are put behind one another, as the GIF89a specification (W3C, 1990) lays a file out.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterable
from io import BytesIO
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flockenv.core.atomic_files import replace_file

__all__ = ["write_gif", "write_png"]

Pixels = NDArray[np.uint8]

#: Viewers play delays under 2/100 s as 10/100 s.
_MOST_FPS: Final = 50.0
_MOST_SIDE: Final = 65535
#: The index that stands for "as before", transparent; colours take those below.
_SAME: Final = 255
#: A frame's colour that is further than this from the palette in use (of 255, any channel) is worth a new palette.
_TOLERANCE: Final = 40


def write_gif(path: str | os.PathLike[str], frames: Iterable[Pixels], fps: float) -> int:
    """Write frames (H, W, 3) uint8, one after the other, as an endless GIF and return their number.

    fps: 0 < fps <= 50; delays are whole hundredths of a second, rounded so that the sum stays right.
    The file appears whole or not at all, and memory does not grow with the number of frames.
    Raises ValueError or TypeError on an fps out of range, no frame at all, or frames of different shapes.
    """
    if isinstance(fps, bool) or not isinstance(fps, int | float):
        raise TypeError(f"fps: must be a number, got {fps!r}")
    if not (math.isfinite(fps) and 0.0 < fps <= _MOST_FPS):
        raise ValueError(f"fps: must be above 0 and at most {_MOST_FPS:g} (GIF viewers slow down beyond), got {fps:g}")
    with replace_file(path) as file:
        return _stream(file, frames, float(fps))


def write_png(path: str | os.PathLike[str], frame: Pixels) -> None:
    """Write one frame (H, W, 3) uint8 as PNG; the file appears whole or not at all."""
    _check(frame, "frame")
    with replace_file(path) as file:
        Image.fromarray(frame).save(file, "PNG")


def _stream(file: BinaryIO, frames: Iterable[Pixels], fps: float) -> int:
    before: Image.Image | None = None
    count = 0
    for frame in frames:
        _check(frame, f"frame {count}", like=before)
        if before is None:
            file.write(_opening(width=frame.shape[1], height=frame.shape[0]))
        indexed = _indexed(frame, before)
        # Rounding the instants, not the delays, keeps the whole as long as it should be.
        delay = round((count + 1) * 100.0 / fps) - round(count * 100.0 / fps)
        file.write(_blocks(_news(indexed, before), delay))
        before = indexed
        count += 1
    if not count:
        raise ValueError("frames: there must be at least one, got none")
    file.write(b"\x3b")
    return count


def _check(frame: object, name: str, like: Image.Image | None = None) -> None:
    if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8:
        got = f"{frame.dtype} array" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise TypeError(f"{name}: must be a uint8 array (height, width, 3), got {got}")
    if frame.ndim != 3 or frame.shape[2] != 3 or not 0 < min(frame.shape) <= max(frame.shape) <= _MOST_SIDE:
        raise ValueError(f"{name}: must have shape (height, width, 3), got {frame.shape}")
    if like is not None and frame.shape[1::-1] != like.size:
        raise ValueError(f"{name}: must have the shape of frame 0, {(*like.size[::-1], 3)}, got {frame.shape}")


def _indexed(frame: Pixels, before: Image.Image | None) -> Image.Image:
    """Return the frame in 255 colours: in those of `before` as long as they do, so that nothing flickers."""
    picture = Image.fromarray(frame)
    if before is not None:
        same = picture.quantize(palette=before, dither=Image.Dither.NONE)
        error = np.abs(np.asarray(same.convert("RGB"), dtype=np.int16) - frame)
        if error.max() <= _TOLERANCE:
            return same
    return picture.quantize(_SAME, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def _news(indexed: Image.Image, before: Image.Image | None) -> Image.Image:
    """Return the frame with everything left transparent that is as before: that packs into half the bytes."""
    if before is None or before.getpalette() != indexed.getpalette():
        return indexed
    index = np.asarray(indexed)
    news = Image.fromarray(np.where(index == np.asarray(before), np.uint8(_SAME), index))
    news.putpalette(_padded(indexed))
    return news


def _padded(indexed: Image.Image) -> list[int]:
    palette = indexed.getpalette() or []
    return palette + [0] * (3 * (_SAME + 1) - len(palette))


def _opening(width: int, height: int) -> bytes:
    """Return header, logical screen without a colour table, and the extension for an endless loop."""
    screen = struct.pack("<6sHHBBB", b"GIF89a", width, height, 0x70, 0, 0)
    return screen + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _blocks(indexed: Image.Image, delay: int) -> bytes:
    """Return the blocks of one frame: its delay (1/100 s), then the image with a colour table of its own."""
    buffer = BytesIO()
    indexed.save(buffer, "GIF", interlace=0, optimize=False)
    whole = buffer.getvalue()
    size = whole[10] & 0x07  # the colour table behind the 13 bytes of header and screen has 2^(size + 1) colours
    end = 13 + 3 * 2 ** (size + 1)
    table, start = whole[13:end], end
    while whole[start] == 0x21:  # extensions that Pillow put before the image
        start += 2
        while whole[start]:
            start += 1 + whole[start]
        start += 1
    control = struct.pack("<BBBBHBB", 0x21, 0xF9, 4, 0x05, delay, _SAME, 0)
    descriptor = whole[start : start + 9] + bytes([0x80 | size])
    return control + descriptor + table + whole[start + 10 : -1]
