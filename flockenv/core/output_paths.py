"""Checks of output paths, made before the work begins."""

from __future__ import annotations

import os
import re
import tempfile
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from flockenv.core.errors import nearest

__all__ = ["check_room", "valid_file", "valid_path"]

LONGEST_NAME, LONGEST_PATH = 200, 1000

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows reserves for devices: a file of such a name cannot be copied there."""


def valid_path(text: str, option: str = "--out") -> Path:
    """Return the absolute path of a file or folder that may be written; nothing is created or changed.

    With links resolved, it must lie below the current folder or the system's folder for temporary files, so that a
    mistyped path does not write among unrelated files.

    Raises:
        ValueError: in one line: the option, the path, and what is wrong with it.
    """
    fault = _fault(text) or _fault_of_place(Path(text))
    if fault:
        raise ValueError(f"{option} {_printable(text)}: {fault}")
    return Path(text).resolve()


def valid_file(
    text: str, suffixes: Sequence[str], force: bool = False, option: str = "--out", beside: str | None = None
) -> Path:
    """Return the absolute path of a file that may be written and has one of `suffixes`.

    beside: the suffix of a second file that is written with it, checked in the same way; "" for a folder.

    Raises:
        ValueError: as `valid_path`; for another suffix; if the file exists and `force` is not given.
    """
    path = valid_path(text, option)
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ValueError(f"{option} {_printable(text)}: must end in {' or '.join(suffixes)}{nearest(suffix, suffixes)}")
    if path.is_dir():
        raise ValueError(f"{option} {_printable(text)}: is a folder")
    if path.exists() and not force:
        raise ValueError(f"{option} {_printable(text)}: exists already; --force overwrites it")
    if beside == "":
        if path.with_suffix("").exists() and not path.with_suffix("").is_dir():
            raise ValueError(f"{option} {_printable(text)}: {path.stem!r} beside it is a file, must be a folder")
    elif beside is not None and beside != suffix:
        valid_file(str(path.with_suffix(beside)), [beside], force, option)
    return path


def _fault(text: str) -> str:
    """Return what is wrong with a path as text, '' if nothing."""
    if not text.strip() or any(unicodedata.category(c) in ("Cc", "Cf", "Cs") for c in text):
        return "must be a name without control characters"
    parts = Path(text).parts
    if len(text) > LONGEST_PATH or any(len(os.fsencode(part)) > LONGEST_NAME for part in parts):
        return f"too long: at most {LONGEST_NAME} bytes per name and {LONGEST_PATH} characters in all"
    if ".." in parts:
        return "must not go up with '..'"
    reserved = [part for part in parts if _RESERVED.fullmatch(part)]
    return f"{reserved[0]!r} is a reserved name" if reserved else ""


def _fault_of_place(path: Path) -> str:
    """Return the reason why nothing may be written at a path, '' if there is none."""
    target = path.resolve()
    allowed = [Path.cwd().resolve(), Path(tempfile.gettempdir()).resolve()]
    if not any(target.is_relative_to(base) for base in allowed):
        return f"must lie below {allowed[0]} or {allowed[1]}"
    around = target.parents if target.is_file() else (target, *target.parents)
    folder = next(place for place in around if place.exists())
    if not folder.is_dir():
        return f"{_printable(str(folder))} is not a folder"
    return "" if os.access(folder, os.W_OK | os.X_OK) else f"{_printable(str(folder))} cannot be written to"


def _printable(text: str) -> str:
    return repr(text) if len(text) <= 200 else f"{text[:80]!r}... ({len(text)} characters)"


def check_room(path: Path, size: int) -> None:
    """Raise OSError, in one line, if a file of `size` bytes cannot be written at `path` now.

    A temporary file of that size is allocated in the nearest existing parent folder and removed again.
    """
    target = path.resolve()
    folder = next(place for place in target.parents if place.exists())
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        raise type(error)(f"cannot write {str(path)!r} ({size:,} bytes): {error.strerror}") from None
