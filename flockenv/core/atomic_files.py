"""Atomic writes of one file or of several together: each appears complete or not at all.

New files are written in a new folder beside their target. Only this user can enter it, and its name is unique, so no
other writer, and no link made by another user, can have the same name. They are synced to the disk, then renamed to
their target.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from flockenv.core import signals

__all__ = ["LEFTOVERS", "new_folder", "remove_leftovers", "replace_file", "write_all_or_none"]

_PREFIX, _SUFFIX = ".flockenv-", ".part"

LEFTOVERS = f"{_PREFIX}*{_SUFFIX}"
"""Glob of the temporary folders in which files are written; killed processes leave them behind."""


@contextmanager
def replace_file(path: str | os.PathLike[str], mode: int = 0o666) -> Iterator[BinaryIO]:
    """Open a new file for writing and rename it to `path` at the end; on any error it is removed.

    An existing file is replaced; a link is itself replaced, never followed. The folder must exist.
    mode: permissions of the file, restricted by the umask.
    Raises ValueError or OSError, in one line that names the path; before the first byte is written if possible.
    """
    target = _valid_target(Path(path))
    with _name_in_errors(target), _temporary_folder(target.parent) as scratch:
        part = scratch / "new"
        with open(part, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _rename({target: part})


def write_all_or_none(folder: Path, writers: Mapping[str, Callable[[Path], object]]) -> None:
    """Write several files and, when all are complete, rename them to their targets: all of them or none.

    No signal is handled between two renames, and if one fails, the earlier ones are undone. A process that is killed
    (SIGKILL, a power cut) between two renames leaves some of the files new and some old, each of them complete.

    Args:
        folder: created if it is missing.
        writers: path below the folder -> function that writes that file at the path it is passed.

    Raises:
        ValueError, OSError: in one line that names the file; or what a writer raises. The folder is then unchanged; if
            a file could not be restored, the message names those that are new.
    """
    with ExitStack() as stack:
        targets = {name: _path_below(folder, name) for name in writers}
        for place in dict.fromkeys(target.parent for target in targets.values()):
            stack.enter_context(new_folder(place))
        with _name_in_errors(folder):
            scratch = stack.enter_context(_temporary_folder(folder))
        parts = {target: scratch / name for name, target in targets.items()}
        for (target, part), write in zip(parts.items(), writers.values(), strict=True):
            with _name_in_errors(target, part):
                part.parent.mkdir(parents=True, exist_ok=True)
                write(part)
                _sync(part, os.O_RDWR)
        _rename(parts)


@contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its parents; if the block raises, remove those that were created and are empty."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    with ExitStack() as stack:
        for path in reversed(new):
            stack.enter_context(signals.remove_at_end(path, if_empty=True))
        folder.mkdir(parents=True, exist_ok=True)
        yield


def remove_leftovers(folder: Path, age: float = 0.0) -> None:
    """Remove leftovers of killed writers, at least `age` s old, from a folder that contains only files of flockenv."""
    latest = time.time() - age
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".") and entry.name.endswith((_SUFFIX, ".tmp")):
                with suppress(OSError):  # another process removes it
                    if entry.stat(follow_symlinks=False).st_mtime <= latest:
                        _remove(entry)


def _remove(entry: os.DirEntry[str]) -> None:
    if entry.is_dir(follow_symlinks=False):
        shutil.rmtree(entry.path)
    else:
        os.unlink(entry.path)


def _path_below(folder: Path, name: str) -> Path:
    """Return folder / name; raise as `_valid_target` if no file can be written there. The folder may be missing yet."""
    target = folder / name
    return _valid_target(target) if target.parent.exists() else target


def _valid_target(target: Path) -> Path:
    """Return the path if a file may be renamed to it; otherwise raise ValueError or OSError."""
    if "\0" in str(target):
        raise ValueError(f"path: must hold no NUL character, got {str(target)!r}")
    if not target.name or target.is_dir():
        raise IsADirectoryError(f"cannot write {str(target)!r}: it is a folder")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {str(target)!r}: there is no folder {str(target.parent)!r}")
    return target


@contextmanager
def _temporary_folder(folder: Path) -> Iterator[Path]:
    """Create a temporary folder in `folder`; remove it with its contents at the end of the block."""
    with ExitStack() as stack:
        with signals.defer_signals():
            scratch = tempfile.mkdtemp(_SUFFIX, _PREFIX, folder)
            stack.enter_context(signals.remove_at_end(scratch))
        yield Path(scratch)


@contextmanager
def _name_in_errors(target: Path, part: Path | None = None) -> Iterator[None]:
    """Name the target in an OSError about a new file, which has no name or a temporary one."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or _PREFIX in str(error.filename)):
            raise type(error)(f"cannot write {str(target)!r}: {error.strerror}") from None
        if part is not None and error.errno is None and str(part) in str(error):
            raise type(error)(str(error).replace(str(part), str(target))) from None
        raise


def _rename(parts: Mapping[Path, Path]) -> None:
    """Rename files to their targets, as `parts` (target -> file) lists them; on any error restore the old files."""
    with signals.defer_signals():
        kept = {target: _back_up(target, part) for target, part in parts.items()} if len(parts) > 1 else {}
        try:
            for target, part in parts.items():
                with _name_in_errors(target):
                    os.replace(part, target)
        except BaseException as error:
            moved = [target for target in kept if not os.path.lexists(parts[target])]
            new = [repr(str(target)) for target in moved if not _restore(target, kept[target])]
            if new:
                raise OSError(
                    f"{error}; of the files written together, {', '.join(new)} could not be put back"
                ) from error
            raise
    _sync_folders({target.parent for target in parts})


def _back_up(target: Path, part: Path) -> Path | None:
    """Hard-link, or copy, the file at a target to a name beside the new file; return it, None if there is no file."""
    if not os.path.lexists(target):
        return None
    old = part.with_name(f"{part.name}.old")
    with _name_in_errors(target):
        try:
            os.link(target, old, follow_symlinks=False)
        except (OSError, NotImplementedError):  # this file system has no hard links, or none to symbolic links
            shutil.copy2(target, old, follow_symlinks=False)
    return old


def _restore(target: Path, old: Path | None) -> bool:
    """Move the file `old` back to its target, or remove the new file if `old` is None; return True on success."""
    try:
        if old is None:
            target.unlink()
        else:
            os.replace(old, target)
    except OSError:
        return False
    return True


def _sync(path: Path, flags: int) -> None:
    """Sync a file, or the entries of a folder, to the disk."""
    handle = os.open(path, flags | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_folders(folders: Iterable[Path]) -> None:
    """Sync the entries of folders to the disk, on systems that can do so."""
    if os.name == "posix":
        for folder in folders:
            with suppress(OSError):  # some network file systems cannot
                _sync(folder, os.O_RDONLY)
