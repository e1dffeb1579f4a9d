"""A pydantic error as one clear line: the key, the value, what is allowed, and the nearest valid name.

Used wherever a record is built from outside data: a YAML file, or the keyword arguments of make.
"""

from __future__ import annotations

import difflib
import functools
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

__all__ = [
    "KeyPath",
    "Refusal",
    "key_path",
    "nearest",
    "nearest_few",
    "parse_key_path",
    "printable",
    "printable_path",
    "refusals",
]

KeyPath = tuple[str | int, ...]
"""Path to a value: ("effects", 1, "radius") is effects[1].radius."""

Schema = dict[str, Any]

MANY = 30  # most allowed names that are listed beside a suggestion
FEW = 10  # most names that are listed in full
MOST = 100  # most errors that are examined: more usually have one common cause


@dataclass(frozen=True)
class Refusal:
    """One mistake and its place."""

    path: KeyPath
    text: str  # one line that starts with the key path

    def __str__(self) -> str:
        return self.text


def refusals(error: ValidationError, model: type[BaseModel], data: object) -> list[Refusal]:
    """Return one refusal per mistake that pydantic found in `data`, in the order of the fields of `model`.

    Pydantic may report one mistake as several errors: one for each member of a union, one for the key that is missing
    because it is misspelt, one for a list that is too short without its bad items. Only the clearest is kept.
    """
    schema = _schema_of(model)
    found: dict[KeyPath, ErrorDetails] = {}
    for detail in error.errors(include_url=False)[:MOST]:
        path = _path_in(data, detail)
        if path not in found or (_is_type_error(found[path]) and not _is_type_error(detail)):
            found[path] = detail
    blocks = {path[:k] for path in found for k in range(len(path))}
    meant = {_nearest_path(path, schema, data) for path, detail in found.items() if detail["type"] == "extra_forbidden"}
    echoes = {"missing": meant, "too_short": blocks}
    return [
        Refusal(path, _line(path, detail, schema, data))
        for path, detail in found.items()
        if path not in echoes.get(detail["type"], blocks if _is_type_error(detail) else ())
    ]


def _is_type_error(detail: ErrorDetails) -> bool:
    """Return True for a type error; pydantic also reports one for each member of a union that does not match."""
    return detail["type"] in ("float_type", "int_type", "string_type", "bool_type")


@functools.cache
def _schema_of(model: type[BaseModel]) -> Schema:
    """Return a model's JSON schema, cached: computing that of Scene takes 0.25 s."""
    return model.model_json_schema()


def _nearest_path(path: KeyPath, schema: Schema, data: object) -> KeyPath:
    """Return the path with its last, unknown key replaced by the nearest known one."""
    close = _close_matches(str(path[-1]), _keys(path, schema, data))
    return (*path[:-1], *close)


def nearest(word: str, allowed: Iterable[str]) -> str:
    """Return ', did you mean `x`?' for the allowed name nearest to `word`, or '' if none is near."""
    return "".join(f", did you mean `{name}`?" for name in _close_matches(word, allowed))


def nearest_few(word: str, allowed: Iterable[str]) -> str:
    """Return the allowed names or, if there are many, the few nearest to `word`: '; the nearest of 130: a, b'."""
    names = sorted(allowed)
    if len(names) <= FEW:
        return f"; allowed: {', '.join(names)}"
    return f"; the nearest of {len(names)}: {', '.join(_close_matches(word, names, FEW // 2, 0.0))}"


def _close_matches(word: str, allowed: Iterable[str], most: int = 1, least: float = 0.6) -> list[str]:
    """Return at most `most` names, the most similar first, each with a similarity ratio of at least `least`."""
    names = {name.lower(): name for name in allowed}
    return [names[name] for name in difflib.get_close_matches(word[:200].lower(), names, n=most, cutoff=least)]


