"""Changes of records by key path: the record with one value replaced, one item added, or one taken out.

with_value(scene, "effects[0].weight", 2.5)

Values come from JSON. What does not fit raises ValueError, in one line that begins with the key path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import BaseModel

from flockenv.core.errors import KeyPath, key_path, nearest, parse_key_path, printable
from flockenv.core.record import lists_to_tuples

__all__ = ["value_at", "with_item", "with_value", "without_item"]

R = TypeVar("R", bound=BaseModel)


def value_at(record: BaseModel, path: str) -> Any:
    """Return the value at a key path; raise ValueError, in one line, if there is none."""
    value: Any = record
    for depth, step in enumerate(steps := _steps(path)):
        value = _child(value, step, steps[:depth])
    return value


def with_value(record: R, path: str, value: object) -> R:
    """Return the record with another value at a key path."""
    new: R = _rebuilt(record, _steps(path), lambda old: lists_to_tuples(value))
    return new


def with_item(record: R, path: str, value: object) -> R:
    """Return the record with an item appended to the list at a key path."""

    def extended(old: Any) -> Any:
        if not isinstance(old, tuple):
            raise ValueError(f"{path}: is not a list, so nothing can be added to it")
        items = lists_to_tuples(value)
        return (*old, *items) if isinstance(items, tuple) else (*old, items)

    new: R = _rebuilt(record, _steps(path), extended)
    return new


def without_item(record: R, path: str) -> R:
    """Return the record without the item of a list at a key path."""
    steps = _steps(path)
    if not isinstance(steps[-1], int):
        raise ValueError(f"{path}: is not an item of a list, such as effects[0]")
    value_at(record, path)
    index = steps[-1]
    new: R = _rebuilt(record, steps[:-1], lambda old: (*old[:index], *old[index + 1 :]))
    return new


def _steps(path: str) -> KeyPath:
    steps = parse_key_path(path)
    if not steps or key_path(steps) != path:
        raise ValueError(f"path = {printable(path)}: is not a key path, such as effects[0].weight")
    return steps


def _child(value: Any, step: str | int, above: KeyPath) -> Any:
    """Return the field or item of a value; raise ValueError, with the allowed names, if there is none."""
    where = key_path((*above, step))
    if isinstance(value, BaseModel):
        names = type(value).model_fields
        if step in names:
            return getattr(value, str(step))
        raise ValueError(f"{where}: unknown key{nearest(str(step), names) or ';'} allowed here: {', '.join(names)}")
    if isinstance(value, tuple) and isinstance(step, int):
        if step < len(value):
            return value[step]
        raise ValueError(f"{where}: there are {len(value)} items, counted from 0")
    raise ValueError(f"{where}: {key_path(above)} has no parts")


def _rebuilt(record: Any, path: KeyPath, change: Callable[[Any], Any], above: KeyPath = ()) -> Any:
    """Return a record or list with the value at a path changed; all records on the path are validated again."""
    step, rest = path[0], path[1:]
    old = _child(record, step, above)
    new = _rebuilt(old, rest, change, (*above, step)) if rest else change(old)
    if isinstance(record, tuple):
        return (*record[: int(step)], new, *record[int(step) + 1 :])
    if not rest:
        _check_type(old, new, type(record).model_fields[str(step)].annotation, (*above, step))
    try:
        return record.model_copy(update={step: new})
    except ValueError as error:
        text = str(error).removeprefix(f"{type(record).__name__}: ")
        where = key_path(above)
        raise ValueError(f"{where}{'.' if where else ''}{text}") from None


def _check_type(old: object, new: object, annotation: object, path: KeyPath) -> None:
    """Raise ValueError if text or a number is given for a switch, which pydantic would convert."""
    if annotation is bool and not isinstance(new, bool):
        raise ValueError(f"{key_path(path)} = {printable(new)}: must be true or false")
