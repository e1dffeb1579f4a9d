"""Controls: the values of a scene or task that can be changed, with names, units and ranges from its records.

All of it comes from the fields themselves: titles from their names, units and texts from their descriptions, bounds and
choices from their types. A new effect, or a new field of one, has its controls without further code.
"""

from __future__ import annotations

import functools
import math
import re
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flockenv.core.errors import KeyPath, key_path, parse_key_path
from flockenv.physics.effects import Effect
from flockenv.play.lane import Lane

__all__ = ["Control", "Facts", "controls_of", "default_of", "facts_of", "records_in", "titles_of", "with_restarts"]

NOUNS = {"by": "quantity", "of": "inner number", "over": "range", "within": "region", "away": "least distance"}
"""Titles of fields whose names are no nouns."""

MOST_ITEMS = 64
"""Items of a list that have controls."""

FACTOR = r"(?:1|m|s|kg|N|J|Pa|rad|radians|degrees)(?:\^(?:\d+|\(\d+/\d+\)))?"
UNIT = rf"{FACTOR}(?:(?:/| ){FACTOR})*(?:/\({FACTOR}(?: {FACTOR})*\))?"
AFTER = r"(?=$|[,;:]| \(| (?:per|as|between|before|from|behind|of|along|off|in|on|at|nearer|beyond|and|that|to|more)\b)"
"""What may follow a unit at the beginning of a description."""


@dataclass(frozen=True)
class Facts:
    """What a field of a record says about its values."""

    title: str
    unit: str  # "" without one
    about: str  # its description, without the unit
    low: float | None  # bounds, None without one
    high: float | None
    above: bool  # True if a value must be above `low`, not equal to it
    choices: tuple[str | int, ...]  # () if values are no choice between some


@dataclass(frozen=True)
class Control:
    """A value that can be changed by an edit `set` of its path."""

    path: str
    title: str
    unit: str
    description: str
    kind: str  # number, integer, switch, choice, text, or variant: the kind of a record
    value: Any  # None: none is given, where that is allowed
    optional: bool  # True if it may be null
    low: float | None  # of a slider; hard bounds, or a range around the value and the default
    high: float | None
    choices: tuple[str | int, ...]
    default: Any  # None without one
    restarts: bool | None = None  # True if another value begins the world again; None: not known


@functools.cache
def facts_of(model: type[BaseModel], name: str) -> Facts:
    """Return what a field of a record says about its values."""
    field = model.model_fields[name]
    unit, about = _unit_and_text(" ".join((field.description or "").split()))
    low, high = _bounds(field)
    title = field.title or NOUNS.get(name) or name.replace("_", " ")
    above = any(getattr(part, "gt", None) is not None for part in (*field.metadata, *_metadata(field.annotation)))
    return Facts(title, unit, about, low, high, above, _choices(field.annotation))


def default_of(model: type[BaseModel], name: str) -> Any:
    """Return the default of a field; `...` if it has none, or one that depends on other fields."""
    field = model.model_fields[name]
    if field.is_required() or field.default_factory_takes_validated_data:
        return ...
    return field.get_default(call_default_factory=True)


def _unit_and_text(text: str) -> tuple[str, str]:
    """Return the unit with which a description begins, perhaps after a symbol, and the rest of it."""
    if rate := re.match(r"per (s|m)(?: and (s|m))?\b", text):  # the text goes on: "per s away from the goal"
        return (f"1/({rate[1]} {rate[2]})" if rate[2] else f"1/{rate[1]}"), text
    first = re.match(rf"({UNIT}){AFTER}[,;:]? ?", text)
    after_symbol = re.match(rf"[A-Za-z]\w{{0,6}}'?, ({UNIT}){AFTER}[,;:]? ?", text)
    if after_symbol is not None and not text[after_symbol.end() :].startswith("or "):
        first = after_symbol
    elif after_symbol is not None:
        first = None  # "s, m/s, or ...": it depends on another field
    if first is None:
        return "", text
    rest = text[first.end() :]
    if rest.startswith("as a "):
        return "", text
    return first[1], rest


def _bounds(field: FieldInfo) -> tuple[float | None, float | None]:
    """Return the bounds of a number, also of one in a union or a list; None without one."""
    low = high = None
    for part in (*field.metadata, *_metadata(field.annotation)):
        for name in ("ge", "gt"):
            low = getattr(part, name, None) if low is None else low
        for name in ("le", "lt"):
            high = getattr(part, name, None) if high is None else high
    return (None if low is None else float(low)), (None if high is None else float(high))


