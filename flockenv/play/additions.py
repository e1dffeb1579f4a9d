"""Effects that can be added to a scene by one press: each with values that make sense, as a page offers them."""

from __future__ import annotations

import functools
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel

from flockenv.physics.effects import EFFECTS

__all__ = ["Addition", "additions_of"]

Addition = dict[str, Any]


def additions_of(dimension: int) -> list[Addition]:
    """Return the effects that can be added to a scene of a dimension: path, value, title, description."""
    return [dict(each) for each in _additions(dimension)]


@functools.cache
def _additions(dimension: int) -> tuple[Addition, ...]:
    found = []
    for kind, model in sorted(EFFECTS.items()):
        value = _example(model, kind, dimension)
        if value is not None:
            text = " ".join((model.__doc__ or "").split("\n\n")[0].split())
            title = kind.replace("_", " ")
            found.append({"path": "effects", "value": value, "title": title, "description": text})
    return tuple(found)


def _example(model: type[BaseModel], kind: str, dimension: int) -> dict[str, Any] | None:
    """Return the fields of an effect with its defaults, 1 (or a bound) for a number without one; None if it has none.

    A vector without a default is 1 along x.
    """
    value: dict[str, Any] = {"kind": kind}
    for name, field in model.model_fields.items():
        if field.is_required():
            numbers = (_number(field.metadata), [1.0] + [0.0] * (dimension - 1))
            value[name] = numbers[1] if "tuple" in str(field.annotation) else numbers[0]
    try:
        model.model_validate(
            {name: tuple(each) if isinstance(each, list) else each for name, each in value.items()}, strict=True
        )
    except ValueError:
        return None
    return value


def _number(metadata: list[Any]) -> float:
    """Return 1, or the nearest number within bounds."""
    low = next((float(each.ge) for each in metadata if isinstance(each, Ge)), None)  # type: ignore[arg-type]
    high = next((float(each.le) for each in metadata if isinstance(each, Le)), None)  # type: ignore[arg-type]
    low = next((float(each.gt) for each in metadata if isinstance(each, Gt)), low)  # type: ignore[arg-type]
    high = next((float(each.lt) for each in metadata if isinstance(each, Lt)), high)  # type: ignore[arg-type]
    return min(max(1.0, low if low is not None else 1.0), high if high is not None else 1.0)
