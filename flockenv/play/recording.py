"""Recording of a room while it plays, as a replay in one file or as a GIF."""

from __future__ import annotations

import dataclasses
import math
import threading
from itertools import pairwise

from flockenv.model.snapshot import Snapshot
from flockenv.play.lane import Lane
from flockenv.play.room import Room
from flockenv.render.gif import MOST_FPS, gif_bytes, side_by_side
from flockenv.render.replay import Group, Panel, replay_page

__all__ = ["FRAMES", "LARGEST", "PICTURES", "Recording"]

FRAMES = 25.0
"""Frames per second of the world."""

PICTURES = 200
"""Most frames of a GIF; of a longer recording every second snapshot is drawn, or fewer."""

WIDTH = 640
"""Width of a GIF, pixels."""

LARGEST = 40_000_000
"""Most numbers of positions in a recording; it ends there."""


class Recording:
    """Snapshots of the lanes of a room, from now on, 25 per second of the world.

    If time goes back, or the agents change, what was recorded before is dropped. `take` may run beside `page` and
    `gif`, which use what has been taken before.
    """

    def __init__(self, room: Room, names: list[str]) -> None:
        self._room, self._names, self._lock = room, names, threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._shots: list[list[Snapshot]] = [[] for _ in self._room.lanes]
        self._returns: list[list[float]] = [[] for _ in self._room.lanes]
        self._size = 0

    @property
    def is_full(self) -> bool:
        """True if it ends because it is too large."""
        return self._size >= LARGEST

    @property
    def seconds(self) -> float:
        """Time of the world that it covers, s."""
        first = self._shots[0]
        return first[-1].time - first[0].time if first else 0.0

    def take(self) -> None:
        """Take a snapshot of each lane if one is due."""
        with self._lock:
            self._take()

    def _take(self) -> None:
        first = self._shots[0]
        time = self._room.lanes[0].time
        if first and (time < first[-1].time - 1e-9 or not _are_alike(first[-1], self._room.lanes[0])):
            self._begin()
        elif first and time < first[-1].time + 1.0 / FRAMES - 1e-9:
            return
        if self.is_full:
            return
        for k, lane in enumerate(self._room.lanes):
            if self._shots[k] and lane.time <= self._shots[k][-1].time:
                continue  # it has ended
            shot = lane.snapshot()
            low, high = (self._shots[k][0].low, self._shots[k][0].high) if self._shots[k] else (shot.low, shot.high)
            self._shots[k].append(dataclasses.replace(shot, low=low, high=high))
            self._returns[k].append(lane.returns or 0.0)
            self._size += shot.pos.size

    def gif(self) -> bytes:
        """Return the lanes side by side as a GIF, worlds in 3-D from above; ValueError if nothing was recorded."""
        films = [panel.snapshots for panel in self._panels()]
        every = math.ceil(max(map(len, films)) / PICTURES)
        drawn = [film[::every] for film in films]
        longest = max(drawn, key=lambda film: len(film))
        gaps = [after.time - before.time for before, after in pairwise(longest)]
        fps = min(len(gaps) / sum(gaps), MOST_FPS) if gaps else FRAMES
        return gif_bytes(side_by_side(drawn, WIDTH // len(films), fps), fps)

    def page(self, title: str) -> str:
        """Return the replay as HTML; ValueError if nothing was recorded."""
        return replay_page([Group(title, self._panels())], title).decode()

    def _panels(self) -> list[Panel]:
        """Return what was recorded of each lane."""
        with self._lock:
            if not self._shots[0]:
                raise ValueError("record: nothing was recorded; let time pass first")
            every = zip(self._names, self._shots, self._returns, self._room.lanes, strict=True)
            return [
                Panel(
                    name, [dataclasses.replace(shot, title=name) for shot in shots],
                    returns if lane.returns is not None else None, lane.stopped,
                )
                for name, shots, returns, lane in every
            ]  # fmt: skip


def _are_alike(shot: Snapshot, lane: Lane) -> bool:
    """Return True if a lane has as many agents as a snapshot of it."""
    return shot.pos.shape == lane.drawn.pos.shape[::-1]