def _metadata(annotation: Any) -> Iterator[Any]:
    """Yield all that is annotated within a type."""
    if get_origin(annotation) is Annotated:
        for part in get_args(annotation)[1:]:
            yield from part.metadata if isinstance(part, FieldInfo) else (part,)
        yield from _metadata(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, types.UnionType, tuple):
        for part in get_args(annotation):
            yield from _metadata(part)


def _plain(annotation: Any) -> Any:
    """Return a type without what is annotated."""
    return _plain(get_args(annotation)[0]) if get_origin(annotation) is Annotated else annotation


def _members(annotation: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type alone."""
    plain = _plain(annotation)
    if get_origin(plain) in (Union, types.UnionType):
        return tuple(member for part in get_args(plain) for member in _members(part))
    return (plain,)


def _choices(annotation: Any) -> tuple[str | int, ...]:
    return tuple(
        value for member in _members(annotation) if get_origin(member) is Literal for value in get_args(member)
    )


def records_in(annotation: Any) -> tuple[type[BaseModel], ...]:
    """Return the records of which a field's value may be one, or a list of some."""
    found: list[type[BaseModel]] = []
    for member in _members(annotation):
        if get_origin(member) is tuple:
            found += [model for part in get_args(member) if part is not ... for model in records_in(part)]
        elif isinstance(member, type) and issubclass(member, BaseModel):
            found.append(member)
    return tuple(dict.fromkeys(found))


def controls_of(record: BaseModel) -> list[Control]:
    """Return the controls of a scene or task: numbers, vectors by their numbers, choices, switches, kinds, texts.

    They are in the order of the fields; long lists, such as the corners of a wall, have none.
    """
    return list(_walk(record, ()))


def titles_of(record: BaseModel) -> dict[str, str]:
    """Return the title of each record in a scene or task by its path: "effect 3: drag", "group 1, spawn"."""
    return dict(_titles(record, (), ""))


def _titles(record: BaseModel, above: KeyPath, title: str) -> Iterator[tuple[str, str]]:
    """Yield the path and the title of a record, and of those in it; title: without its kind."""
    kind = getattr(record, "kind", None) or getattr(record, "role", None)
    yield key_path(above), f"{title}: {str(kind).replace('_', ' ')}" if kind and title else title or "world"
    for name in type(record).model_fields:
        value, noun = getattr(record, name), facts_of(type(record), name).title
        before = f"{title}, " if title else ""
        if isinstance(value, BaseModel):
            yield from _titles(value, (*above, name), before + noun)
        elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
            for k, item in enumerate(value[:MOST_ITEMS]):
                yield from _titles(item, (*above, name, k), f"{before}{noun.removesuffix('s')} {k + 1}")


def _walk(record: BaseModel, above: KeyPath, unit: str = "") -> Iterator[Control]:
    """Yield the controls of a record; unit: of its numbers that name none, such as the bounds of a distribution."""
    model = type(record)
    for name, field in model.model_fields.items():
        if name == "kind":
            continue
        for control in _of_value(getattr(record, name), model, name, field, (*above, name)):
            has_none = not control.unit and control.kind in ("number", "integer")
            yield replace(control, unit=unit) if unit and has_none else control


def _of_value(value: Any, model: type[BaseModel], name: str, field: FieldInfo, path: KeyPath) -> Iterator[Control]:
    """Yield the controls of a field's value."""
    kinds = {kind: each for each in records_in(field.annotation) if (kind := _kind_of(each)) is not None}
    if isinstance(value, BaseModel):
        if len(kinds) > 1 and getattr(value, "kind", None) in kinds:
            yield _control(model, name, field, path, value.kind, "variant", tuple(sorted(kinds)))  # type: ignore[attr-defined]
        yield from _walk(value, path, facts_of(model, name).unit)
    elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
        for k, item in enumerate(value[:MOST_ITEMS]):
            yield from _walk(item, (*path, k))
    elif isinstance(value, tuple):
        if len(value) <= 3 and all(isinstance(x, (int, float)) for x in value):
            for k, number in enumerate(value):
                control = _control(model, name, field, (*path, k), number, "number", ())
                is_range = name in ("speed", "lifetime", "over", "opacity")
                title = f"{('least', 'greatest')[k % 2]} {control.title}" if is_range else f"{control.title} {'xyz'[k]}"
                yield replace(control, title=title, optional=False, default=None)
    else:
        kind = _kind_of_value(value, field)
        if kind is not None:
            yield _control(model, name, field, path, value, kind, facts_of(model, name).choices)


def _kind_of(model: type[BaseModel]) -> str | None:
    field = model.model_fields.get("kind")
    return field.default if field is not None and isinstance(field.default, str) else None


def _kind_of_value(value: Any, field: FieldInfo) -> str | None:
    """Return the kind of control of a value that is no record and no list; None if it has none."""
    members = _members(field.annotation)
    if bool in members:
        return "switch"
    if _choices(field.annotation):
        return "choice"
    if int in members and float not in members:
        return "integer"
    if float in members:
        return "number"
    return "text" if str in members else None


def _control(
    model: type[BaseModel], name: str, field: FieldInfo, path: KeyPath, value: Any, kind: str,
    choices: Sequence[str | int],
) -> Control:  # fmt: skip
    facts = facts_of(model, name)
    default = default_of(model, name)
    default = default if isinstance(default, (int, float, str)) else None
    low, high = _slider(facts, value, default) if kind in ("number", "integer") else (None, None)
    optional = type(None) in _members(field.annotation)
    about = facts.about or (f"kind of {facts.title}" if kind == "variant" else f"{facts.title} of {_owner(model)}")
    return Control(
        key_path(path), facts.title, facts.unit, about, kind, value, optional, low, high,
        tuple(choices), default,
    )  # fmt: skip


def _owner(model: type[BaseModel]) -> str:
    """Return what a kind of record describes, in a word or two."""
    return (_kind_of(model) or {"Group": "each agent"}.get(model.__name__) or model.__name__.lower()).replace("_", " ")


def _slider(facts: Facts, value: Any, default: Any) -> tuple[float, float]:
    """Return the range of a slider: the bounds, or where there is none, four times the value or the default."""
    numbers = [float(x) for x in (value, default) if isinstance(x, (int, float)) and math.isfinite(x)]
    size = _round_up(4 * max([abs(x) for x in numbers if x] or [0.25]))
    signed = facts.low is None and (not numbers or min(numbers) <= 0)
    low = facts.low if facts.low is not None else (-size if signed else 0.0)
    high = facts.high if facts.high is not None and facts.high < 1e6 else max(size, low + size)
    return low + facts.above * (high - low) / 1000, high


def _round_up(x: float) -> float:
    """Return the next number of the series 1, 2, 5, 10, ..."""
    power = 10.0 ** math.floor(math.log10(x))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= x * (1 - 1e-9))


