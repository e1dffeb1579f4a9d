"""Session: what one server plays, and its answers to the messages of pages, as JSON and bytes; it knows no socket.

It is used by one thread at a time, but for `prepare` and `compile`, which may run in one other thread.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any

from flockenv.play import messages as m
from flockenv.play.additions import additions_of
from flockenv.play.controls import controls_of, titles_of, with_restarts
from flockenv.play.description import describe_lane, json_data
from flockenv.play.edits import OF_RECORD, Edit, read_edit
from flockenv.play.fields import colour_of, colours_of
from flockenv.play.frames import encode_frame
from flockenv.play.lane import Lane
from flockenv.play.limits import check_size
from flockenv.play.record_paths import with_value
from flockenv.play.recording import Recording
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.sentences import sentences_of
from flockenv.play.task_lane import NO_FILES, PlayerFiles, TaskLane, players_of
from flockenv.scene import Scene
from flockenv.tasks import Task

__all__ = ["Answer", "Later", "Rest", "Session"]

Answer = Mapping[str, Any] | bytes
Later = Callable[[], list[Answer]]
"""What takes long and needs the worlds no more, such as measuring; in any thread."""
Rest = Callable[[], "list[Answer] | Later"]
"""What is left to do for a message, in the thread that steps the worlds."""


class Session:
    """A room, and what opens another one.

    files: players from files that the command line names; no other file is read.
    """

    def __init__(self, files: PlayerFiles = NO_FILES) -> None:
        self.files = files
        self.room: Room | None = None
        self.name, self.about = "", ""
        """What is open, and some sentences about it."""
        self.opened = 0
        self._compiled: Room | None = None
        self._recording: Recording | None = None
        self._players: tuple[str, ...] = ()
        self._step_time, self._encode_time = _Mean(), _Mean()
        self._short: dict[type[m.Message], Callable[..., list[Answer]]] = {
            m.Hello: self._hello, m.Play: self._play, m.Speed: self._speed, m.Step: self._step, m.Seek: self._seek,
            m.Frame: self._frame, m.Save: self._save, m.Share: self._share, m.Seed: self._seed,
            m.Gallery: self._gallery, m.Measures: self._measures,
        }  # fmt: skip
        self._long: dict[type[m.Message], Callable[..., Rest]] = {
            m.Open: self._open, m.Load: self._load, m.LinkMessage: self._link, m.Lanes: self._lanes,
            m.EditMessage: self._edit, m.LookMessage: self._look, m.Costs: self._costs, m.Additions: self._additions,
            m.RecordMessage: self._record,
        }  # fmt: skip

    # --- what the server does by itself -----------------------------------------------------------------------------

    @property
    def is_playing(self) -> bool:
        """True if time passes."""
        return self.room is not None and self.room.playing

    @property
    def version(self) -> tuple[int, int]:
        """Changes when the description does; (0, 0): nothing is open."""
        return (0, 0) if self.room is None else (self.opened, self.room.version)

    def advance(self) -> None:
        """Make the steps that are due."""
        if self.room is None:
            return
        began = perf_counter()
        made = self.room.advance()
        if made:
            self._step_time.add((perf_counter() - began) / made)
            if (recording := self._recording) is not None:
                recording.take()
        if self.room.ended:
            self.room.play(False)

    def pause(self) -> None:
        """Stop time: no page is open."""
        if self.room is not None:
            self.room.play(False)

    @property
    def is_compiled(self) -> bool:
        """True if steps take no longer than steps do; before that, `compile` is due."""
        return self.room is None or self._compiled is self.room

    def compile(self) -> None:
        """Compile what the steps of the open worlds need."""
        if (room := self.room) is not None:
            room.compile()
            self._compiled = room

    def edit(self, edit: Edit) -> list[Answer]:
        """Apply an edit."""
        change = self._there().edit(edit)
        lines = [*change.notices]
        if change.restarts:
            lines.insert(0, "This value is part of the start: the world begins again.")
        return [{"type": "notice", "text": " ".join(lines)}] if lines else []

    def is_long(self, message: m.Message) -> bool:
        """Return True if a message may need something compiled or built, which `prepare` does."""
        if isinstance(message, m.EditMessage):
            return message.edit["kind"] in (*OF_RECORD, "player")
        return type(message) in self._long

    def prepare(self, message: m.Message) -> Rest:
        """Compile and build what a message needs, and return the rest; ValueError if it cannot be done.

        Of the short messages only a frame may need something: a kernel for its colours.
        """
        if isinstance(message, m.Frame):
            return self._colours(message)
        return self._long[type(message)](message)

    def twin(self, message: m.Message | None = None) -> Callable[[], object]:
        """Return what prepares a message, None: compiles, in another process: in a session of the same worlds.

        They are at their start there. What it returns can be pickled, and is called without arguments.
        """
        lanes = self.room.lanes if self.room is not None else ()
        return functools.partial(_prepare_twin, self.files, [lane.made_of for lane in lanes], message)

    def answer(self, message: m.Message) -> list[Answer]:
        """Return the answers to a message; ValueError, in one line, if it cannot be done."""
        if type(message) in self._short:
            return self._short[type(message)](message)
        answers = self.prepare(message)()
        return answers() if callable(answers) else answers

    def _edit(self, message: m.EditMessage) -> Rest:
        edit = read_edit(message.edit)
        self._there().prepare(edit)
        return lambda: self.edit(edit)

    def _there(self) -> Room:
        if self.room is None:
            raise ValueError("nothing is open; pick a world first")
        return self.room

    # --- opening ----------------------------------------------------------------------------------------------------

    def open_scene(self, scene: Scene, name: str, seed: int = 0, about: str = "") -> None:
        """Open a scene; about: some sentences that pages show."""
        self._set_room(Room((SceneLane(scene, seed),)), name, about)

    def open_task(self, task: Task, players: Sequence[str] = ("rules",), seed: int = 0) -> None:
        """Open a task in a world for each player, side by side."""
        self._set_room(self._room_of(task, players, seed), task.name, _about(task))

    def _room_of(self, task: Task, players: Sequence[str], seed: int) -> Room:
        return Room(tuple(TaskLane(task, player, seed, files=self.files) for player in players))

    def _set_room(
        self, room: Room, name: str, about: str, playing: bool = True, answers: Sequence[Answer] = ()
    ) -> list[Answer]:
        """Play another room from now on."""
        record = room.lanes[0].record
        self._players = players_of(record, self.files) if isinstance(record, Task) else ()
        lost = [] if self._recording is None else [_LOST]
        self.room, self.name, self.about, self._recording = room, name, about, None
        self.opened += 1
        room.play(playing)
        return [*lost, *answers]

    def _ready(self, room: Room, name: str, about: str, playing: bool = True, answers: Sequence[Answer] = ()) -> Rest:
        """Compile what a new room needs, try which values begin it again, and return what opens it."""
        room.compile()
        with_restarts(controls_of(room.lanes[0].record), room.lanes[0])  # so that `describe` takes no time

        def opens() -> list[Answer]:
            self._compiled = room
            return self._set_room(room, name, about, playing, answers)

        return opens

    def _open(self, message: m.Open) -> Rest:
        from flockenv.play.gallery import description_of, read_entry, text_of

        record = read_entry(message.what)
        if isinstance(record, Task):
            room = self._room_of(record, message.players or ("rules",), 0)
            return self._ready(room, record.name, _about(record))
        if message.players is not None:
            raise ValueError("players: a scene has none")
        return self._ready(Room((SceneLane(record),)), message.what, description_of(text_of(message.what)))

    def _load(self, message: m.Load) -> Rest:
        from flockenv.play.gallery import description_of
        from flockenv.scene.yaml_io import keys_of, load, load_scene

        text = message.yaml + "\n"  # with a line break it is a text, never the name of a file
        seed = self.room.lanes[0].seed if self.room is not None else 0
        lanes = self.room.lanes if self.room is not None else ()
        is_scene = "groups" in keys_of(text)  # which no task has; the text of a task does not name it
        if lanes and isinstance(lanes[0], TaskLane) and not is_scene:
            task = load(text, type(lanes[0].record))
            players = [lane.players[0] for lane in lanes if isinstance(lane, TaskLane)]
            return self._ready(self._room_of(task, players, seed), task.name, _about(task))
        scene, name = load_scene(text), self.name if lanes and isinstance(lanes[0], SceneLane) else "scene"
        check_size("load", scene, seed)
        return self._ready(Room((SceneLane(scene, seed),)), name, description_of(message.yaml))

    def _link(self, message: m.LinkMessage) -> Rest:
        from flockenv.play.link import read_link

        linked = read_link(message.text)
        room, camera = linked.room(self.files), {"type": "camera", "camera": dict(linked.camera)}
        task = room.lanes[0].record
        about = _about(task) if isinstance(task, Task) else ""
        return self._ready(room, linked.title, about, False, [camera])

    def _lanes(self, message: m.Lanes) -> Rest:
        first = self._there().lanes[0]
        if isinstance(first, TaskLane):
            if message.players is None:
                raise ValueError("lanes.players: missing; a task is compared by its players")
            room = self._room_of(first.record, message.players, first.seed)
            return self._ready(room, first.record.name, self.about)
        if message.variants is None:
            raise ValueError("lanes.variants: missing; a scene is compared by methods and time steps")
        scenes = [_variant(first.record, each) for each in message.variants]
        longest = max(scene.dt for scene in scenes)
        lanes = [SceneLane(scene, first.seed, _whole(longest / scene.dt)) for scene in scenes]
        return self._ready(Room(lanes), self.name, self.about)

    def _seed(self, message: m.Seed) -> list[Answer]:
        room = self._there()
        for lane in room.lanes:
            lane.seed = lane.seed if message.seed is None else message.seed
        room.restart()
        return []

    # --- time -------------------------------------------------------------------------------------------------------

    def _hello(self, message: m.Hello) -> list[Answer]:
        if message.version != m.VERSION:
            raise ValueError(f"version = {message.version}: the server speaks {m.VERSION}; reload the page")
        return [{"type": "welcome", "version": m.VERSION, "open": self.room is not None}]

    def _play(self, message: m.Play) -> list[Answer]:
        room = self._there()
        if message.on and room.ended:
            room.seek(0)
        room.play(message.on)
        return []

    def _speed(self, message: m.Speed) -> list[Answer]:
        self._there().set_speed(message.x)
        return []

    def _step(self, message: m.Step) -> list[Answer]:
        self._there().step(message.n)
        return []

    def _seek(self, message: m.Seek) -> list[Answer]:
        room = self._there()
        room.play(False)
        room.seek(min(message.tick, room.last))
        return []

    # --- seeing -----------------------------------------------------------------------------------------------------

    def _frame(self, message: m.Frame) -> list[Answer]:
        began = perf_counter()
        frame = encode_frame(self._there(), message.want)
        self._encode_time.add(perf_counter() - began)
        return [frame]

    def _colours(self, message: m.Frame) -> Rest:
        for lane in self._there().lanes:
            colour_of(lane.made_of(), message.want.colour)
        return lambda: self._frame(message)

    def describe(self) -> dict[str, Any]:
        """Return what a page needs besides frames: lanes, controls, sentences, players."""
        room = self._there()
        first = room.lanes[0]
        record = first.record
        scene = isinstance(record, Scene)
        return {
            "type": "room", "name": self.name, "title": self.name.replace("_", " "),
            "kind": "scene" if scene else "task",
            "seed": first.seed, "interval": room.interval, "tick": room.tick, "last": room.last,
            "playing": room.playing, "speed": room.speed, "version": room.version,
            "lanes": [describe_lane(lane, name) for lane, name in zip(room.lanes, self._names(), strict=True)],
            "controls": [json_data(control) for control in with_restarts(controls_of(record), first)],
            "titles": titles_of(record),
            "sentences": [json_data(sentence) for sentence in sentences_of(record)] if scene else [],
            "players": list(self._players) if not scene else [], "colours": list(colours_of(first)),
            "about": self.about, "action": None if scene else _action(record),
            "disturbance": first.disturbance.model_dump() if isinstance(first, TaskLane) else None,
        }  # fmt: skip

    def _names(self) -> list[str]:
        """Return a name for each lane."""
        lanes = self._there().lanes
        if isinstance(lanes[0], TaskLane):
            return [_player_name(lane) for lane in lanes if isinstance(lane, TaskLane)]
        if len(lanes) == 1:
            return [""]
        return [f"{_method(lane.record)}, dt = {lane.record.dt:g} s" for lane in lanes]

    def _look(self, message: m.LookMessage) -> Rest:
        from flockenv.play.sight import look, prepare_look

        def lane() -> Lane:
            lanes = self._there().lanes
            if message.lane >= len(lanes):
                raise ValueError(f"look.lane = {message.lane}: there are {len(lanes)} lanes, counted from 0")
            return lanes[message.lane]

        prepare_look(lane())
        return lambda: [{"type": "look", "lane": message.lane, **json_data(look(lane(), message.agent))}]

    def _measures(self, message: m.Measures) -> list[Answer]:
        from flockenv.play.fields import measures_of

        room = self._there()
        lanes = [{name: json_data(value) for name, value in measures_of(lane).items()} for lane in room.lanes]
        for values, apart in zip(lanes, room.apart, strict=True):
            if apart is not None:
                values["distance to the first world"] = {"value": apart, "unit": "m"}
        timing = {"step": 1e3 * self._step_time.value, "encode": 1e3 * self._encode_time.value}
        return [{"type": "measures", "time": max(lane.time for lane in room.lanes), "lanes": lanes, "timing": timing}]

    def _costs(self, message: m.Costs) -> Rest:
        from flockenv.play.fields import costs_of, prepare_costs
        from flockenv.play.sight import prepare_look

        prepare_costs(self._there().lanes[0])
        prepare_look(self._there().lanes[0])  # shares of behaviours are measured too

        def measure() -> Later:
            costs = costs_of(self._there().lanes[0])
            return lambda: [{"type": "costs", **json_data(costs())}]

        return measure

    def _additions(self, message: m.Additions) -> Rest:
        record = self._there().lanes[0].record
        if not isinstance(record, Scene):
            raise ValueError("additions: only of scenes; the effects of a task are its own")
        answer = {"type": "additions", "additions": additions_of(record)}
        return lambda: [answer]

    def pictures(self) -> Mapping[str, bytes]:
        """Return the pictures of the gallery by the names of their addresses."""
        from flockenv.play.gallery import entries

        return {f"{each.name}.png": each.picture for each in entries() if each.picture}

    def _gallery(self, message: m.Gallery) -> list[Answer]:
        from flockenv.play.gallery import entries

        listed = []
        for each in entries():
            picture = f"pictures/{each.name}.png" if each.picture else None
            listed.append({**json_data(dataclasses.replace(each, picture=None)), "picture": picture})
        return [{"type": "gallery", "entries": listed}]

    # --- keeping ----------------------------------------------------------------------------------------------------

    def _save(self, message: m.Save) -> list[Answer]:
        from flockenv.scene.yaml_io import dump, dump_scene

        room = self._there()
        record = room.lanes[0].record
        text = dump_scene(record, brief=True) if isinstance(record, Scene) else dump(record, brief=True)
        outside = sum(made.edit.kind not in OF_RECORD for made in room.made)
        if outside:
            note = f"{outside} changes of this run, such as moved agents, are not in the YAML; a link has them."
        elif isinstance(record, Scene):
            note = f"flockenv run FILE --seed {room.lanes[0].seed} gives the same numbers, bit for bit."
        else:
            note = f"The arguments of the task {record.name}, whose defaults are left out."
        return [{"type": "yaml", "text": text, "note": note}]

    def _share(self, message: m.Share) -> list[Answer]:
        from flockenv.play.link import write_link

        return [{"type": "link", "text": write_link(self._there(), self.name, message.camera)}]

    def _record(self, message: m.RecordMessage) -> Rest:
        if message.on:
            return self._begin_recording
        recording, self._recording = self._recording, None
        if recording is None:
            raise ValueError("record: nothing is being recorded")
        film: dict[str, Any] = {"type": "film", "form": message.form}
        if message.form == "gif":
            film["data"] = base64.b64encode(recording.gif()).decode("ascii")
        else:
            film["html"] = recording.page(self.name or "flockenv")
        return lambda: [{"type": "record", "on": False, "seconds": recording.seconds}, film]

    def _begin_recording(self) -> list[Answer]:
        self._recording = Recording(self._there(), self._names())
        self._recording.take()
        return [{"type": "record", "on": True, "seconds": 0.0}]


_LOST: Answer = {
    "type": "record", "on": False, "seconds": 0.0, "note": "The recording was not saved: it ended with its world.",
}  # fmt: skip


def _prepare_twin(files: PlayerFiles, lanes: Sequence[Callable[[], Lane]], message: m.Message | None) -> None:
    """Prepare a message, or compile what steps need, in a new session that plays some lanes."""
    session = Session(files)
    if lanes:
        session.room = Room([make() for make in lanes])
    if message is None:
        session.compile()
    else:
        session.prepare(message)


class _Mean:
    """A running mean of times, s."""

    def __init__(self) -> None:
        self.value = 0.0

    def add(self, seconds: float) -> None:
        self.value += (0.1 if self.value else 1.0) * (seconds - self.value)


def _variant(scene: Scene, variant: m.Variant) -> Scene:
    """Return a scene with another method or time step; ValueError if it has none of that name."""
    if variant.method is not None:
        scene = with_value(scene, "integrator", {"kind": variant.method})
    return scene if variant.dt is None else with_value(scene, "dt", variant.dt)


def _whole(ratio: float) -> int:
    """Return the number of steps that fit into one of another length; ValueError if that is no integer."""
    steps = round(ratio)
    if abs(ratio - steps) > 1e-6 * ratio:
        raise ValueError(
            f"lanes.variants: time steps must be integer multiples of each other, got a ratio of {ratio:g}"
        )
    return steps


def _method(scene: Scene) -> str:
    return str(scene.integrator.kind).replace("_", " ")


def _player_name(lane: TaskLane) -> str:
    """Return the name of the players of a lane: of all learners, or a list of those that differ."""
    from pathlib import Path

    return " + ".join(Path(name).stem for name in dict.fromkeys(lane.players))


def _about(task: Task) -> str:
    """Return the first paragraph about a task."""
    return " ".join((type(task).__doc__ or "").split("\n\n")[0].split()).replace("`", "")


def _action(task: Task) -> dict[str, Any]:
    """Return in which axes the numbers of an action are, and how many there are."""
    slots = task.action_layout.slots
    return {"frame": "heading" if "heading" in slots[0].meaning else "world", "size": task.action_layout.size}
