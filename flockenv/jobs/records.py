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

    Equal arrays are written once, and so is an instance of a dataclass that is in several places: it is read as one.
    """
    arrays: dict[str, NDArray[Any]] = {}
    tree = json.dumps(_encode(value, arrays, {}), allow_nan=False)
    return bytes(save(arrays, {TREE: tree}))


def from_bytes(data: bytes, kinds: Sequence[type]) -> Any:
    """Return the value that `to_bytes` wrote; kinds: the classes of which it may contain instances.

    Raises:
        ValueError: the bytes are damaged or contain another class.
    """
    try:
        length = int.from_bytes(data[:8], "little")
        tree = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][TREE])
        return _decode(tree, load(data), {kind.__name__: kind for kind in kinds}, [])
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise ValueError(f"damaged: {' '.join(str(error).split())}") from None


def _encode(value: Any, arrays: dict[str, NDArray[Any]], written: dict[int, int]) -> Any:
    """Return a value as JSON, with arrays by name; written: number of each instance that is written, by its id."""
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
        return {"map": [[key, _encode(each, arrays, written)] for key, each in value.items()]}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encode(each, arrays, written) for each in value]}
    if dataclasses.is_dataclass(value):
        if id(value) in written:
            return {"again": written[id(value)]}
        names = [field.name for field in dataclasses.fields(value)]
        fields = {name: _encode(getattr(value, name), arrays, written) for name in names}
        written[id(value)] = len(written)
        return {"record": type(value).__name__, "fields": fields}
    raise TypeError(f"a record contains a {type(value).__name__}, which cannot be stored")


def _decode(tree: Any, arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, type[Any]], read: list[Any]) -> Any:
    """Return the value of `_encode`; read: the instances that are read, in the order in which they were written."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "float" in tree:
        return float(tree["float"])
    if "model" in tree:
        return kinds[tree["model"]].model_validate_json(tree["json"])
    if "map" in tree:
        return {key: _decode(each, arrays, kinds, read) for key, each in tree["map"]}
    if "again" in tree:
        return read[tree["again"]]
    if "record" in tree:
        fields = {key: _decode(each, arrays, kinds, read) for key, each in tree["fields"].items()}
        read.append(kinds[tree["record"]](**fields))
        return read[-1]
    name, values = next(iter(tree.items()))
    return {"tuple": tuple, "list": list}[name](_decode(each, arrays, kinds, read) for each in values)
