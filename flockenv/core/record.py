"""Record: the frozen, validated, self-describing value that effects, integrators, spaces, scenes and tasks are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic._internal._model_construction import ModelMetaclass  # it has no public name
from pydantic_core import PydanticCustomError

from flockenv.core.errors import refusals
from flockenv.core.magnitudes import check_numbers

__all__ = ["Record", "ResultRecord", "in_tuples", "keep"]

_NUMBERS = (float, int, float | None, int | None)


def keep(*kinds: type) -> Callable[[Any, Any], Any]:
    """Return a validator that lets a record of these kinds through as it is: somebody else's is as good as ours.

    Only files need the list of those that there are.
    """

    def kept(value: Any, handler: Any) -> Any:
        return value if isinstance(value, kinds) else handler(in_tuples(value))

    return kept


def in_tuples(value: Any) -> Any:
    """Return what a file says with tuples in the place of lists, however deep; blocks stay blocks.

    Strictly read, only JSON's lists are taken for tuples, and pydantic hands Python's to a function like `kept`.
    """
    if isinstance(value, Mapping):
        return {key: in_tuples(inner) for key, inner in value.items()}
    return tuple(map(in_tuples, value)) if isinstance(value, (list, tuple)) else value


class _OneLine(ModelMetaclass):
    """Turns pydantic's report into one line where a record is built by hand; files go through config.py."""

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
        """Refuse "1e-3" and True where a number is wanted: pydantic takes both for one. Files are read strictly."""
        model: Any = cls
        for name, field in model.model_fields.items():
            value = data.get(name)
            if isinstance(value, (str, bool)) and field.annotation in _NUMBERS:
                line = {"type": PydanticCustomError("float_type", "must be a number"), "loc": (name,), "input": value}
                raise ValidationError.from_exception_data(cls.__name__, [line])  # type: ignore[list-item]


class Record(BaseModel, metaclass=_OneLine):
    """A frozen record: prints as its own constructor, compares, hashes, pickles, and becomes a YAML block by itself.

    An unknown or invalid field is refused at construction with a ValueError of one line that names it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    def __init_subclass__(cls, **options: Any) -> None:
        """Keep functions that class variables hold, such as laws, from becoming methods of the record."""
        super().__init_subclass__(**options)
        inherited: set[str] = getattr(cls, "__class_vars__", set())
        for name in {*vars(cls).get("__annotations__", {}), *inherited}:
            value = vars(cls).get(name)
            if callable(value) and not isinstance(value, (type, staticmethod, classmethod)):
                setattr(cls, name, staticmethod(value))

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Of what a class variable holds, only types know: pydantic would read it anew for each of its subclasses."""
        super().__pydantic_init_subclass__(**options)
        written = vars(cls).get("__annotations__", {})
        written.update(dict.fromkeys(written.keys() & cls.__class_vars__, ClassVar))

    @model_validator(mode="after")
    def _representable(self) -> Self:
        """Refuse numbers so large or small that laws overflow with them; records in it were checked when made."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, (float, tuple)):
                check_numbers(value, "float64", name, into_records=False)
        return self

    def __str__(self) -> str:
        return repr(self)

    def __eq__(self, other: object) -> bool:
        """Compare the fields alone: what follows from them may be arrays, and need not be there yet."""
        return type(self) is type(other) and all(
            getattr(self, name) == getattr(other, name) for name in type(self).model_fields
        )

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return the record with some fields changed, checked like a new one; nothing that was derived comes along."""
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**fields, **(update or {})})

    def __copy__(self) -> Self:
        """Return itself: nothing about it can change."""
        return self

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """Return itself: nothing about it can change."""
        return self

    def __getstate__(self) -> dict[Any, Any]:
        """Pickle the fields alone: what follows from them is made anew where it is needed."""
        kept = super().__getstate__()
        kept["__dict__"] = {k: v for k, v in kept["__dict__"].items() if k in type(self).model_fields}
        return kept


class ResultRecord(Record):
    """A record of what was computed: its numbers may have any finite size, as no law reads them."""

    @model_validator(mode="after")
    def _representable(self) -> Self:
        """Accept every number: a speed may have decayed to 1e-217 m/s."""
        return self
