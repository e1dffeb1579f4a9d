"""A checkpoint of a training: one file, FOLDER/checkpoint.safetensors, which is replaced as a whole or not at all.

The file is safetensors: a header in JSON, then numbers. Nothing in it is executed, and nothing is compressed. A tensor
is called PART/NAME; a part that is JSON is one tensor of bytes, PART/json. agents.run defines which parts there are.
The header's metadata hold `format` and `sha256`, the digest of every part: over names, types, shapes and bytes. `times`
is the part with wall times, and the only one that `digest` leaves out: two trainings that are equal bit for bit have
checkpoints of the same digest.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from flockenv.core.atomic_files import new_folder, remove_leftovers, replace_file
from flockenv.core.errors import printable, refusals
from flockenv.core.record import Record

__all__ = [
    "FILE",
    "TIMES",
    "CheckpointError",
    "CheckpointParts",
    "Damaged",
    "InUse",
    "claim",
    "digest",
    "from_json",
    "json_part",
    "path_in",
    "read",
    "write",
]  # fmt: skip

FILE, TIMES, JSON = "checkpoint.safetensors", "times", "json"
FORMAT = "flockenv checkpoint 1"
BEFORE = ("run.json", "policy.pt", "optimizer.pt", "best.npz")
"""The files of the previous format: four, which could be from different moments."""

Tensors = dict[str, NDArray[Any]]
CheckpointParts = dict[str, Tensors]
R = TypeVar("R", bound=Record)


class CheckpointError(ValueError):
    """A checkpoint from which training cannot continue."""


class Damaged(CheckpointError):  # noqa: N818  # the state of a file
    """A checkpoint that was altered or truncated, or does not belong to this training."""

    def __init__(self, folder: Path, why: str) -> None:
        super().__init__(f"the checkpoint in {folder} is damaged: {why}")


class InUse(CheckpointError):  # noqa: N818  # the state of a folder
    """A folder that another training has locked."""


def path_in(folder: Path) -> Path:
    """Return the checkpoint file of a folder."""
    return folder / FILE


@contextmanager
def claim(folder: Path) -> Iterator[None]:
    """Lock a folder, which is created if it is missing; raise InUse if another training, in any process, has locked it.

    Incomplete files of a killed process are removed; the lock of a killed process is free.
    """
    with new_folder(folder):
        lock = FileLock(folder / "training.lock")
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise InUse(f"{folder} is in use by another training: wait for its end, or choose another --runs") from None
        try:
            remove_leftovers(folder)
            yield
        finally:
            lock.release()


# --- writing ----------------------------------------------------------------------------------------------------------


def json_part(content: Any) -> Tensors:
    """Return a part that holds JSON."""
    return {JSON: np.frombuffer(json.dumps(content, allow_nan=False).encode(), np.uint8)}


def write(folder: Path, parts: CheckpointParts) -> None:
    """Write a checkpoint, which replaces the previous one when all of it is on the disk."""
    digests = {part: _digest(tensors) for part, tensors in parts.items()}
    tensors = {f"{part}/{name}": np.asarray(t, order="C") for part, named in parts.items() for name, t in named.items()}
    data = save(tensors, {"format": FORMAT, "sha256": json.dumps(digests)})
    with replace_file(path_in(folder)) as file:
        file.write(data)


def digest(parts: CheckpointParts) -> str:
    """Return the SHA-256 of all parts of a checkpoint except `times`."""
    each = [f"{part} {_digest(tensors)}" for part, tensors in sorted(parts.items()) if part != TIMES]
    return hashlib.sha256("\n".join(each).encode()).hexdigest()


def _digest(tensors: Mapping[str, NDArray[Any]]) -> str:
    total = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        total.update(f"{name} {tensor.dtype.str} {tensor.shape}\n".encode())
        total.update(tensor.tobytes())
    return total.hexdigest()


# --- reading ----------------------------------------------------------------------------------------------------------


def read(folder: Path, largest: int) -> CheckpointParts | None:
    """Return the parts of a folder's checkpoint, each with the digest that was recorded; None if there is none.

    largest: bytes; a larger file is not read.

    Raises:
        Damaged: a part or the file is invalid; the message names it.
        CheckpointError: the files are in the previous format.
    """
    path = path_in(folder)
    if not path.exists():
        if any((folder / name).exists() for name in BEFORE):
            raise CheckpointError(f"the checkpoint in {folder} is in an older format: start anew without --resume")
        return None
    try:
        if not path.is_file():
            raise Damaged(folder, f"{FILE} is not a file")
        if (size := path.stat().st_size) > largest:
            raise Damaged(folder, f"{FILE} has {size:,} bytes, one of this training has at most {largest:,}")
        with safe_open(path, "numpy") as file:
            recorded, parts = _recorded_digests(file.metadata() or {}, folder), _parts(file, folder)
    except (SafetensorError, OSError, TypeError, KeyError) as error:
        raise Damaged(folder, f"{FILE}: {' '.join(str(error).split())}") from None
    _compare(parts, recorded, folder)
    return parts


def _recorded_digests(metadata: Mapping[str, str], folder: Path) -> dict[str, str]:
    """Return the digests in a header, by part."""
    if metadata.get("format") != FORMAT:
        raise Damaged(folder, f"header: format = {printable(metadata.get('format'))}, must be {FORMAT!r}")
    try:
        digests = json.loads(metadata.get("sha256", ""))
    except (ValueError, RecursionError):
        digests = None
    if not isinstance(digests, dict) or not all(isinstance(value, str) for value in digests.values()):
        raise Damaged(folder, "header: sha256 must be an object, a digest for each part")
    return digests


def _parts(file: Any, folder: Path) -> CheckpointParts:
    parts: CheckpointParts = {}
    for name in file.keys():  # noqa: SIM118  # not a dictionary
        part, slash, rest = name.partition("/")
        if not slash or not rest:
            raise Damaged(folder, f"header: {printable(name)} is not the name of a tensor, PART/NAME")
        parts.setdefault(part, {})[rest] = file.get_tensor(name)
    return parts


def _compare(parts: CheckpointParts, recorded: Mapping[str, str], folder: Path) -> None:
    """Raise Damaged for a part that is missing, unknown or does not match its digest; an empty part is not missing."""
    for part in sorted({*recorded, *parts}):
        if part not in recorded:
            raise Damaged(folder, f"{part}: a part without a recorded SHA-256")
        if _digest(parts.setdefault(part, {})) != recorded[part]:
            raise Damaged(folder, f"{part}: its SHA-256 is not the recorded one")


def from_json(kind: type[R], parts: CheckpointParts, part: str, folder: Path) -> R:
    """Return the record that a part holds as JSON, read strictly; raise Damaged, with the key, if it is invalid."""
    tensors = parts.get(part, {})
    if tensors.keys() != {JSON} or tensors[JSON].dtype != np.uint8:
        raise Damaged(folder, f"{part}: must be one tensor of bytes, {part}/{JSON}")
    try:
        data = json.loads(tensors[JSON].tobytes(), parse_constant=_refuse_constant)
        return kind.model_validate_json(tensors[JSON].tobytes(), strict=True)
    except ValidationError as error:
        raise Damaged(folder, f"{part}: {next(iter(refusals(error, kind, data)), 'not what it must be')}") from None
    except (ValueError, RecursionError) as error:
        raise Damaged(folder, f"{part}: is not JSON: {' '.join(str(error).split())}") from None


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a JSON number" if math.isnan(float(text)) else f"{text} is not finite")
