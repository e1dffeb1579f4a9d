"""SceneLane: a scene that is played, and the edits of its record and of its agents."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.core.errors import printable
from flockenv.core.record import Record
from flockenv.model.snapshot import Snapshot, shades_of
from flockenv.model.state import Floats, State
from flockenv.play.edits import (
    Add,
    AddAgents,
    AddObstacle,
    Edit,
    MoveAgent,
    MoveObstacle,
    Pointer,
    Remove,
    RemoveAgents,
    RemoveObstacle,
    Set,
)
from flockenv.play.lane import Change, Drawn, Scenery, circles_of, collected_warnings, move_agent
from flockenv.play.limits import check_size
from flockenv.play.record_paths import value_at, with_item, with_value, without_item
from flockenv.play.scene_changes import adapted, begins_otherwise, have_same_code, rows_after
from flockenv.scene import Scene
from flockenv.scene.presets import expand_presets
from flockenv.steering.vectorize import rows

__all__ = ["SceneKeyframe", "SceneLane"]

POINTER_GAIN = 4.0
"""Gain of the pointer's force, 1/s: agents take a quarter of a second to turn; less if dt is longer than that."""

MOST_RESULTS = 32
"""Most edited records that are kept; fewer of many agents."""

POINTER_SPEED = 2.0
"""Speed to or from the pointer, m/s, of agents without a max_speed."""


@dataclass(frozen=True, eq=False)
class SceneKeyframe:
    """The exact state of a scene's lane."""

    record: Scene
    tick: int
    state: State
    stopped: str
    pointer: Pointer | None

    @property
    def nbytes(self) -> int:
        """Bytes of the state's arrays."""
        arrays = (getattr(self.state, each.name) for each in dataclasses.fields(State))
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


