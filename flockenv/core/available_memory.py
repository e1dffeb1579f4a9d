"""Memory that this machine, or the control group of this process, has left; batch systems limit jobs by such groups."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

__all__ = ["available_memory"]


GROUPS = (
    (r"^0::/(.*)$", "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
    (
        r"^\d+:memory:/(.*)$", "sys/fs/cgroup/memory",
        "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file",
    ),
)  # fmt: skip
"""For version 2 and 1 of control groups: the line with the path of this process's group, the folder of all groups, and
where a group's limit, its use, and the reclaimable part of that are."""


def available_memory(root: Path = Path("/")) -> int | None:
    """Return the bytes that new processes can use; None if the system does not say: only Linux does.

    root: of the file system with proc and sys. It is the least of MemAvailable and what is left in each control group
    of this process, whose file cache counts as left (Linux: Documentation/filesystems/proc.rst, cgroup-v2.rst).
    """
    found = list(_left_in_groups(root))
    with suppress(OSError):
        found += [1024 * number for number in _numbers(root / "proc/meminfo", r"^MemAvailable: +(\d+) kB")]
    return max(0, min(found)) if found else None


def _left_in_groups(root: Path) -> Iterator[int]:
    """Yield the bytes left in each control group of this process that has a limit, from the inner to the outer ones."""
    for line, folder, limit, use, cache in GROUPS:
        top = root / folder
        with suppress(OSError):
            for path in re.findall(line, (root / "proc/self/cgroup").read_text(), re.MULTILINE):
                for group in (top / path, *(top / path).parents):
                    if group.is_relative_to(top):
                        with suppress(OSError):
                            yield from _left(group, limit, use, cache)


def _left(group: Path, limit: str, use: str, cache: str) -> list[int]:
    """Return what a control group has left; an empty list if it has no limit."""
    limits, used = _numbers(group / limit, r"^(\d+)"), _numbers(group / use, r"^(\d+)")
    return [most - sum(used) + sum(_numbers(group / "memory.stat", rf"^{cache} (\d+)")) for most in limits]


def _numbers(file: Path, pattern: str) -> list[int]:
    """Return the numbers that a pattern finds in a file."""
    return [int(text) for text in re.findall(pattern, file.read_text(), re.MULTILINE)]
