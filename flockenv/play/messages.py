"""Messages of a page to the server, as strict records with bounds; anything else is refused in one line.

read_message('{"type": "speed", "x": 2}')
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from flockenv.core.errors import nearest, printable, refusals
from flockenv.core.record import Record, lists_to_tuples
from flockenv.play.edits import MOST_LANES
from flockenv.play.frames import Want

__all__ = [
    "LARGEST", "LARGEST_TEXT", "MESSAGES", "VERSION", "Additions", "Costs", "EditMessage", "Frame", "Gallery", "Hello",
    "Lanes", "LinkMessage", "Load", "LookMessage", "Measures", "Message", "Open", "Play", "RecordMessage", "Save",
    "Seed", "Seek", "Share", "Speed", "Step", "Variant", "read_message",
]  # fmt: skip

VERSION = 1
"""Version of the messages that page and server exchange."""

LARGEST = 65536
"""Most bytes of a message of a page."""

LARGEST_TEXT = 60_000
"""Most characters of a scene or a link in a message."""

DEEPEST = 24
"""Most levels of lists and objects in a message."""

Name = Annotated[str, Field(max_length=200)]
Tick = Annotated[int, Field(ge=0, le=2**53)]


class Message(Record):
    """A message of a page."""

    type: str


class Hello(Message):
    """The first message: the version that the page speaks."""

    type: Literal["hello"] = "hello"
    version: int = Field(ge=0, le=1000)


class Open(Message):
    """Open a world of the gallery, with a player for each lane if it is a task."""

    type: Literal["open"] = "open"
    what: Name
    players: tuple[Name, ...] | None = Field(default=None, min_length=1, max_length=MOST_LANES)


class Load(Message):
    """Open the scene of a YAML text."""

    type: Literal["load"] = "load"
    yaml: str = Field(max_length=LARGEST_TEXT)


class LinkMessage(Message):
    """Open the moment of a link."""

    type: Literal["link"] = "link"
    text: str = Field(max_length=LARGEST_TEXT)


class EditMessage(Message):
    """Change something now; see edits.py."""

    type: Literal["edit"] = "edit"
    edit: dict[str, Any]


class Play(Message):
    """Let time pass, or stop it."""

    type: Literal["play"] = "play"
    on: bool


class Speed(Message):
    """Seconds of the world per second."""

    type: Literal["speed"] = "speed"
    x: float = Field(gt=0, le=1000)


class Step(Message):
    """Single steps, on or back."""

    type: Literal["step"] = "step"
    n: int = Field(ge=-1000, le=1000)


class Seek(Message):
    """Go to a tick that has been played."""

    type: Literal["seek"] = "seek"
    tick: Tick


class Frame(Message):
    """Ask for a frame; see frames.py."""

    type: Literal["frame"] = "frame"
    want: Want = Want()


class LookMessage(Message):
    """Ask what an agent does and sees."""

    type: Literal["look"] = "look"
    lane: int = Field(ge=0, lt=MOST_LANES)
    agent: int = Field(ge=0, le=2**31)


class Save(Message):
    """Ask for the record as YAML."""

    type: Literal["save"] = "save"


class Share(Message):
    """Ask for a link to this moment; camera: what the page adds to it."""

    type: Literal["share"] = "share"
    camera: dict[str, float] = Field(default={}, max_length=16)


class Variant(Record):
    """How a lane of a scene differs from the first: another method, another time step; null: the same."""

    method: Name | None = None
    dt: float | None = Field(default=None, gt=0, le=1e6)


class Lanes(Message):
    """Begin again with other lanes side by side: players of a task, or variants of a scene."""

    type: Literal["lanes"] = "lanes"
    players: tuple[Name, ...] | None = Field(default=None, min_length=1, max_length=MOST_LANES)
    variants: tuple[Variant, ...] | None = Field(default=None, min_length=1, max_length=MOST_LANES)


class Seed(Message):
    """Begin again, with another seed if one is given."""

    type: Literal["seed"] = "seed"
    seed: int | None = Field(default=None, ge=0, lt=2**53)


class RecordMessage(Message):
    """Begin or end a recording; form: what is made of it at its end."""

    type: Literal["record"] = "record"
    on: bool
    form: Literal["replay", "gif"] = "replay"


class Gallery(Message):
    """Ask for the list of worlds that can be opened."""

    type: Literal["gallery"] = "gallery"


class Measures(Message):
    """Ask for the measures of the present state."""

    type: Literal["measures"] = "measures"


class Additions(Message):
    """Ask for the effects that can be added to the scene."""

    type: Literal["additions"] = "additions"


class Costs(Message):
    """Ask for the cost of each effect, which takes seconds to measure."""

    type: Literal["costs"] = "costs"


MESSAGES: dict[str, type[Message]] = {
    each.model_fields["type"].default: each
    for each in (
        Hello, Open, Load, LinkMessage, EditMessage, Play, Speed, Step, Seek, Frame, LookMessage, Save, Share, Lanes,
        Seed, RecordMessage, Gallery, Measures, Additions, Costs,
    )
}  # fmt: skip
"""Every message by its type."""


def read_message(text: str | bytes) -> Message:
    """Return the message of a text; raise ValueError, in one line, for anything else."""
    if isinstance(text, bytes):
        raise ValueError("message: must be text, got bytes")
    if len(text) > LARGEST:
        raise ValueError(f"message: must have at most {LARGEST:,} characters, got {len(text):,}")
    try:
        data = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise ValueError(f"message {printable(text[:40])}: must be JSON") from None
    if not isinstance(data, dict) or not isinstance(data.get("type"), str):
        raise ValueError("message: must be an object with a type")
    if _is_deep(data, DEEPEST):
        raise ValueError(f"message: must have at most {DEEPEST} levels")
    kind = data["type"]
    if kind not in MESSAGES:
        raise ValueError(f"message.type = {printable(kind[:40])}: unknown{nearest(kind[:40], MESSAGES) or ''}")
    model = MESSAGES[kind]
    try:
        message = model.model_validate(lists_to_tuples(data), strict=True)
    except ValidationError as error:
        wrong = refusals(error, model, data)
        raise ValueError(f"{kind}.{wrong[0]}" if wrong else f"{kind}: {error.errors()[0]['msg']}") from None
    if isinstance(message, EditMessage) and not isinstance(message.edit.get("kind"), str):
        raise ValueError("edit.edit.kind: must be text")
    return message


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _is_deep(value: object, levels: int) -> bool:
    """Return True if lists and objects lie in each other to more than some levels."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels < 0 or any(_is_deep(each, levels - 1) for each in inner)
