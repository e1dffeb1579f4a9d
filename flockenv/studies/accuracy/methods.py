"""Methods by name: kinds, with fields that are not the default, as `linearly_implicit_euler:linearisations=2`."""

from __future__ import annotations

from collections.abc import Sequence

from flockenv.core.errors import printable
from flockenv.physics.integrators import Integrator, methods_of

__all__ = ["method_name", "methods_named"]

VARIED = "tolerance"
"""The field of adaptive methods that a measurement sets itself."""


def method_name(method: Integrator) -> str:
    """Return the kind of a method, and each field that is not the default; of adaptive methods without tolerance."""
    fields = {name: field.default for name, field in type(method).model_fields.items() if name != "kind"}
    if method.adaptive:
        fields.pop(VARIED)
    given = {name: getattr(method, name) for name, usual in fields.items() if getattr(method, name) != usual}
    return ":".join([method.kind, *(f"{name}={value:g}" for name, value in given.items())])


def methods_named(names: Sequence[str]) -> tuple[Integrator, ...]:
    """Return methods by their names, each once: KIND, or KIND:FIELD=NUMBER with one or several fields.

    Raises ValueError for an unknown kind or field, for a value that is not allowed, and for the tolerance of an
    adaptive method, which a measurement varies.
    """
    found = [_method_named(name) for name in names]
    return tuple({method_name(method): method for method in found}.values())


def _method_named(name: str) -> Integrator:
    """Return one method by its name."""
    kind, *given = name.split(":")
    (method,) = methods_of([kind])
    values = dict[str, float]()
    for text in given:
        field, _, number = text.partition("=")
        if field in values:
            raise ValueError(f"methods: {printable(name)}: {printable(field)} is given twice")
        try:
            values[field] = float(number)
        except ValueError:
            raise ValueError(
                f"methods: {printable(name)}: {printable(text)} must be FIELD=NUMBER, as linearisations=2"
            ) from None
    if method.adaptive and VARIED in values:
        raise ValueError(f"methods: {printable(name)}: several tolerances are measured; leave {VARIED} out")
    try:
        return type(method)(**values)  # the record checks names and values
    except ValueError as error:
        raise ValueError(f"methods: {printable(name)}: {error}") from None
