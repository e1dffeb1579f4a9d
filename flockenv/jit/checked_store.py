"""Named data in a private folder, verified by a digest when it is read.

A file begins with a digest of its name and of all that follows. The content of an emptied, truncated or changed file is
never returned: one line on stderr reports it, and it is replaced when its data is written again. Files are written by
`flockenv.core.atomic_files`, so that no process ever reads half of one.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

from flockenv.core.atomic_files import remove_leftovers, replace_file
from flockenv.jit.private_folder import read_private, say_once

__all__ = ["Store"]

HEAD = b"flockenv 1\n"
"""The first bytes of a file; the number is the version of the format."""

DAY = 86_400.0
"""s, age from which an incomplete file is assumed to be from a killed process."""


class Store:
    """Store of data by name, one file each, in a folder that `private_folder.ensure_private` returned."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _remove_old_leftovers(folder)

    def read(self, name: str) -> bytes | None:
        """Return the data of this name, or None if there is none or it has changed since it was written."""
        found = self._content(name)
        if found is None:
            return None
        size = len(HEAD) + hashlib.sha256().digest_size
        data = found[size:]
        if found[:size] != _header(name, data):
            self._report_damaged(name)
            return None
        return data

    def write(self, name: str, data: bytes) -> None:
        """Store data under this name; if it cannot be written, report the reason in one line on stderr."""
        self._write_or_report(name, _header(name, data) + data)

    def write_text(self, name: str, text: str) -> None:
        """Store a text without a digest, for people to read; replace a file that differs, reported in one line."""
        wanted, found = text.encode(), self._content(name)
        if found != wanted:
            if found is not None:
                self._report_damaged(name)
            self._write_or_report(name, wanted)

    def _content(self, name: str) -> bytes | None:
        """Return a file's content; None if it is missing, or (reported in one line) not private or not readable."""
        path = self.folder / name
        try:
            return read_private(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            say_once(f"{error if error.strerror is None else f'{path}: {error.strerror}'}; rebuilt")
            return None

    def _report_damaged(self, name: str) -> None:
        say_once(f"{self.folder / name}: damaged; rebuilt")

    def _write_or_report(self, name: str, data: bytes) -> None:
        """Write a file, or report the reason for failure: without it, only the next start takes longer."""
        try:
            with replace_file(self.folder / name, 0o600) as file:
                file.write(data)
        except OSError as error:
            line = f"compiled kernels cannot be kept ({error}); the next process compiles them again"
            say_once(line, f"{self.folder}: written")


@functools.cache
def _remove_old_leftovers(folder: Path) -> None:
    """Remove incomplete files of killed processes from a folder, once per process."""
    remove_leftovers(folder, DAY)


def _header(name: str, data: bytes) -> bytes:
    return HEAD + hashlib.sha256(b"%d " % len(name.encode()) + name.encode() + data).digest()
