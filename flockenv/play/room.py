"""Room: one to four lanes of one seed and one clock, which people watch, change, stop, and go back in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flockenv.core.errors import printable
from flockenv.play.edits import MOST_LANES, Edit, Set
from flockenv.play.history import BUDGET, History, Made, targets
from flockenv.play.lane import Change, Lane

__all__ = ["SLICE", "SPEEDS", "Room"]

SPEEDS = (0.1, 16.0)
"""Least and greatest speed, in seconds of the world per second."""

SLICE = 0.02
"""s, longest time that `advance` computes by default before it returns."""


class Room:
    """Some worlds side by side.

    lanes: of equal seeds and equal intervals. budget: bytes for going back. clock: s, increasing.
    Methods that change something raise ValueError, in one line, before anything changes. They are not made for several
    threads at a time; `compile` and `prepare` alone may run beside them.
    """

    def __init__(self, lanes: Sequence[Lane], budget: int = BUDGET, clock: Callable[[], float] = perf_counter) -> None:
        self.lanes = tuple(lanes)
        if not 1 <= len(self.lanes) <= MOST_LANES:
            raise ValueError(f"lanes: there must be 1 to {MOST_LANES}, got {len(self.lanes)}")
        _check_one_clock(self.lanes)
        self.history = History(self.lanes, budget, clock)
        self.playing, self.speed = False, 1.0
        self.version = 0
        """Counts changes of records, players and obstacles: pages that know another version read the rest anew."""
        self._known = self._now()
        self._opened = tuple(lane.record for lane in self.lanes)
        self._clock = clock
        self._last_time = clock()
        self._due = 0.0  # ticks that are due, a part of one
        self._cost = 1e-3  # s per tick, estimated

    # --- the clock --------------------------------------------------------------------------------------------------

    @property
    def tick(self) -> int:
        """Ticks since the start."""
        return self.history.tick

    @property
    def last(self) -> int:
        """The latest tick that `seek` reaches: how far it has been played."""
        return self.history.last

    @property
    def interval(self) -> float:
        """Time of a tick, s."""
        return self.lanes[0].interval

    @property
    def ended(self) -> bool:
        """True if no lane makes another step."""
        return all(lane.stopped for lane in self.lanes)

    def play(self, on: bool = True) -> None:
        """Let time pass, or stop it."""
        self.playing = on
        self._last_time, self._due = self._clock(), 0.0

    def set_speed(self, speed: float) -> None:
        """Set the seconds of the world per second of the clock."""
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise ValueError(f"speed = {printable(speed)}: must be a number from {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self.speed = float(speed)

    def advance(self, seconds: float = SLICE) -> int:
        """Make the ticks that are due since the last call, for at most `seconds` s; return how many.

        What is due and takes longer is dropped: the room then runs slower than its speed, and never falls behind.
        """
        now = self._clock()
        passed, self._last_time = now - self._last_time, now
        if not self.playing or self.ended:
            self._due = 0.0
            return 0
        self._due += passed * self.speed / self.interval
        made = 0
        while self._due >= 1 and not self.ended:
            left = seconds - (self._clock() - now)
            if left <= 0:
                self._due = 0.0
                break
            chunk = max(1, min(int(self._due), int(left / self._cost)))
            began = self._clock()
            steps = self.history.advance(chunk)
            cost = max((self._clock() - began) / max(steps, 1), 1e-7)
            self._cost = max(cost, 0.7 * self._cost + 0.3 * cost)  # at once if steps take longer, slowly if shorter
            made, self._due = made + steps, self._due - steps
        self._count_changes()
        return made

    def step(self, ticks: int) -> None:
        """Make some ticks at once, or go back some; time stops."""
        self.play(False)
        end = self.tick + ticks
        if ticks < 0:
            self.history.go_to(end)
        while self.tick < end and not self.ended:
            self.history.advance(end - self.tick)
        self._count_changes()

    def seek(self, tick: int) -> None:
        """Go to a tick between 0 and `last`, exactly."""
        self.history.go_to(tick)
        self._count_changes()
        self._last_time, self._due = self._clock(), 0.0

    # --- changes ----------------------------------------------------------------------------------------------------

    def compile(self) -> None:
        """Compile what steps need, before the first one, in any thread."""
        for lane in self.lanes:
            lane.compile()

    def _now(self) -> tuple[Any, ...]:
        """Return the records of the lanes and their players."""
        return tuple((lane.record, getattr(lane, "players", ())) for lane in self.lanes)

    def _count_changes(self) -> None:
        """Count a version if records or players are others than before: by an edit, or as time went past one."""
        now = self._now()
        same = all(a is b and old == new for (a, old), (b, new) in zip(self._known, now, strict=True))
        self._known, self.version = now, self.version + (not same)

    def prepare(self, edit: Edit) -> None:
        """Compile what an edit needs, in a thread beside those that step; raise ValueError as `edit` does."""
        for lane in targets(self.lanes, edit):
            lane.prepare(edit)

    def edit(self, edit: Edit) -> Change:
        """Apply an edit now; if what a world begins with changes, all lanes begin again at their seed."""
        chosen = targets(self.lanes, edit)
        before = [lane.keep() for lane in chosen]
        done: list[Change] = []
        try:
            done += [lane.apply(edit) for lane in chosen]
            if isinstance(edit, Set):
                _check_one_clock(self.lanes)
        except ValueError:
            for lane, keyframe in zip(chosen, before, strict=True):
                lane.restore(keyframe)
            raise
        restarts = any(change.restarts for change in done)
        notices = tuple(dict.fromkeys(line for change in done for line in change.notices))
        if restarts:
            self.restart()
        else:
            self.history.record(edit)
        self.version += restarts or edit.kind.endswith("obstacle")  # in a task they are no part of its record
        self._count_changes()
        return Change(restarts, done[0].in_record, notices)

    def restart(self) -> None:
        """Begin again at the seed, with the records as they are now; edits that no record has are dropped."""
        for lane in self.lanes:
            lane.start()
        self._opened = tuple(lane.record for lane in self.lanes)
        self.history.begin()
        self.version += 1
        self._last_time, self._due = self._clock(), 0.0

    @property
    def opened(self) -> tuple[Any, ...]:
        """The records with which the lanes began, at tick 0."""
        return self._opened

    @property
    def made(self) -> tuple[Made, ...]:
        """The edits since the start, until now."""
        return self.history.made

    # --- what is there ----------------------------------------------------------------------------------------------

    @property
    def digests(self) -> tuple[str, ...]:
        """The digest of each lane's state."""
        return tuple(lane.digest for lane in self.lanes)

    @property
    def apart(self) -> tuple[float | None, ...]:
        """Root-mean-square distance of each lane's agents from those of lane 0, m; None for lane 0 and other agents."""
        first = self.lanes[0].drawn
        found: list[float | None] = [None]
        for lane in self.lanes[1:]:
            other = lane.drawn
            if other.pos.shape != first.pos.shape:
                found.append(None)
                continue
            both = first.alive & other.alive
            space = getattr(lane.record, "scene", lane.record).space
            gap = space.displacement(first.pos[:, both].T, other.pos[:, both].T)
            found.append(float(np.sqrt((gap**2).sum(axis=1).mean())) if both.any() else None)
        return tuple(found)


def _check_one_clock(lanes: Sequence[Lane]) -> None:
    """Raise ValueError unless all ticks take the same time."""
    interval = lanes[0].interval
    for k, lane in enumerate(lanes[1:], 1):
        if abs(lane.interval - interval) > 1e-9 * interval:
            raise ValueError(
                f"lanes[{k}]: its tick takes {lane.interval:g} s and that of lane 0 {interval:g} s; all must be equal"
            )
