"""Edits: changes that are made in a playground at an instant, as records that are JSON, YAML and part of a link.

read_edit({"kind": "set", "path": "effects[0].weight", "value": 2.5})

An edit is applied between two steps. It says nothing about whether it is possible: a lane decides that, and raises
ValueError, in one line, if it is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from flockenv.core.errors import key_path, nearest, parse_key_path, printable, refusals
from flockenv.core.record import Record, lists_to_tuples

__all__ = [
    "EDITS", "MOST_AGENTS", "MOST_LANES", "OF_RECORD", "Add", "AddAgents", "AddObstacle", "AnyEdit", "Disturb", "Edit",
    "Input", "MoveAgent", "MoveObstacle", "Player", "Pointer", "Remove", "RemoveAgents", "RemoveObstacle", "Set",
    "read_edit",
]  # fmt: skip

MOST_LANES = 4
MOST_AGENTS = 1000
"""Most agents that one edit adds, removes or switches to another player."""

Number = Annotated[float, Field(strict=True, ge=-1e12, le=1e12)]
Index = Annotated[int, Field(strict=True, ge=0, le=2**31)]
Place = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)]
Path = Annotated[str, Field(min_length=1, max_length=200)]


class Edit(Record):
    """A change of one lane, or of all."""

    kind: str
    lane: int | None = Field(default=None, ge=0, lt=MOST_LANES, description="index of the lane (default: all)")


class Set(Edit):
    """Give a value of the record another one."""

    kind: Literal["set"] = "set"
    path: Path = Field(description="key path of the value, such as effects[0].weight")
    value: Any = Field(description="the new value, as in YAML")


class Add(Edit):
    """Append an item to a list of the record."""

    kind: Literal["add"] = "add"
    path: Path = Field(description="key path of the list, such as effects")
    value: dict[str, Any] = Field(description="the item, as in YAML")


class Remove(Edit):
    """Take an item out of a list of the record."""

    kind: Literal["remove"] = "remove"
    path: Path = Field(description="key path of the item, such as effects[2]")


class MoveAgent(Edit):
    """Put an agent elsewhere; it keeps its velocity unless another one is given."""

    kind: Literal["move_agent"] = "move_agent"
    agent: Index = Field(description="index of the agent")
    pos: Place = Field(description="m")
    vel: Place | None = Field(default=None, description="m/s")


class AddAgents(Edit):
    """Add agents to a group, at a place or where its spawn puts them."""

    kind: Literal["add_agents"] = "add_agents"
    group: int = Field(default=0, ge=0, le=1000, description="index of the group")
    count: int = Field(default=1, ge=1, le=MOST_AGENTS, description="number of agents")
    at: Place | None = Field(default=None, description="m, place of the new agents (default: as at the start)")


class RemoveAgents(Edit):
    """Take agents out of the world."""

    kind: Literal["remove_agents"] = "remove_agents"
    agents: tuple[Index, ...] = Field(min_length=1, max_length=MOST_AGENTS, description="indices of the agents")


class AddObstacle(Edit):
    """Add an obstacle."""

    kind: Literal["add_obstacle"] = "add_obstacle"
    shape: dict[str, Any] = Field(description="its fields, as in the obstacles of a scene")


class MoveObstacle(Edit):
    """Move an obstacle to another place."""

    kind: Literal["move_obstacle"] = "move_obstacle"
    index: Index = Field(description="index of the obstacle")
    centre: Place = Field(description="m, the new place of its anchor: its centre, or that of its bounding box")


class RemoveObstacle(Edit):
    """Take an obstacle away."""

    kind: Literal["remove_obstacle"] = "remove_obstacle"
    index: Index = Field(description="index of the obstacle")


class Player(Edit):
    """Let another player steer learners of a task."""

    kind: Literal["player"] = "player"
    learners: Literal["all"] | tuple[Index, ...] = Field(default="all", description="indices of the learners, or all")
    player: str = Field(min_length=1, max_length=200, description='a name, such as rules, or "you"')


class Input(Edit):
    """The action of the learners that a person steers, from now on."""

    kind: Literal["input"] = "input"
    action: tuple[Annotated[float, Field(strict=True, ge=-1, le=1)], ...] = Field(
        min_length=1, max_length=64, description="numbers from -1 to 1"
    )


class Disturb(Edit):
    """Noise, delay and missed neighbours between a task's world and its players."""

    kind: Literal["disturb"] = "disturb"
    noise: float = Field(default=0.0, ge=0, le=1, description="see flockenv.envs.Disturbance")
    delay: int = Field(default=0, ge=0, le=20, description="decisions")
    dropped: float = Field(default=0.0, ge=0, le=1, description="probability")


class Pointer(Edit):
    """A goal or a threat at the pointer, for a group of agents; without a place it is taken away."""

    kind: Literal["pointer"] = "pointer"
    acts: Literal["goal", "flee"] = Field(default="goal", description="agents seek it, or flee from it")
    at: Place | None = Field(default=None, description="m, its place (default: none)")
    group: int | None = Field(default=None, ge=0, le=1000, description="index of the group (default: all)")


AnyEdit = Annotated[
    Set | Add | Remove | MoveAgent | AddAgents | RemoveAgents | AddObstacle | MoveObstacle | RemoveObstacle | Player
    | Input | Disturb | Pointer,
    Field(discriminator="kind"),
]  # fmt: skip

EDITS: dict[str, type[Edit]] = {
    each.model_fields["kind"].default: each
    for each in (
        Set, Add, Remove, MoveAgent, AddAgents, RemoveAgents, AddObstacle, MoveObstacle, RemoveObstacle, Player, Input,
        Disturb, Pointer,
    )
}  # fmt: skip
"""Every edit by its kind."""

OF_RECORD = ("set", "add", "remove", "add_obstacle", "move_obstacle", "remove_obstacle")
"""Kinds of edits that change the record of a scene, so that a saved file has them."""


def read_edit(data: object) -> Edit:
    """Return the edit that JSON describes; raise ValueError, in one line, for anything else."""
    if not isinstance(data, Mapping):
        raise ValueError(f"edit = {printable(data)}: must be an object with a kind")
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in EDITS:
        raise ValueError(
            f"edit.kind = {printable(kind)}: unknown{nearest(str(kind), EDITS) or ';'} allowed: {', '.join(EDITS)}"
        )
    model = EDITS[kind]
    try:
        edit = model.model_validate(lists_to_tuples(data), strict=True)
    except ValidationError as error:
        wrong = refusals(error, model, dict(data))
        raise ValueError(f"edit.{wrong[0]}" if wrong else f"edit {kind}: {error.errors()[0]['msg']}") from None
    path = getattr(edit, "path", None)
    if path is not None and key_path(parse_key_path(path)) != path:
        raise ValueError(f"edit.path = {printable(path)}: is not a key path, such as effects[0].weight")
    return edit
