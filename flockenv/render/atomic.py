"""replacing(): a file appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

__all__ = ["replacing"]


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file beside `path` for writing and rename it to `path` at the end; on any error nothing is left behind.

    An existing file is replaced; a link is replaced itself and never followed. The folder must exist.
    Raises ValueError or OSError, in one line that names the path, before the first byte where that can be known.
    """
    target = Path(path)
    if "\0" in str(target):
        raise ValueError(f"path: must hold no NUL character, got {str(target)!r}")
    if not target.name or target.is_dir():
        raise IsADirectoryError(f"cannot write {str(target)!r}: it is a folder")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {str(target)!r}: there is no folder {str(target.parent)!r}")
    part = target.with_name(f".{target.name[:100]}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
    except OSError as error:
        if error.filename not in (str(part), str(target)):
            raise
        raise type(error)(f"cannot write {str(target)!r}: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)
