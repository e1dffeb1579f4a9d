"""History: the edits of a room by tick, and keyframes from which every tick since the start can be computed again.

Going to a tick is exact: it restores the nearest keyframe at or before it and steps on with the same edits. The more
time steps take, the fewer there are between two keyframes. Keyframes are thinned with their distance from the present,
so that their memory is bounded, and going back some steps is fast.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

from flockenv.play.edits import Edit, Input, Pointer, Set
from flockenv.play.lane import Lane

__all__ = ["BUDGET", "EVERY", "History", "Made", "targets"]

BUDGET = 256 * 2**20
"""Most bytes of keyframes; the first and the newest are always kept."""

EVERY = 32
"""Most ticks between two new keyframes."""

REPLAY = 0.03
"""s, computing time of the ticks between two new keyframes, of which going back a step computes some again."""

SHARE = 0.05
"""Most of the computing time that keyframes of fewer than EVERY ticks take."""

MOST = 1024
"""Most keyframes."""


class Made(NamedTuple):
    """An edit, and the tick before whose step it was made."""

    tick: int
    edit: Edit


class _Moment(NamedTuple):
    """Keyframes of all lanes at a tick, after the first `edits` edits."""

    tick: int
    edits: int
    keyframes: tuple[Any, ...]
    nbytes: int


class History:
    """Edits and keyframes of some lanes, which it steps.

    budget: bytes of keyframes. clock: s, increasing. Lanes are stepped by `advance` alone, so that every edit acts at
    its tick.
    """

    def __init__(
        self, lanes: Sequence[Lane], budget: int = BUDGET, clock: Callable[[], float] = perf_counter
    ) -> None:  # fmt: skip
        self._lanes, self._budget, self._clock = tuple(lanes), budget, clock
        self._cost, self._copying = 0.0, 0.0  # s per tick and per keyframe, the last ones measured
        self.begin()

    def begin(self) -> None:
        """Forget everything: the lanes have just been started."""
        self.tick, self.last = 0, 0
        self.edits: list[Made] = []
        self._done = 0  # number of edits that have been applied
        self._spent = 0.0  # s of computing since the latest keyframe at or before the tick
        self._moments = [self._moment()]

    def load(self, edits: Sequence[Made], last: int) -> None:
        """Take over edits, with increasing ticks, of lanes at their start, and how far they were played."""
        self.begin()
        self.edits, self.last = list(edits), max([last, *(made.tick for made in edits)])
        self._apply_due()

    @property
    def nbytes(self) -> int:
        """Bytes of all keyframes."""
        return sum(moment.nbytes for moment in self._moments)

    @property
    def made(self) -> tuple[Made, ...]:
        """The edits until now, without those that are ahead of it after going back."""
        return tuple(self.edits[: self._done])

    def record(self, edit: Edit) -> None:
        """Add an edit that was just applied to the lanes; what was recorded after it is dropped.

        Of several edits of one value, or inputs, at one tick only the last is kept.
        """
        del self.edits[self._done :]
        last = self.edits[-1] if self.edits else None
        if last is not None and last.tick == self.tick and _replaces(edit, last.edit):
            self.edits.pop()
        self.edits.append(Made(self.tick, edit))
        self._done, self.last = len(self.edits), self.tick
        # a keyframe of this tick may hold a state without this edit, which is still exact, or with the one replaced
        self._moments = [m for m in self._moments if (m.tick, m.edits) < (self.tick, self._done)]

    def advance(self, ticks: int) -> int:
        """Step all lanes by up to `ticks`, as far as the next edit or keyframe; return by how many."""
        if self._done < len(self.edits):
            ticks = min(ticks, self.edits[self._done].tick - self.tick)
        before = self._latest(self.tick)
        ticks = max(min(ticks, before.tick + EVERY - self.tick, self._affordable()), 1)
        began = self._clock()
        for lane in self._lanes:
            lane.step(ticks)
        passed = self._clock() - began
        self._cost, self._spent = passed / ticks, self._spent + passed
        self.tick += ticks
        self.last = max(self.last, self.tick)
        self._apply_due()
        latest = self._latest(self.tick)
        if latest is not before:  # time went past it
            self._spent = 0.0
        elif self.tick - latest.tick >= EVERY or self._spent >= self._enough:
            insort(self._moments, self._moment(), key=_tick_of)
            self._spent = 0.0
            self._thin()
        return ticks

    def _latest(self, tick: int) -> _Moment:
        """Return the latest keyframe at or before a tick."""
        return self._moments[bisect_right(self._moments, tick, key=_tick_of) - 1]

    @property
    def _enough(self) -> float:
        """Computing time after which a keyframe is due, s."""
        return max(REPLAY, self._copying / SHARE)

    def _affordable(self) -> int:
        """Return the number of ticks until that time has passed, if they take as long as the last ones."""
        return int((self._enough - self._spent) / self._cost) if self._cost > 0 else EVERY

    def _apply_due(self) -> None:
        """Apply the recorded edits of this tick again."""
        while self._done < len(self.edits) and self.edits[self._done].tick <= self.tick:
            edit = self.edits[self._done].edit
            for lane in targets(self._lanes, edit):
                lane.apply(edit)
            self._done += 1

    def go_to(self, tick: int) -> None:
        """Go to a tick from 0 to `last`, exactly, with the edits of that tick applied."""
        tick = min(max(tick, 0), self.last)
        best = self._latest(tick)
        if not best.tick <= self.tick <= tick:
            self._restore(best)
        while self.tick < tick:
            self.advance(tick - self.tick)

    def _restore(self, moment: _Moment) -> None:
        for lane, keyframe in zip(self._lanes, moment.keyframes, strict=True):
            lane.restore(keyframe)
        self.tick, self._done, self._spent = moment.tick, moment.edits, 0.0
        self._apply_due()

    def _moment(self) -> _Moment:
        began = self._clock()
        keyframes = tuple(lane.keep() for lane in self._lanes)
        self._copying = self._clock() - began
        return _Moment(self.tick, self._done, keyframes, sum(keyframe.nbytes for keyframe in keyframes))

    def _thin(self) -> None:
        """Drop keyframes until the budget holds: always the one whose gap is smallest for its distance from now."""
        total, now = self.nbytes, self.tick
        while (total > self._budget or len(self._moments) > MOST) and len(self._moments) > 2:
            gaps = [
                (after.tick - before.tick) / max(abs(now - at.tick), 1)
                for before, at, after in zip(self._moments, self._moments[1:-1], self._moments[2:], strict=False)
            ]
            total -= self._moments.pop(1 + min(range(len(gaps)), key=gaps.__getitem__)).nbytes


def _tick_of(moment: _Moment) -> int:
    return moment.tick


def targets(lanes: Sequence[Lane], edit: Edit) -> Sequence[Lane]:
    """Return the lanes that an edit changes; raise ValueError if there is no such lane."""
    if edit.lane is None:
        return lanes
    if edit.lane >= len(lanes):
        raise ValueError(f"lane = {edit.lane}: there are {len(lanes)} lanes, counted from 0")
    return (lanes[edit.lane],)


def _replaces(new: Edit, old: Edit) -> bool:
    """Return True if a later edit of the same tick gives the state that it would give without the earlier one."""
    if (new.kind, new.lane) != (old.kind, old.lane):
        return False
    if isinstance(new, Set) and isinstance(old, Set):
        numbers = all(isinstance(each.value, (int, float)) for each in (new, old))
        return numbers and new.path == old.path and new.path != "dt"  # a change of dt rounds the time
    return isinstance(new, (Input, Pointer))
