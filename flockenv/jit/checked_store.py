"""Named pieces of data in a private folder, each read whole or not at all.

A file begins with a digest of its name and of all that follows. One that was emptied, cut, or in which a bit has
changed, is never returned: one line on stderr reports it, and it is replaced when its data is written again. Files
are written by `flockenv.core.atomic_files`, so that no process ever reads half of one.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

from flockenv.core.atomic_files import remove_leftovers, replacing
from flockenv.jit.private_folder import read_private, say_once

__all__ = ["Store"]

HEAD = b"flockenv 1\n"
"""The first bytes of a file; another number for another format."""

DAY = 86_400.0
"""s: no process takes this long to write a file; older half-written ones were left by a process that was killed."""


class Store:
    """Data by name, a file each, in a folder that `private_folder.prepared` has returned."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _swept(folder)

    def read(self, name: str) -> bytes | None:
        """Return the data of this name, or None if there is none or it has changed since it was written."""
        found = self._found(name)
        if found is None:
            return None
        size = len(HEAD) + hashlib.sha256().digest_size
        data = found[size:]
        if found[:size] != _head(name, data):
            self._say_damaged(name)
            return None
        return data

    def write(self, name: str, data: bytes) -> None:
        """Keep data under this name; if it cannot be written, one line on stderr has the reason."""
        self._keep(name, _head(name, data) + data)

    def write_text(self, name: str, text: str) -> None:
        """Keep a text as it is, for people to read; a changed one is replaced, and one line reports it."""
        wanted, found = text.encode(), self._found(name)
        if found != wanted:
            if found is not None:
                self._say_damaged(name)
            self._keep(name, wanted)

    def _found(self, name: str) -> bytes | None:
        """Return a file's content; None if it is missing, or cannot be trusted or read, which one line reports."""
        path = self.folder / name
        try:
            return read_private(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            say_once(f"{error if error.strerror is None else f'{path}: {error.strerror}'}; made anew")
            return None

    def _say_damaged(self, name: str) -> None:
        say_once(f"{self.folder / name}: damaged; made anew")

    def _keep(self, name: str, data: bytes) -> None:
        """Write a file, or report why it could not be written: only the next start's time depends on it."""
        try:
            with replacing(self.folder / name, 0o600) as file:
                file.write(data)
        except OSError as error:
            line = f"compiled kernels cannot be kept ({error}); the next process compiles them again"
            say_once(line, f"{self.folder}: written")


@functools.cache
def _swept(folder: Path) -> None:
    """Remove what killed processes left half-written in a folder, once per process."""
    remove_leftovers(folder, DAY)


def _head(name: str, data: bytes) -> bytes:
    return HEAD + hashlib.sha256(b"%d " % len(name.encode()) + name.encode() + data).digest()