class SceneLane:
    """A scene in one world.

    per_tick: physics steps of a tick, above 1 beside a lane with a longer dt.
    """

    returns = None

    def __init__(self, scene: Scene, seed: int = 0, per_tick: int = 1) -> None:
        self.record, self.seed, self.per_tick = scene, seed, per_tick
        self._results: dict[tuple[int, str], tuple[Scene, Scene, tuple[str, ...]]] = {}
        self._warned: set[str] = set()
        self.start()

    def start(self, record: Record | None = None) -> None:
        """Begin again at tick 0, with another scene if given."""
        scene = self.record if record is None else record
        assert isinstance(scene, Scene)
        with collected_warnings() as lines:
            self.state = scene.start(self.seed)
        self._warned.update(lines)
        self.record, self.tick, self.stopped = scene, 0, ""
        self.pointer: Pointer | None = None

    @property
    def made_of(self) -> Callable[[], SceneLane]:
        """What makes such a lane, at its start; it can be pickled."""
        return functools.partial(SceneLane, self.record, self.seed, self.per_tick)

    @property
    def time(self) -> float:
        """Time of the world, s."""
        return float(self.state.time[0])

    @property
    def interval(self) -> float:
        """Time of one tick, s."""
        return self.per_tick * self.record.dt

    @property
    def digest(self) -> str:
        """A digest of the exact state; that of `flockenv run` if no edit was made."""
        return self.state.digest

    def step(self, ticks: int = 1) -> None:
        """Advance by some ticks; if the scene diverges, stop at its last finite state."""
        if self.stopped:
            return
        if self.pointer is None and self._advance(ticks * self.per_tick):
            self.tick += ticks
            return
        for _ in range(ticks):
            if not all(self._advance(1) for _ in range(self.per_tick)):
                return
            self.tick += 1

    def _advance(self, steps: int) -> bool:
        """Make physics steps; return False, with the state as it was, if it diverges."""
        drive = None if self.pointer is None else self.pointer_force(self.pointer)
        try:
            self.record.step(self.state, drive, out=self.state, steps=steps)
        except FloatingPointError as error:
            if steps == 1:
                self.stopped = str(error)
            return False
        return True

    def pointer_force(self, pointer: Pointer) -> NDArray[np.float64]:
        """Return the force on every agent to or from the pointer, (1, N, D) N."""
        scene, law = self.record, steering.seek if pointer.acts == "goal" else steering.flee
        body, first, end = scene.body, 0, scene.agents
        if pointer.group is not None:
            first, end = scene.starts[pointer.group], scene.starts[pointer.group + 1]
        top = np.where(np.isfinite(body.max_speed), body.max_speed, POINTER_SPEED)[first:end]
        offset = scene.space.displacement(self.state.pos[0, first:end], np.asarray(pointer.at))
        free = np.isfinite(body.mass[first:end]) & (body.max_force[first:end] != 0)
        gain = min(POINTER_GAIN, 1 / scene.dt) * np.where(free, body.mass[first:end], 0.0)
        force = np.zeros(self.state.shape)
        force[0, first:end] = gain[:, None] * rows(law)(offset, self.state.vel[0, first:end], top)
        return force

    # --- edits ------------------------------------------------------------------------------------------------------

    def would_restart(self, path: str, value: object) -> bool | None:
        """Return True if another value at a path begins the world again; None if the value is not possible."""
        try:
            with collected_warnings():
                return begins_otherwise(self.record, with_value(self.record, path, value), self.seed)
        except ValueError:
            return None

    def apply(self, edit: Edit) -> Change:
        """Apply an edit; raise ValueError, in one line, before anything changes if it is not possible."""
        if isinstance(edit, (Set, Add, Remove, AddObstacle, MoveObstacle, RemoveObstacle)):
            new, lines = self._changed(edit)
            change = self._take(new)
            return dataclasses.replace(change, notices=(*self._remarks(edit), *lines))
        if isinstance(edit, MoveAgent):
            return self._move(edit)
        if isinstance(edit, AddAgents):
            return self._add(edit)
        if isinstance(edit, RemoveAgents):
            return self._remove(edit)
        if isinstance(edit, Pointer):
            return self._point(edit)
        raise ValueError(f"{edit.kind}: a scene has no players; open a task for that")

    def compile(self) -> None:
        """Compile what steps need, in any thread, before the first one; the state stays as it is."""
        with suppress(FloatingPointError):
            self.record.step(self.state)
        for acts in ("goal", "flee"):
            self.pointer_force(Pointer(acts=acts, at=(0.0,) * self.record.dimension))

    def prepare(self, edit: Edit) -> None:
        """Compile what an edit of the record needs, so that `apply` takes no longer than a step; in any thread.

        Raises ValueError as `apply` does.
        """
        if isinstance(edit, (Set, Add, Remove, AddObstacle, MoveObstacle, RemoveObstacle)):
            new = self._changed(edit)[0]
            if have_same_code(self.record, new):
                return
            with collected_warnings():
                state = new.start(self.seed)
            with suppress(FloatingPointError):
                new.step(state)

    def _changed(self, edit: Edit) -> tuple[Scene, tuple[str, ...]]:
        """Return the record after an edit of it, and its warnings that the present record does not cause.

        The latest results are kept: going back and on applies the same edits to the same records again.
        """
        record = self.record
        key = id(record), edit.model_dump_json()
        if (known := self._results.get(key)) is not None:
            return known[1:]
        with collected_warnings() as lines:
            new = _edited(record, edit)
            check_size(_named(edit), new, self.seed, record, self.state.pos[0])
        fresh = tuple(line for line in lines if line not in self._warned)
        self._warned.update(lines)
        results = [*self._results.items(), (key, (record, new, fresh))]
        self._results = dict(results[-max(2, min(MOST_RESULTS, 10**6 // record.agents)) :])
        return new, fresh

    def _take(self, new: Scene) -> Change:
        """Go on with a changed scene, or begin it again if the present state is none of its states."""
        with collected_warnings():
            restarts = begins_otherwise(self.record, new, self.seed)
        if restarts:
            self.start(new)
            return Change(restarts=True)
        with collected_warnings():
            self.state = adapted(self.record, new, self.state, self.seed)
        if not self.stopped:  # else the scratch holds numbers that are not finite
            new.stepper.share_workspaces(self.record.stepper)
        self.record, self.stopped = new, ""
        return Change()

    def _remarks(self, edit: Edit) -> tuple[str, ...]:
        if isinstance(edit, AddObstacle):
            needs = {what for each in self.record.effects for what in each.calls_for()}
            needs |= {what for each in self.record.constraints for what in each.calls_for()}
            if "obstacles" not in needs:
                return ("no effect of this scene reacts to obstacles: add collisions, or a behaviour that avoids them",)
        return ()

    def _move(self, edit: MoveAgent) -> Change:
        move_agent(self.record, self.state, edit)
        self.stopped = ""
        return Change(in_record=False)

    def _group(self, index: int) -> Any:
        if index >= len(self.record.groups):
            raise ValueError(f"group = {index}: there are {len(self.record.groups)} groups, counted from 0")
        group = self.record.groups[index]
        if group.network is not None:
            raise ValueError(f"group = {index}: is a network, whose particles cannot be added or removed")
        return group

    def _add(self, edit: AddAgents) -> Change:
        """Add agents as new rows at the end of their group; the others keep their states."""
        scene, group = self.record, self._group(edit.group)
        if edit.at is not None and len(edit.at) != scene.dimension:
            raise ValueError(f"at = {edit.at}: must have {scene.dimension} numbers")
        with collected_warnings() as lines:
            new = with_value(scene, f"groups[{edit.group}].count", group.size + edit.count)
            check_size(f"add_agents = {edit.count}", new, self.seed, scene, self.state.pos[0])
        end = scene.starts[edit.group + 1]
        source = np.insert(np.arange(scene.agents), end, np.full(edit.count, -1))
        state = rows_after(scene, new, self.state, source, self.seed)
        if edit.at is not None:
            state.pos[0, source < 0] = scene.space.wrap(edit.at)
        self.record, self.state, self.stopped = new, state, ""
        return Change(in_record=False, notices=tuple(lines))

    def _remove(self, edit: RemoveAgents) -> Change:
        """Take the rows of agents out; the others keep their states."""
        scene, gone = self.record, np.unique(edit.agents)
        if gone[-1] >= scene.agents:
            raise ValueError(f"agents = {printable(edit.agents)}: there are {scene.agents} agents, counted from 0")
        new = scene
        for k in range(len(scene.groups)):
            mine = int(((gone >= scene.starts[k]) & (gone < scene.starts[k + 1])).sum())
            if mine and mine == self._group(k).size:
                raise ValueError(f"agents = {printable(edit.agents)}: group {k} must keep at least one agent")
            if mine:
                new = with_value(new, f"groups[{k}].count", scene.groups[k].size - mine)
        state = rows_after(scene, new, self.state, np.delete(np.arange(scene.agents), gone), self.seed)
        self.record, self.state, self.stopped = new, state, ""
        return Change(in_record=False)

    def _point(self, edit: Pointer) -> Change:
        scene = self.record
        if edit.at is not None and len(edit.at) != scene.dimension:
            raise ValueError(f"at = {edit.at}: must have {scene.dimension} numbers")
        if edit.group is not None and edit.group >= len(scene.groups):
            raise ValueError(f"group = {edit.group}: there are {len(scene.groups)} groups, counted from 0")
        self.pointer = None if edit.at is None else edit
        return Change(in_record=False)

    # --- keyframes and pictures -------------------------------------------------------------------------------------

    def keep(self) -> SceneKeyframe:
        """Return the exact state."""
        return SceneKeyframe(self.record, self.tick, self.state.copy(), self.stopped, self.pointer)

    def restore(self, keyframe: SceneKeyframe) -> None:
        """Go to a keyframe of this lane."""
        self.record, self.tick, self.stopped = keyframe.record, keyframe.tick, keyframe.stopped
        self.state, self.pointer = keyframe.state.copy(), keyframe.pointer

    @property
    def drawn(self) -> Drawn:
        """What a frame shows now."""
        state, scene = self.state, self.record
        low, high = scene.view.region(state, 0)
        d, kept = scene.dimension, len(state.frame) > 0
        return Drawn(
            self.time, state.x[:, 0], state.v[:, 0], state.frame[:d, 0] if kept else state.v[:, 0], state.alive[0],
            tuple(map(float, low)), tuple(map(float, high)), self._shade(),
            state.identity[0] if scene.population else None, scene.view.broken(state),
        )  # fmt: skip

    def _shade(self) -> Floats | None:
        view, state = self.record.view, self.state
        if not view.looks:
            return None
        return shades_of(view.looks, view.look, state.age[0], state.vel[0], view.shown_numbers(state))

    @property
    def scenery(self) -> Scenery:
        """What stands around the agents now; endless surfaces are cut off at some distance."""
        scene = self.record
        low, high = map(np.asarray, scene.view.region(self.state, 0))
        far = 2.0 ** np.ceil(np.log2(max(float((high - low).max()), 1e-9)))  # steps, so that it seldom changes
        middle = np.rint((low + high) / (2 * far)) * far
        outlines = scene.view.outlines(middle - 2 * far, middle + 2 * far, self.time)
        return Scenery(circles_of(self.state), outlines, scene.view.marks)

    def snapshot(self) -> Snapshot:
        """Return the world at this instant."""
        return self.record.snapshot(self.state)


def _named(edit: Edit) -> str:
    """Return what an edit changes, for a message: its key and value if it has them."""
    if isinstance(edit, Set):
        return f"{edit.path} = {printable(edit.value)}"
    return str(getattr(edit, "path", edit.kind))


def _edited(scene: Scene, edit: Edit) -> Scene:
    """Return a scene after an edit of its record."""
    if isinstance(edit, Set):
        return with_value(scene, edit.path, edit.value)
    if isinstance(edit, Add):
        value: Any = edit.value
        if edit.path == "effects" and "preset" in value:
            value = expand_presets({"effects": [value]})[0]["effects"]
        return with_item(scene, edit.path, value)
    if isinstance(edit, Remove):
        return without_item(scene, edit.path)
    if isinstance(edit, AddObstacle):
        return with_item(scene, "obstacles", {"kind": "circle", **edit.shape})
    path = f"obstacles[{edit.index}]"  # type: ignore[attr-defined]  # the two other edits of obstacles have one
    if isinstance(edit, RemoveObstacle):
        return without_item(scene, path)
    assert isinstance(edit, MoveObstacle)
    return with_value(scene, path, value_at(scene, path).moved_to(edit.centre))