def key_path(path: KeyPath) -> str:
    """Return effects[1].radius for ("effects", 1, "radius"), with names that are not words quoted and escaped."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += ("." if text else "") + (step if re.fullmatch(r"[\w-]{1,60}", step) else printable(step))
    return text


def parse_key_path(text: str) -> KeyPath:
    """Return the key path that a message begins with, () if it begins with none: the inverse of `key_path`."""
    start = re.match(r"[A-Za-z_]\w*(\.[\w-]+|\.'[^']+'|\[\d+\])*", text)
    steps = re.findall(r"([\w-]+)|'([^']+)'|\[(\d+)\]", start[0]) if start else []
    return tuple(int(index) if index else name or quoted for name, quoted, index in steps)


def printable(value: object) -> str:
    """Return a value as one short printable line."""
    text = repr(value)
    return text if len(text) <= 60 else text[:50] + f"... ({len(text)} characters)"


def printable_path(path: str | os.PathLike[str]) -> str:
    """Return a path as one printable line of a bounded length: quoted, control characters escaped."""
    text = repr(os.fspath(path))
    return text if len(text) <= 300 else f"{text[:150]}...{text[-100:]}"


def _path_in(data: object, detail: ErrorDetails) -> KeyPath:
    """Return the error's path in `data`: pydantic's location without the union tags that it inserts."""
    path: list[str | int] = []
    place: Any = data
    for k, step in enumerate(detail["loc"]):
        last = k == len(detail["loc"]) - 1
        inside = isinstance(step, int) if isinstance(place, (list, tuple)) else step in _keys_of(place)
        if inside or (last and detail["type"] == "missing"):
            path.append(step)
            place = _child(place, step)
    if detail["type"].startswith("union_tag_"):
        path.append(_discriminator(detail))
    return tuple(path)


def _keys_of(place: object) -> Iterable[Any]:
    return place if isinstance(place, Mapping) else ()


def _discriminator(detail: ErrorDetails) -> str:
    return str(_context(detail).get("discriminator", "'kind'")).strip("'")


def _context(detail: ErrorDetails) -> Mapping[str, Any]:
    return detail.get("ctx") or {}


def _line(path: KeyPath, detail: ErrorDetails, schema: Schema, data: object) -> str:
    place, value = key_path(path), _value(detail)
    reason = _reason(path, detail, schema, data)
    # The reason would be hard to find behind a whole printed block.
    block = isinstance(value, (Mapping, list, tuple)) and detail["type"] != "extra_forbidden"
    if block or detail["type"] in _MISSING:
        return f"{place}: {reason}" if place else reason
    return f"{place} = {printable(value)}: {reason}" if place else f"{printable(value)}: {reason}"


_MISSING = ("missing", "union_tag_not_found")


def _value(detail: ErrorDetails) -> Any:
    return _context(detail).get("tag", detail["input"])


def _reason(path: KeyPath, detail: ErrorDetails, schema: Schema, data: object) -> str:
    kind = detail["type"]
    message = _one_line(detail["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, "))
    if kind in ("value_error", "assertion_error"):
        return message
    if kind == "extra_forbidden":
        keys = _keys(path, schema, data)
        return f"unknown key{nearest(str(path[-1]), keys) or ';'} allowed here: {', '.join(keys) or 'no key'}"
    choices = _choices(path, detail, schema, data)
    if choices:
        return f"missing; allowed: {', '.join(choices)}" if kind in _MISSING else _unknown(str(_value(detail)), choices)
    node = _schema_at(path, schema, data)
    allowed, about = _range(node), _one_line(node.get("description", ""))
    if kind in _MISSING:
        reason = f"missing; must be {allowed or 'a value'}"
    else:
        reason = (f"must be {allowed}" if allowed else message) + _hint(detail["input"], kind)
    return f"{reason} ({about})" if about else reason


def _unknown(word: str, choices: list[str]) -> str:
    """Return that a word is none of the choices: its nearest, and all of them unless they are MANY."""
    close = nearest(word, choices)
    if len(choices) <= MANY:
        return f"unknown{close or ';'} allowed: {', '.join(choices)}"
    return f"unknown{close or nearest_few(word, choices)}"


def _hint(value: object, kind: str) -> str:
    """Return a hint what to write instead if the notation is likely to be wrong, else ''."""
    if isinstance(value, str) and kind.startswith(("float", "int")):
        return ", not text"
    if isinstance(value, float) and kind.startswith("int") and value.is_integer():
        return f": write {int(value)}"
    return f", not of {len(value)}" if kind in ("too_short", "too_long") and isinstance(value, (list, tuple)) else ""


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _keys(path: KeyPath, schema: Schema, data: object) -> list[str]:
    """Return the keys that are allowed in the block that contains `path`."""
    return list(_schema_at(path[:-1], schema, data).get("properties", {}))


def _choices(path: KeyPath, detail: ErrorDetails, schema: Schema, data: object) -> list[str]:
    """Return the words that are allowed at `path`; [] if it does not take one of a set of words."""
    if detail["type"].startswith("union_tag_"):
        union = _resolve_reference(_step_down(path[:-1], schema, data), schema)
        return list(union.get("discriminator", {}).get("mapping", {}))
    node = _schema_at(path, schema, data)
    words = node.get("enum", [node["const"]] if "const" in node else [])
    return [str(word) for word in words]


_TYPES = {"number": "a number", "integer": "an integer", "string": "text", "boolean": "true or false"}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


def _range(node: Schema) -> str:
    """Return a description of what a schema node allows: 'a number > 0', 'a list of 2 to 3, each a number'."""
    if "discriminator" in node:
        return f"a block with {node['discriminator']['propertyName']}: {', '.join(node['discriminator']['mapping'])}"
    if node.get("type") == "object":
        return f"a block of {', '.join(node.get('properties', {})) or 'keys'}"
    if node.get("type") == "array":
        each = _range(node.get("items", {}))
        return f"a list{_count(node)}" + (f", each {each}" if each else "")
    bounds = " and ".join(f"{sign} {node[key]}" for key, sign in _BOUNDS.items() if key in node)
    return f"{_TYPES.get(node.get('type', ''), '')} {bounds}".strip()


def _count(node: Schema) -> str:
    least, most = node.get("minItems", 0), node.get("maxItems")
    if most is None:
        return f" of at least {least}" if least else ""
    return f" of {least}" if least == most else f" of {least} to {most}"


def _schema_at(path: KeyPath, schema: Schema, data: object) -> Schema:
    """Return the schema at `path`; of a union, the member that `data` selects."""
    place: Any = data
    for step in path:
        place = _child(place, step)
    node = _resolve_reference(_step_down(path, schema, data), schema)
    return node if "discriminator" in node and not isinstance(place, Mapping) else _select_member(node, place, schema)


def _step_down(path: KeyPath, schema: Schema, data: object) -> Schema:
    node: Schema = schema
    place: Any = data
    for step in path:
        node = _select_member(node, place, schema)
        node = _item(node, step) if isinstance(step, int) else _member(node, step)
        place = _child(place, step)
    return node


def _member(node: Schema, name: str) -> Schema:
    """Return the schema of one key of a block; if the block allows any keys, the schema that they share."""
    found: Schema | bool = node.get("properties", {}).get(name, node.get("additionalProperties", {}))
    return found if isinstance(found, dict) else {}


def _item(node: Schema, index: int) -> Schema:
    fixed: list[Schema] = node.get("prefixItems", [])
    rest: Schema = node.get("items", {})
    return fixed[index] if index < len(fixed) else rest


def _child(place: Any, step: str | int) -> object:
    if isinstance(place, Mapping):
        return place.get(step)
    if isinstance(place, (list, tuple)) and isinstance(step, int) and step < len(place):
        return place[step]
    return None


def _resolve_reference(node: Schema, schema: Schema) -> Schema:
    """Return the node that a $ref points to; keys beside the $ref, such as the field's description, take precedence."""
    while "$ref" in node:
        rest = {key: value for key, value in node.items() if key != "$ref"}
        node = {**schema["$defs"][node["$ref"].rsplit("/", 1)[-1]], **rest}
    return node


