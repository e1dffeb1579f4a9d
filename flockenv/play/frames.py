"""Frames: what a page draws of a room at one instant, as bytes.

A frame is little-endian: u32 MAGIC; u32 H, the length of the header in bytes, a multiple of 4; the header, JSON padded
with spaces; then the blocks of each lane in the order of the header's `blocks`, each padded with zeros to a multiple of
4 bytes. A lane's header has n, dimension, time, low, high (the region of its positions, m), returns, stopped, apart and
`scenery`: [key] or, if the page does not have that key yet, [key, obstacles and marks]; `broken`: the indices of broken
bonds, if springs break. Blocks:

* pos: u16 (D, N), levels over [low, high] and half of its size on each side, see flockenv/render/quantise.py;
* heading: u8 (N,), 0 to 253 anticlockwise from +x, 254 at rest, 255 not shown;
* tilt: i8 (N,), only in 3-D: the angle above the x-y plane, -127 to 127 for -90 to 90 degrees;
* shade: u8 (N,), the place of the quantity that colours show in its range;
* identity: u16 (N,), only with births: the number of the agent in this slot, modulo 65536; a new one was just born;
* field: u8 (ny, nx), a quantity on a grid over [low, high], from the lowest row up, 255 for its maximum;
* arrows: i8 (2, ny, nx), of a flow its direction and size on that grid, along x and along y, 127 for the maximum.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.record import Record
from flockenv.play.edits import MOST_LANES
from flockenv.play.fields import Coloured, colour_of, grid_of
from flockenv.play.lane import Drawn, Lane
from flockenv.play.room import Room
from flockenv.render.quantise import quantise_headings, quantise_positions
from flockenv.render.replay import scenery_data

__all__ = ["MAGIC", "Want", "decode_frame", "encode_frame"]

MAGIC: Final = 0x0146_4C46
"""The letters FLF and the version of the format, 1."""

_TYPES: Final = {
    "pos": "<u2",
    "heading": "u1",
    "tilt": "i1",
    "shade": "u1",
    "identity": "<u2",
    "field": "u1",
    "arrows": "i1",
}


class Want(Record):
    """What a page wants of a frame."""

    colour: str = Field(default="", max_length=60, description="quantity that colours show (default: appearances)")
    field: str = Field(default="", max_length=60, description="quantity on a grid: density or flow (default: none)")
    scenery: tuple[int, ...] = Field(default=(), max_length=MOST_LANES, description="key of each lane's scenery")


def encode_frame(room: Room, want: Want | None = None) -> bytes:
    """Return a frame of the present state; raise ValueError, in one line, for a quantity that there is not."""
    want = want or Want()
    apart, lanes, blocks = room.apart, [], list[NDArray[Any]]()
    for k, lane in enumerate(room.lanes):
        have = want.scenery[k] if k < len(want.scenery) else -1
        about, arrays = _lane_frame(lane, want, have)
        lanes.append({**about, "apart": apart[k], "blocks": list(arrays)})
        blocks += arrays.values()
    head = {
        "tick": room.tick, "last": room.last, "time": room.lanes[0].time, "playing": room.playing, "speed": room.speed,
        "version": room.version, "lanes": lanes,
    }  # fmt: skip
    text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    parts = [np.array([MAGIC, len(text)], "<u4").tobytes(), text]
    for block in blocks:
        data = block.tobytes()
        parts += [data, b"\0" * (-len(data) % 4)]
    return b"".join(parts)


def _lane_frame(lane: Lane, want: Want, have: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return the header and the blocks of a lane."""
    drawn = lane.drawn
    d, n = drawn.pos.shape
    arrays: dict[str, NDArray[Any]] = {
        "pos": quantise_positions(drawn.pos, drawn.low, drawn.high),
        "heading": quantise_headings(drawn.aim, drawn.alive),
    }
    about: dict[str, Any] = {
        "n": n, "dimension": d, "time": drawn.time, "low": drawn.low, "high": drawn.high, "returns": lane.returns,
        "stopped": lane.stopped, "scenery": _scenery(lane, have),
    }  # fmt: skip
    if drawn.broken is not None:
        about["broken"] = np.flatnonzero(drawn.broken).tolist()
    if d == 3:
        arrays["tilt"] = _tilt(drawn)
    coloured = colour_of(lane, want.colour) if want.colour else None
    if coloured is not None:
        arrays["shade"] = _shade(coloured)
        about["colour"] = {"name": want.colour, "unit": coloured.unit, "low": coloured.low, "high": coloured.high}
    elif drawn.shade is not None:
        arrays["shade"] = np.rint(255 * drawn.shade).astype(np.uint8)
    if drawn.identity is not None:
        arrays["identity"] = drawn.identity.astype(np.uint16)
    if want.field:
        grid = grid_of(lane, want.field)
        arrays["field"] = grid.levels
        if grid.arrows is not None:
            arrays["arrows"] = grid.arrows
        about["field"] = {"name": want.field, "unit": grid.unit, "high": grid.high, "shape": grid.levels.shape}
    return about, arrays


def _tilt(drawn: Drawn) -> NDArray[np.int8]:
    with np.errstate(invalid="ignore"):
        angle = np.arctan2(drawn.aim[2], np.hypot(drawn.aim[0], drawn.aim[1]))
    levels: NDArray[np.int8] = np.rint(angle * (127 * 2 / np.pi)).astype(np.int8)
    return levels


def _shade(coloured: Coloured) -> NDArray[np.uint8]:
    share = (np.nan_to_num(coloured.values) - coloured.low) / max(coloured.high - coloured.low, 1e-300)
    levels: NDArray[np.uint8] = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return levels


def _scenery(lane: Lane, have: int) -> list[Any]:
    """Return the key of a lane's obstacles and marks, and they themselves if the key is not `have`."""
    scenery = lane.scenery
    data = scenery_data(np.delete(scenery.circles, np.s_[2:-1], axis=1), scenery.outlines, scenery.marks)
    key = zlib.crc32(json.dumps(data).encode())
    return [key] if key == have else [key, data]


def decode_frame(frame: bytes) -> tuple[Mapping[str, Any], Sequence[Mapping[str, NDArray[Any]]]]:
    """Return the header and the blocks of each lane by name, with the shapes of this file's docstring."""
    magic, length = np.frombuffer(frame, "<u4", 2)
    if magic != MAGIC:
        raise ValueError("frame: does not begin with its magic number")
    head, at = json.loads(frame[8 : 8 + int(length)]), 8 + int(length)
    lanes = []
    for about in head["lanes"]:
        blocks = {}
        for name in about["blocks"]:
            grid = about.get("field", {}).get("shape", ())
            shapes = {"pos": (about["dimension"], about["n"]), "field": grid, "arrows": (2, *grid)}
            shape = shapes.get(name, (about["n"],))
            kind = np.dtype(_TYPES[name])
            count = int(np.prod(shape))
            blocks[name] = np.frombuffer(frame, kind, count, at).reshape(shape)
            at += count * kind.itemsize + -(count * kind.itemsize) % 4
        lanes.append(blocks)
    return head, lanes
