"""Records as bytes, and back: in the safetensors format, which contains no code, unlike a pickle."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from safetensors import SafetensorError
from safetensors.numpy import load, save

__all__ = ["from_bytes", "to_bytes"]

TREE = "tree"
"""Key of the metadata that holds the record without its arrays, as JSON."""


def to_bytes(value: Any) -> bytes:
    """Return a value as bytes: numbers, texts, arrays, and tuples, lists, mappings, dataclasses and models of these.

    Equal arrays are written once.
    """
    arrays: dict[str, NDArray[Any]] = {}
    tree = json.dumps(_encode(value, arrays), allow_nan=False)
    return bytes(save(arrays, {TREE: tree}))


def from_bytes(data: bytes, kinds: Sequence[type]) -> Any:
    """Return the value that `to_bytes` wrote; kinds: the classes of which it may contain instances.

    Raises:
        ValueError: the bytes are damaged or contain another class.
    """
    try:
        length = int.from_bytes(data[:8], "little")
        tree = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][TREE])
        return _decode(tree, load(data), {kind.__name__: kind for kind in kinds})
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise ValueError(f"damaged: {' '.join(str(error).split())}") from None


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return a value as JSON, with arrays by name."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, np.ndarray):
        array = np.asarray(value, order="C")
        name = hashlib.sha256(f"{array.dtype} {array.shape} ".encode() + array.tobytes()).hexdigest()[:24]
        arrays.setdefault(name, array)
        return {"array": name}
    if isinstance(value, BaseModel):
        return {"model": type(value).__name__, "json": value.model_dump_json()}
    if isinstance(value, Mapping):
        return {"map": [[key, _encode(each, arrays)] for key, each in value.items()]}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encode(each, arrays) for each in value]}
    if dataclasses.is_dataclass(value):
        fields = {field.name: _encode(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
        return {"record": type(value).__name__, "fields": fields}
    raise TypeError(f"a record contains a {type(value).__name__}, which cannot be stored")


def _decode(tree: Any, arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, type[Any]]) -> Any:
    """Return the value of `_encode`."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "float" in tree:
        return float(tree["float"])
    if "model" in tree:
        return kinds[tree["model"]].model_validate_json(tree["json"])
    if "map" in tree:
        return {key: _decode(each, arrays, kinds) for key, each in tree["map"]}
    if "record" in tree:
        return kinds[tree["record"]](**{key: _decode(each, arrays, kinds) for key, each in tree["fields"].items()})
    name, values = next(iter(tree.items()))
    return {"tuple": tuple, "list": list}[name](_decode(each, arrays, kinds) for each in values)
