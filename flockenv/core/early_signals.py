"""Blocking of signals from the start of a command until `flockenv.core.signals` handles them.

`signals` takes milliseconds to import. This module imports only what Python has already loaded by itself; even `from
__future__ import annotations` would load a file.
"""

import _signal  # type: ignore[import-not-found]  # built in; `signal` imports enum first
import os
import sys

__all__ = ["command", "release"]

_PACKAGE = os.path.join(os.path.dirname(os.path.dirname(__file__)), "__init__.py")


def command() -> str:
    """Return the name of the flockenv or agents command that this process runs, "" if it runs none."""
    words, program = sys.orig_argv, sys.argv[:1]
    if program == ["-m"] and "-m" in words[:-1]:  # Python has not located the module to run yet
        package, _, module = words[words.index("-m") + 1].rpartition(".")
        return module if package.split(".")[0] == "agents" and _is_beside_flockenv("agents") else ""
    script = os.path.basename(program[0]).split(".")[0].removesuffix("-script") if program else ""
    return script if script == "flockenv" else ""


def _is_beside_flockenv(package: str) -> bool:
    """Return True if this package lies beside flockenv: other programs may also have a package `agents`."""
    file = getattr(sys.modules.get(package), "__file__", None) or ""
    theirs, ours = (os.path.dirname(os.path.dirname(os.path.realpath(path))) for path in (file, _PACKAGE))
    return theirs == ours


def _block() -> set[int] | None:
    """Block the signals that commands handle; return those blocked before, or None if nothing was changed."""
    if os.name != "posix" or not command():
        return None
    return set(_signal.pthread_sigmask(_signal.SIG_BLOCK, (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP)))


_before = _block()


def release() -> None:
    """Restore the signal mask from before this module was imported; signals that arrived meanwhile are delivered."""
    global _before
    if _before is not None:
        _before, mask = None, _before
        _signal.pthread_sigmask(_signal.SIG_SETMASK, mask)
