"""Folders and files that only this user, or the system's administrator, can change.

Kernels are code: what is read from their folder is executed. So the folder is checked before anything is read from it:
it must be a folder and no link, it must belong to this user, no other user may write to it, and no other user may
rename or replace any folder above it. Files are checked after they have been opened, so that none can be replaced after
the check. Windows has one temporary folder per user and no such modes: nothing is checked there.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

__all__ = ["NotPrivateError", "ensure_private", "first_private", "read_private", "say_once"]

CHECKED = hasattr(os, "geteuid")
"""True if this system has owners and modes to check."""

_log = logging.getLogger("flockenv.jit")

_said: set[str] = set()


class NotPrivateError(PermissionError):
    """A folder or file that another user owns or can change; the message is one line."""


def say_once(line: str, about: str = "") -> None:
    """Log one line as a warning unless this process has already logged one with the same `about` or text."""
    if (about or line) not in _said:
        _said.add(about or line)
        _log.warning("flockenv: %s", line)


def ensure_private(folder: Path) -> Path:
    """Return a folder that only this user can change; create it (mode 0700) if it is missing.

    Raises:
        NotPrivateError: the folder is a link, or it or a parent belongs to another user or can be changed by one.
        OSError: it cannot be created or written.
    """
    _create(folder)
    for place in _path_entries(folder):
        _check_above(place)
    check_folder(folder)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder}: cannot be written")
    return folder


def check_folder(folder: Path) -> None:
    """Raise NotPrivateError unless `folder` is a folder, not a link, owned and writable by this user alone."""
    _check(os.lstat(folder), folder, stat.S_ISDIR, "a folder")


def read_private(path: Path) -> bytes:
    """Return the content of a plain file that belongs to this user and that no other user can write.

    The open file is checked: links are not followed, and the call does not wait for a pipe.

    Raises:
        NotPrivateError: it is not such a file.
        FileNotFoundError: there is no file.
    """
    flags = [getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY")]
    try:
        handle = os.open(path, os.O_RDONLY | sum(flags))
    except OSError as error:
        if os.path.islink(path):
            raise NotPrivateError(f"{path}: is a link, must be a plain file") from error
        raise
    try:
        _check(os.fstat(handle), path, stat.S_ISREG, "a plain file")
        with open(handle, "rb", closefd=False) as stream:
            return stream.read()
    finally:
        os.close(handle)


def first_private(home: Path, temporary: Path, name: str) -> Path:
    """Return the first folder that only this user can change: `home`, temporary/name, or a new one beside that.

    A folder that fails the check is skipped, and one line on stderr reports the reason. The new one is named
    name-XXXXXXXX; later processes find it again.

    Raises:
        OSError: none of them can be created.
    """
    fallback, wrong = temporary / name, []
    for find, folder in ((ensure_private, home), (ensure_private, fallback), (_private_sibling, fallback)):
        try:
            found = find(folder)
        except NotPrivateError as error:
            wrong.append(str(error))
        except OSError:
            continue
        else:
            if wrong:
                say_once(f"{'; '.join(wrong)}; compiled kernels are kept in {found} (FLOCKENV_CACHE names another)")
            return found
    raise OSError("; ".join([f"no folder for compiled kernels (tried {home} and {fallback})", *wrong]))


def _private_sibling(folder: Path) -> Path:
    """Return a private folder beside `folder` with -XXXXXXXX appended to its name: an existing one, or a new one."""
    for place in _path_entries(folder):
        _check_above(place)
    for other in sorted(folder.parent.glob(f"{folder.name}-*")):
        try:
            return ensure_private(other)
        except OSError:  # it belongs to another user
            continue
    return ensure_private(Path(tempfile.mkdtemp(prefix=f"{folder.name}-", dir=folder.parent)))


def _create(folder: Path) -> None:
    """Create a folder for this user alone; missing parents are created readable, but not writable, for others."""
    if not os.path.lexists(folder):
        for above in reversed(folder.absolute().parents):
            if not above.exists():
                above.mkdir(mode=0o755, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)


def _path_entries(folder: Path) -> Iterator[Path]:
    """Yield every folder and every link on the path to a folder, except the folder itself."""
    at, left = Path(folder.absolute().anchor), list(reversed(folder.absolute().parts[1:]))
    while left:
        yield at
        step = at / left.pop()
        if left and step.is_symlink():
            yield step
            target = Path(os.readlink(step))
            at = Path(target.anchor) if target.is_absolute() else at
            left += reversed(target.parts[1:] if target.is_absolute() else target.parts)
        else:
            at = at.parent if step.name == ".." else step


def _check_above(place: Path) -> None:
    """Raise NotPrivateError if another user can rename or replace the entries of a folder, or replace a link."""
    if not CHECKED:
        return
    found = os.lstat(place)
    trusted = {0, os.geteuid(), os.stat("/").st_uid}  # the last: in a container the administrator may have another id
    if found.st_uid not in trusted:
        raise NotPrivateError(f"{place}: belongs to user {found.st_uid}, which could replace its content")
    if not stat.S_ISLNK(found.st_mode) and _is_writable_by_others(found) and not found.st_mode & stat.S_ISVTX:
        raise NotPrivateError(f"{place}: other users can replace its content (mode {_mode(found)}); chmod go-w it")


def _check(found: os.stat_result, path: Path, is_kind: Callable[[int], bool], kind: str) -> None:
    """Raise NotPrivateError unless `path` is of this kind, belongs to this user, and no other user can write it."""
    if stat.S_ISLNK(found.st_mode):
        raise NotPrivateError(f"{path}: is a link, must be {kind}")
    if not is_kind(found.st_mode):
        raise NotPrivateError(f"{path}: must be {kind}")
    if not CHECKED:
        return
    if found.st_uid != os.geteuid():
        raise NotPrivateError(f"{path}: belongs to user {found.st_uid}, must belong to user {os.geteuid()}")
    if _is_writable_by_others(found):
        raise NotPrivateError(f"{path}: other users can write it (mode {_mode(found)}); chmod go-w it")


def _is_writable_by_others(found: os.stat_result) -> bool:
    """Return True if users other than the owner can write it; root's group and this user's own group do not count."""
    mode = found.st_mode
    return bool(mode & stat.S_IWOTH) or (bool(mode & stat.S_IWGRP) and not _is_of_one_user(found.st_gid))


def _is_of_one_user(group: int) -> bool:
    """Return True if a group is root's, or the private group of this user: same name, and no other member."""
    import grp  # here: Windows has neither
    import pwd

    try:
        me, members = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return group == 0
    return group == 0 or (group == me.pw_gid and members.gr_name == me.pw_name and set(members.gr_mem) <= {me.pw_name})


def _mode(found: os.stat_result) -> str:
    return f"{stat.S_IMODE(found.st_mode):04o}"
