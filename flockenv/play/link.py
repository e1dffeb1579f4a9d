"""Link: a room at an instant as text for the end of an address: records, seed, edits, tick and camera.

The text is a version, "1.", and JSON, compressed (deflate) and in base64 for URLs. Opening it computes the state again
from the start; it is the same state, bit for bit, with the same version of flockenv on the same kind of machine.
Reading it checks everything, builds no object but records, and reads no file.
"""

from __future__ import annotations

import base64
import binascii
import json
import zlib
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from pydantic import Field, ValidationError

from flockenv.core.errors import nearest, printable, refusals
from flockenv.core.record import Record, lists_to_tuples
from flockenv.envs.disturbance import Disturbance
from flockenv.play.edits import MOST_LANES, read_edit
from flockenv.play.history import Made
from flockenv.play.lane import Lane, collected_warnings
from flockenv.play.limits import check_size
from flockenv.play.messages import LARGEST_TEXT
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.task_lane import NO_FILES, PlayerFiles, TaskLane
from flockenv.scene import Scene
from flockenv.scene.yaml_io import dump, load
from flockenv.tasks import TASKS

__all__ = ["LONGEST", "MOST_TICKS", "Link", "read_link", "write_link"]

LONGEST = LARGEST_TEXT
"""Most characters of a link: those that a page can send."""

MOST_BYTES = 2_000_000
"""Most bytes of its JSON."""

MOST_EDITS, MOST_TICKS = 20_000, 10_000_000

MOST_STEPS = 20_000_000_000
"""Most agent-steps that opening a link computes."""

VERSION = "1."


class _LaneLink(Record):
    """One lane at its start."""

    config: str = Field(max_length=1_000_000, description="the scene or task as YAML")
    players: tuple[str, ...] = Field(default=(), max_length=10_000, description="of each learner of a task")
    noise: float = Field(default=0.0, ge=0, le=1)
    delay: int = Field(default=0, ge=0, le=20)
    dropped: float = Field(default=0.0, ge=0, le=1)
    per_tick: int = Field(default=1, ge=1, le=10_000)


class Link(Record):
    """A room at an instant."""

    title: str = Field(default="", max_length=200)
    task: str | None = Field(default=None, max_length=60, description="name of the task (default: it is a scene)")
    seed: int = Field(ge=0, lt=2**64)
    lanes: tuple[_LaneLink, ...] = Field(min_length=1, max_length=MOST_LANES)
    edits: tuple[tuple[int, dict[str, Any]], ...] = Field(default=(), max_length=MOST_EDITS)
    tick: int = Field(ge=0, le=MOST_TICKS)
    camera: dict[str, float] = Field(default={}, max_length=20, description="what the page looks at")

    def room(self, files: PlayerFiles = NO_FILES) -> Room:
        """Return the room, played up to the tick of the link; ValueError, in one line, for what there is not.

        files: player files that may be named, by their last parts.
        """
        with collected_warnings():
            room = Room([self._lane(each, files) for each in self.lanes])
        steps = sum(each.record.agents for each in room.lanes) * self.tick
        if steps > MOST_STEPS:
            raise ValueError(f"link.tick = {self.tick}: takes {steps:,} agent-steps; at most {MOST_STEPS:,} are made")
        room.history.load(self._made(), self.tick)
        room.seek(self.tick)
        return room

    def _lane(self, lane: _LaneLink, files: PlayerFiles) -> Lane:
        if self.task is None:
            scene = load(lane.config + "\n", Scene)
            check_size("link", scene, self.seed)
            return SceneLane(scene, self.seed, lane.per_tick)
        if self.task not in TASKS:
            raise ValueError(f"link.task = {printable(self.task)}: unknown{nearest(self.task, TASKS)}")
        task = load(lane.config + "\n", TASKS[self.task])
        by_name = {PurePath(file).name: file for file in files.names}
        players = tuple(by_name.get(name, name) for name in lane.players)
        if len(players) != task.learners:
            raise ValueError(f"link.players: there are {len(players)} for {task.learners} learners")
        disturbance = Disturbance(noise=lane.noise, delay=lane.delay, dropped=lane.dropped)
        return TaskLane(task, players, self.seed, disturbance, files)

    def _made(self) -> list[Made]:
        """Return the edits, checked: ticks increase and are not after that of the link."""
        made, before = [], 0
        for tick, data in self.edits:
            if not before <= tick <= self.tick:
                raise ValueError(f"link.edits: tick {tick} must be from {before} to {self.tick}")
            made.append(Made(tick, read_edit(data)))
            before = tick
        return made


def write_link(room: Room, title: str = "", camera: Mapping[str, float] | None = None) -> str:
    """Return the link of a room now; ValueError, in one line, if it would be too long."""
    first = room.lanes[0]
    link = Link(
        title=title[:200],
        task=first.record.name if isinstance(first, TaskLane) else None,
        seed=first.seed,
        lanes=tuple(_lane_link(lane, record) for lane, record in zip(room.lanes, room.opened, strict=True)),
        edits=tuple((made.tick, made.edit.model_dump(mode="json", exclude_defaults=True) | {"kind": made.edit.kind})
                    for made in room.made),
        tick=room.tick,
        camera=dict(camera or {}),
    )  # fmt: skip
    text = json.dumps(link.model_dump(mode="json", exclude_defaults=True), separators=(",", ":"), allow_nan=False)
    packed = base64.urlsafe_b64encode(zlib.compress(text.encode(), 9)).decode().rstrip("=")
    if len(packed) + len(VERSION) > LONGEST or len(text) > MOST_BYTES:
        raise ValueError(f"link: it would have {len(packed):,} characters; at most {LONGEST:,} are allowed")
    return VERSION + packed


def _lane_link(lane: Lane, record: Any) -> _LaneLink:
    """Return a lane at its start."""
    config = dump(record, brief=True)
    if not isinstance(lane, TaskLane):
        assert isinstance(lane, SceneLane)
        return _LaneLink(config=config, per_tick=lane.per_tick)
    players, disturbance = lane.begun
    names = tuple(PurePath(name).name if name in lane.files.names else name for name in players)
    return _LaneLink(config=config, players=names, **disturbance.model_dump())


def read_link(text: str) -> Link:
    """Return the link that a text describes; raise ValueError, in one line, for anything else."""
    if len(text) > LONGEST:
        raise ValueError(f"link: {len(text):,} characters; at most {LONGEST:,} are read")
    if not text.startswith(VERSION):
        raise ValueError(f"link = {printable(text)}: must begin with {VERSION!r}")
    packed = text[len(VERSION) :]
    try:
        data = base64.b64decode(packed + "=" * (-len(packed) % 4), altchars=b"-_", validate=True)
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(data, MOST_BYTES)
        if not unpacker.eof:
            raise ValueError("link: it is cut off, or holds more than is read")
        found = lists_to_tuples(json.loads(content))
    except (binascii.Error, zlib.error, UnicodeError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"link: it is damaged ({type(error).__name__})") from None
    if not isinstance(found, dict):
        raise ValueError("link: it holds no room")
    try:
        return Link.model_validate(found, strict=True)
    except ValidationError as error:
        wrong = refusals(error, Link, found)
        raise ValueError(f"link.{wrong[0]}" if wrong else "link: it holds no room") from None