# --- what begins again ------------------------------------------------------------------------------------------------

_known: dict[tuple[type, str, type], bool] = {}
"""Whether values of a field of a record begin a world again; by record, field and what is played."""


def with_restarts(controls: Sequence[Control], lane: Lane) -> list[Control]:
    """Return the controls of a lane's record, which say also whether another value begins its world again.

    Each kind of field is tried once in a process: the record is built with a slightly different value.
    """
    return [replace(control, restarts=_restarts(control, lane)) for control in controls]


def _restarts(control: Control, lane: Lane) -> bool | None:
    steps = [step for step in re.split(r"\.|\[\d+\]", control.path) if step]
    parent = _parent(lane.record, control.path)
    if isinstance(parent, Effect) and parent.begin_law is None:
        return False  # no initial state depends on it
    key = (type(parent), steps[-1], type(lane.record))
    if control.value is None:
        return _known.get(key)
    if key not in _known:
        tried = (lane.would_restart(control.path, value) for value in _nudged(control))
        if (found := next((each for each in tried if each is not None), None)) is None:
            return None  # another scene may have room for another value
        _known[key] = found
    return _known[key]


def _parent(record: BaseModel, path: str) -> Any:
    """Return the record of which a path names a field, or an item of a field."""
    value: Any = record
    found: Any = record
    for step in parse_key_path(path):
        if isinstance(value, BaseModel):
            found = value
        value = getattr(value, step) if isinstance(step, str) else value[step]
    return found


def _nudged(control: Control) -> Iterator[Any]:
    """Yield other values of a control."""
    value = control.value
    if control.kind == "switch":
        yield not value
    elif control.kind == "integer" and value is not None:
        yield from (value + 1, value - 1)
    elif control.kind == "number" and value is not None:
        yield from (value * 1.01, value * 0.99) if value else (1e-3, -1e-3)
    elif control.kind == "choice":
        yield from (choice for choice in control.choices if choice != value)
