"""Record: the frozen, validated, self-describing base class of effects, integrators, spaces, scenes and tasks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic._internal._model_construction import ModelMetaclass  # it has no public name
from pydantic_core import PydanticCustomError

from flockenv.core.errors import refusals
from flockenv.core.magnitudes import check_numbers

__all__ = ["Record", "ResultRecord", "instance_of", "lists_to_tuples"]

_NUMBERS = (float, int, float | None, int | None)


def instance_of(*kinds: type) -> Callable[[Any, Any], Any]:
    """Return a validator that accepts any instance of `kinds` unchanged, also of a class defined outside flockenv.

    Other values, such as blocks of a file, go through pydantic's own validation with its list of known kinds.
    """

    def validate(value: Any, handler: Any) -> Any:
        return value if isinstance(value, kinds) else handler(lists_to_tuples(value))

    return validate


def lists_to_tuples(value: Any) -> Any:
    """Return the content of a file with lists replaced by tuples at every depth; mappings become dicts.

    value: of any type; what is neither a list nor a mapping is returned as it is.

    Pydantic's strict mode accepts a list as a tuple only from JSON, and a validator receives Python values.
    """
    if isinstance(value, Mapping):
        return {key: lists_to_tuples(inner) for key, inner in value.items()}
    return tuple(map(lists_to_tuples, value)) if isinstance(value, (list, tuple)) else value


class _OneLine(ModelMetaclass):
    """Metaclass that turns pydantic's errors into one line if a record is built in Python; yaml_io does for files."""

    def __call__(cls, *args: Any, **data: Any) -> Any:  # noqa: N805  # the class of a class
        try:
            cls._refuse_lookalikes(data)
            return super().__call__(*args, **data)
        except ValidationError as error:
            model: Any = cls
            wrong = refusals(error, model, data)
            more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
            text = str(wrong[0]) if wrong else str(error)
        raise ValueError(f"{cls.__name__}: {text}{more}")

    def _refuse_lookalikes(cls, data: dict[str, Any]) -> None:  # noqa: N805
        """Raise ValidationError if a number is given as text or bool, which pydantic converts unless it is strict."""
        model: Any = cls
        for name, field in model.model_fields.items():
            value = data.get(name)
            if isinstance(value, (str, bool)) and field.annotation in _NUMBERS:
                line = {"type": PydanticCustomError("float_type", "must be a number"), "loc": (name,), "input": value}
                raise ValidationError.from_exception_data(cls.__name__, [line])  # type: ignore[list-item]


class Record(BaseModel, metaclass=_OneLine):
    """A frozen record that compares, hashes, pickles and converts to YAML; its repr is its constructor call.

    An unknown or invalid field raises ValueError at construction, with a one-line message that names it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    sentence: ClassVar[str] = ""
    """Beginning of the sentence about it in the playground: {name} for a field's value, [...] only if not the default.

    Default: the first clause of its docstring, see flockenv/play/sentences.py."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Make functions in class variables, such as laws, static methods, so that they are not bound to the record."""
        super().__init_subclass__(**options)
        inherited: set[str] = getattr(cls, "__class_vars__", set())
        for name in {*vars(cls).get("__annotations__", {}), *inherited}:
            value = vars(cls).get(name)
            if callable(value) and not isinstance(value, (type, staticmethod, classmethod)):
                setattr(cls, name, staticmethod(value))

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Annotate class variables as plain ClassVar: pydantic evaluates their annotations again for each subclass."""
        super().__pydantic_init_subclass__(**options)
        written = vars(cls).get("__annotations__", {})
        written.update(dict.fromkeys(written.keys() & cls.__class_vars__, ClassVar))

    @model_validator(mode="after")
    def _check_magnitudes(self) -> Self:
        """Raise ValueError for numbers with which laws overflow; nested records were checked at construction."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, (float, tuple)):
                check_numbers(value, "float64", name, into_records=False)
        return self

    def __str__(self) -> str:
        return repr(self)

    def __eq__(self, other: object) -> bool:
        """Compare only the fields: cached derived values may be arrays, or not computed yet."""
        return type(self) is type(other) and all(
            getattr(self, name) == getattr(other, name) for name in type(self).model_fields
        )

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with the fields in `update` changed, validated as a new record, without cached values.

        update: new values by field; deep: True to copy the values of other fields as well.
        """
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**fields, **(update or {})})

    def __copy__(self) -> Self:
        """Return the record itself, as it is immutable."""
        return self

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """Return the record itself, as it is immutable."""
        return self

    def __getstate__(self) -> dict[Any, Any]:
        """Pickle only the fields: derived values are computed again when needed."""
        kept = super().__getstate__()
        kept["__dict__"] = {k: v for k, v in kept["__dict__"].items() if k in type(self).model_fields}
        return kept


class ResultRecord(Record):
    """A record of computed results: its numbers may have any finite size, as no law reads them."""

    @model_validator(mode="after")
    def _check_magnitudes(self) -> Self:
        """Accept every number: a speed may have decayed to 1e-217 m/s."""
        return self