def _select_member(node: Schema, place: object, schema: Schema) -> Schema:
    node = _resolve_reference(node, schema)
    members = list(_members(node))
    if not members:
        return node
    chosen = members[0]
    tagged = node.get("discriminator")
    if tagged and isinstance(place, Mapping):
        name = tagged["mapping"].get(str(place.get(tagged["propertyName"])))
        if name or tagged["propertyName"] in place or not _fits(_resolve_reference(chosen, schema), place):
            chosen = {"$ref": name} if name else {}  # else the first kind, which is the default
    elif not tagged:
        chosen = next((m for m in members if _fits(_resolve_reference(m, schema), place)), chosen)
    own = {key: value for key, value in node.items() if key == "description"}
    return {**_select_member(chosen, place, schema), **own}


def _members(node: Schema) -> Iterator[Schema]:
    for member in node.get("oneOf") or node.get("anyOf") or ():
        if member.get("type") != "null":
            yield member


def _fits(member: Schema, place: object) -> bool:
    kinds: dict[str, tuple[type, ...]] = {
        "object": (dict,),
        "array": (list, tuple),
        "string": (str,),
        "number": (int, float),
        "integer": (int,),
        "boolean": (bool,),
    }
    return isinstance(place, kinds.get(member.get("type", ""), ()))
