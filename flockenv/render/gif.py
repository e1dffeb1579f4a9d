"""Write frames to GIF and PNG files, with one frame in memory at a time.

Pillow's GIF writer stores all frames until the end. Here Pillow encodes each frame as a single picture, and its blocks
are appended to the file in the order of the GIF89a specification (CompuServe, 1990).
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flockenv.core.atomic_files import replace_file
from flockenv.model.snapshot import Snapshot
from flockenv.render.picture import draw

__all__ = ["gif_bytes", "side_by_side", "write_gif", "write_png"]

Pixels = NDArray[np.uint8]

MOST_FPS: Final = 50.0
"""Most frames per second: viewers replace delays shorter than 2/100 s by 10/100 s."""

_MOST_SIDE: Final = 65535
#: Least and most colours of a PNG that is reduced.
_COLOURS: Final = (16, 256)
#: Numbers of colours of a frame, the first that is enough, and how Pillow chooses them. The next index is that of
#: pixels that are as in the frame before (transparent): with 63 colours the table has a quarter of the size.
_PALETTES: Final = ((63, Image.Quantize.MAXCOVERAGE), (255, Image.Quantize.MEDIANCUT))
#: Largest error of a colour channel, of 255, with a smaller palette or that of the frame before.
_TOLERANCE: Final = 40


def write_gif(path: str | os.PathLike[str], frames: Iterable[Pixels], fps: float) -> int:
    """Write frames, (H, W, 3) uint8, as a GIF that repeats endlessly; return the number of frames.

    path: of the file; a file of that name is replaced.

    fps: 0 < fps <= 50; delays are in hundredths of a second, rounded so that the total duration is right.
    The file is written completely or not at all, and memory does not grow with the number of frames.
    Raises ValueError or TypeError for an fps out of range, without a frame, or for frames of different shapes.
    """
    _check_fps(fps)
    with replace_file(path) as file:
        return _write_frames(file, frames, float(fps))


def gif_bytes(frames: Iterable[Pixels], fps: float) -> bytes:
    """Return the content of the GIF that `write_gif` writes."""
    _check_fps(fps)
    buffer = BytesIO()
    _write_frames(buffer, frames, float(fps))
    return buffer.getvalue()


def side_by_side(
    films: Sequence[Sequence[Snapshot]], size: int, fps: float, shown: Sequence[int] | None = None
) -> Iterator[Pixels]:
    """Draw the snapshots of several films beside each other; a film that has ended shows its last snapshot.

    size: width of the picture of one film, pixels. fps: snapshots per second. shown: their indices (default: all).
    """
    behind = math.ceil(fps * max((look.trail for film in films for look in film[0].looks), default=0.0))
    for k in range(max(map(len, films))) if shown is None else shown:
        pictures = []
        for film in films:
            at = min(k, len(film) - 1)
            pictures.append(draw(film[at], size=size, trails=film[max(0, at - behind) : at], all_trails=False))
        yield np.hstack(pictures)


def write_png(path: str | os.PathLike[str], frame: Pixels, colours: int | None = None) -> None:
    """Write one frame, (H, W, 3) uint8, as PNG; the file is written completely or not at all.

    path: of the file; a file of that name is replaced.

    colours: reduce the picture to this many, 16 to 256, which makes drawings a third as large (default: all).
    Raises ValueError or TypeError for colours out of range, or for another frame, before anything is written.
    """
    _check_frame(frame, "frame")
    _check_colours(colours)
    picture = Image.fromarray(frame)
    if colours is not None:
        picture = _reduced(picture, colours)
    with replace_file(path) as file:
        picture.save(file, "PNG", optimize=True)


def _reduced(picture: Image.Image, colours: int) -> Image.Image:
    """Return a picture in few colours: its 8 most frequent ones, so that areas keep theirs, and some that cover all.

    Pillow would map pixels to a palette by the highest 6 bits of each channel only.
    """
    pixels = np.asarray(picture).reshape(-1, 3)
    found, place, count = np.unique(pixels, axis=0, return_inverse=True, return_counts=True)
    some = picture.quantize(colours - 8, method=Image.Quantize.MAXCOVERAGE).getpalette() or []
    palette = np.concatenate([found[np.argsort(-count)[:8]], np.reshape(some, (-1, 3))]).astype(np.int32)
    distance = ((found[:, None].astype(np.int32) - palette) ** 2).sum(axis=2)
    index = distance.argmin(axis=1).astype(np.uint8)[place.ravel()]
    reduced = Image.frombytes("P", picture.size, index.tobytes())
    reduced.putpalette(palette.astype(np.uint8).tobytes())
    return reduced


def _write_frames(file: BinaryIO, frames: Iterable[Pixels], fps: float) -> int:
    previous: Image.Image | None = None
    count = 0
    for frame in frames:
        _check_frame(frame, f"frame {count}", like=previous)
        if previous is None:
            file.write(_file_header(width=frame.shape[1], height=frame.shape[0]))
        picture = _to_palette(frame, previous)
        # Instants are rounded, not delays, so that the total duration is right.
        delay = round((count + 1) * 100.0 / fps) - round(count * 100.0 / fps)
        file.write(_frame_blocks(_keep_changes(picture, previous), delay))
        previous = picture
        count += 1
    if not count:
        raise ValueError("frames: there must be at least one, got none")
    file.write(b"\x3b")
    return count


def _check_fps(fps: object) -> None:
    if isinstance(fps, bool) or not isinstance(fps, int | float):
        raise TypeError(f"fps: must be a number, got {fps!r}")
    if not (math.isfinite(fps) and 0.0 < fps <= MOST_FPS):
        raise ValueError(f"fps: must be above 0 and at most {MOST_FPS:g} (GIF viewers slow down beyond), got {fps:g}")


def _check_colours(colours: object) -> None:
    low, high = _COLOURS
    if colours is None or (isinstance(colours, int) and low <= colours <= high):
        return
    raise ValueError(f"colours: must be an integer from {low} to {high}, got {colours!r}")


def _check_frame(frame: object, name: str, like: Image.Image | None = None) -> None:
    if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8:
        got = f"{frame.dtype} array" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise TypeError(f"{name}: must be a uint8 array (height, width, 3), got {got}")
    if frame.ndim != 3 or frame.shape[2] != 3 or not 0 < min(frame.shape) <= max(frame.shape) <= _MOST_SIDE:
        raise ValueError(f"{name}: must have shape (height, width, 3), got {frame.shape}")
    if like is not None and frame.shape[1::-1] != like.size:
        raise ValueError(f"{name}: must have the shape of frame 0, {(*like.size[::-1], 3)}, got {frame.shape}")


def _to_palette(frame: Pixels, previous: Image.Image | None) -> Image.Image:
    """Return the frame in few colours: those of `previous` if they are close enough, so that nothing flickers."""
    picture = Image.fromarray(frame)
    if previous is not None:
        mapped = picture.quantize(palette=previous, dither=Image.Dither.NONE)
        kept = np.asarray(mapped).max() < _unchanged(previous)  # not the black with which Pillow fills palettes
        if kept and _is_close(mapped, frame):
            mapped.putpalette(previous.getpalette() or [])
            return mapped
    for colours, method in _PALETTES:
        mapped = picture.quantize(colours, method=method, dither=Image.Dither.NONE)
        if _is_close(mapped, frame):
            break
    palette = [*(mapped.getpalette() or []), *[0] * (3 * colours)]
    mapped.putpalette([*palette[: 3 * colours], 0, 0, 0])  # the last one is that of unchanged pixels
    return mapped


def _is_close(mapped: Image.Image, frame: Pixels) -> bool:
    error = np.abs(np.asarray(mapped.convert("RGB"), dtype=np.int16) - frame)
    return bool(error.max() <= _TOLERANCE)


def _unchanged(picture: Image.Image) -> int:
    """Return the colour index of pixels that are as in the frame before: the last one."""
    return len(picture.getpalette() or []) // 3 - 1


def _keep_changes(picture: Image.Image, previous: Image.Image | None) -> Image.Image:
    """Return the picture with unchanged pixels transparent, which halves its size in the file."""
    if previous is None or previous.getpalette() != picture.getpalette():
        return picture
    index = np.asarray(picture)
    changes = Image.fromarray(np.where(index == np.asarray(previous), np.uint8(_unchanged(picture)), index))
    changes.putpalette(picture.getpalette() or [])
    return changes


def _file_header(width: int, height: int) -> bytes:
    """Return the beginning of the file: header, logical screen without a colour table, and the endless loop."""
    screen = struct.pack("<6sHHBBB", b"GIF89a", width, height, 0x70, 0, 0)
    return screen + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _frame_blocks(picture: Image.Image, delay: int) -> bytes:
    """Return the blocks of one frame: its delay, 1/100 s, then the image with its own colour table."""
    buffer = BytesIO()
    picture.save(buffer, "GIF", interlace=0, optimize=False)
    content = buffer.getvalue()
    size = content[10] & 0x07  # the colour table behind the 13 bytes of header and screen has 2^(size + 1) colours
    end = 13 + 3 * 2 ** (size + 1)
    table, start = content[13:end], end
    while content[start] == 0x21:  # extensions that Pillow put before the image
        start += 2
        while content[start]:
            start += 1 + content[start]
        start += 1
    control = struct.pack("<BBBBHBB", 0x21, 0xF9, 4, 0x05, delay, _unchanged(picture), 0)
    descriptor = content[start : start + 9] + bytes([0x80 | size])
    return control + descriptor + table + content[start + 10 : -1]
