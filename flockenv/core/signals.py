"""Ends of commands by signals: one line on stderr, exit code 128 + signal, nothing half-written is left.

Python raises KeyboardInterrupt wherever the main thread happens to be: in an import, inside numba's compiler, in a
callback that swallows it and prints a traceback. A command handles its signals itself instead. KeyboardInterrupt is
raised only while a line of flockenv or agents is being executed, outside of imports and compilation. Where there is no
such line for PATIENCE seconds, and before the command itself has begun, what is half-written is removed and the process
ends.

This module imports nothing that takes time, so that it is in force before Gymnasium, numba and torch are imported.
"""

from __future__ import annotations

import _thread
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from flockenv.core import early_signals

__all__ = ["begin", "begin_early", "clean", "code", "held", "leave", "running", "said", "say", "serve", "unfinished"]

PATIENCE = 1.0
"""Seconds to wait for a line at which KeyboardInterrupt can be raised."""

AGAIN = 0.02
"""Seconds between two looks for such a line."""

ONE_PRESS = 0.3
"""Signals within this number of seconds count as one: a terminal and a wrapper may each send their own."""

SIGNALS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminated: the terminal was closed"}
"""Signals that are handled, if the system has them, and the words of their line."""

SAFE = {"flockenv", "agents", "__main__", "threading"}
"""Packages, by the first part of a module's name, with lines at which KeyboardInterrupt may be raised."""

CLOSED = {"numba", "llvmlite", "importlib", "_frozen_importlib", "_frozen_importlib_external", "pickle"}
"""Packages that are left in a broken state if an exception passes through them."""

PARENT = "FLOCKENV_PARENT"
"""Variable of the environment with the number of a command's process: processes that it starts are to end with it."""

WRITING = {"_write_atomic", "save_overload", "_save_overload", "_save_index", "_save_data"}
"""Functions of Python and numba that write a file beside its place and rename it: these run to their end."""


class _Asked:
    """The signal that this process is handling, if any, and the progress of that."""

    name = "flockenv"
    text = ""  # the words of the line, instead of those of SIGNALS
    said = False  # the line has been written
    main = 0  # the thread that handles signals
    running = False  # the command itself has begun: it may have results to keep
    signal = 0
    since = 0.0
    raised = False  # KeyboardInterrupt has been raised; it may have been caught since
    again = False  # the next signal is sent by _watch


_ending = _thread.RLock()
"""Held by the thread that ends the process, from its decision on; any other thread waits until the process is gone."""

_unfinished: dict[str, bool] = {}
"""Files and folders that are half-written, in the order in which they were made; True: removed only if empty."""

_held: set[object] = set()
"""Sections of any thread that must not be left in the middle."""


def begin_early() -> None:
    """Handle signals from here on if this process is a command of flockenv or agents; else leave it as it is."""
    if "--multiprocessing-fork" in sys.orig_argv:
        if os.environ.get(PARENT) == str(os.getppid()):
            serve()
            _thread.start_new_thread(_follow, (os.getppid(),))
    elif name := early_signals.command():
        begin(name)


def begin(name: str) -> None:
    """Handle signals from here on; `name` begins every line. A signal that is ignored, as under nohup, stays so."""
    _Asked.name = name
    if os.name != "posix":  # there is only Python's own KeyboardInterrupt
        return
    if not _Asked.main:
        _Asked.main = _thread.get_ident()
        arrived, written = os.pipe()
        os.set_blocking(written, False)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        _thread.start_new_thread(_watch, (arrived,))
    for which in SIGNALS:
        number = getattr(signal, which)
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def _finish() -> None:
    """Ignore signals from here on: the command has done its work, and its exit code is that of the work.

    While Python shuts down, a thread that ends the process would write its line but not set the exit code.
    """
    if _Asked.main:
        for which in SIGNALS:
            signal.signal(getattr(signal, which), signal.SIG_IGN)
        _ending.acquire()  # never released


def leave(code: int) -> None:
    """End an interrupted process at once: Python's own shutdown could be interrupted again."""
    clean()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


def serve() -> None:
    """Let a process that works for a command end by SIGTERM alone, without output; the command handles the rest."""
    begin(_Asked.name)
    _Asked.said = True
    for which in ("SIGINT", "SIGHUP"):
        if hasattr(signal, which):
            signal.signal(getattr(signal, which), signal.SIG_IGN)


def _follow(parent: int) -> None:
    """End this process when its parent has ended, even by SIGKILL: it is another's child then."""
    while os.getppid() == parent:
        time.sleep(0.25)
    os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def running(name: str) -> Iterator[None]:
    """Handle signals while a command runs; nothing half-written is left at its end, and later signals are ignored."""
    begin(name)
    _Asked.running = True
    try:
        yield
    finally:
        clean()
        _Asked.running = False
        _finish()


@contextmanager
def held() -> Iterator[None]:
    """Handle no signal before the end of a short section that must run whole, such as renaming several files."""
    section = object()
    _held.add(section)  # two threads may count at once: `+= 1` would lose one of them
    try:
        yield
    finally:
        _held.discard(section)


@contextmanager
def unfinished(path: str | os.PathLike[str], if_empty: bool = False) -> Iterator[str]:
    """Remove a file or folder at the end of a block, or when a signal ends the process before; yield its full path.

    What is whole by then has been renamed. if_empty: a folder is removed only if nothing is in it.
    """
    name = os.path.abspath(path)
    _unfinished[name] = if_empty
    try:
        yield name
    finally:
        _remove(name, if_empty)
        _unfinished.pop(name, None)


def clean() -> None:
    """Remove everything that is half-written."""
    for name, if_empty in reversed(list(_unfinished.items())):
        _remove(name, if_empty)
        _unfinished.pop(name, None)


def say(text: str) -> None:
    """Set the words of the line about a signal. A leading "interrupted" becomes the signal's own word."""
    _Asked.text, _Asked.said = text, False


def said() -> str:
    """Return the line about the signal that is to be written now, "" if it has been written."""
    if _Asked.said:
        return ""
    _Asked.said = True
    number = _Asked.signal or signal.SIGINT
    word, text = SIGNALS[signal.Signals(number).name], _Asked.text or SIGNALS["SIGINT"]
    kept = text.removeprefix(SIGNALS["SIGINT"])
    return f"{_Asked.name}: {text if kept == text else word + kept}"


def code() -> int:
    """Return the exit code of a command that was interrupted: 128 + the signal."""
    return 128 + (_Asked.signal or signal.SIGINT)


def _remove(name: str, if_empty: bool = False) -> None:
    with suppress(OSError):  # it was renamed, or never made
        if os.path.isdir(name) and not os.path.islink(name):
            for entry in () if if_empty else os.listdir(name):
                _remove(os.path.join(name, entry))
            os.rmdir(name)
        else:
            os.unlink(name)


def _handle(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt if this is a line where it can be raised; else look again soon, but not for long."""
    own, now = _Asked.again, time.monotonic()
    _Asked.again = False
    if not _Asked.signal:
        _Asked.signal, _Asked.since = number, now
    elif not own and now - _Asked.since < ONE_PRESS:
        return
    if _held or _is_writing(frame) or (own and _Asked.raised):
        return
    twice = not own and now - _Asked.since > ONE_PRESS
    if not _Asked.running or _Asked.raised or twice or now - _Asked.since > PATIENCE:
        _end(number)
    elif _can_raise(frame):
        _Asked.raised = True
        raise KeyboardInterrupt


def _packages(frame: FrameType | None) -> Iterator[str]:
    while frame is not None:
        yield str(frame.f_globals.get("__name__", "")).split(".")[0]
        frame = frame.f_back


def _can_raise(frame: FrameType | None) -> bool:
    """True if a line of ours is being executed, and nothing that must not be left in the middle is under way."""
    packages = list(_packages(frame))
    return bool(packages) and packages[0] in SAFE and CLOSED.isdisjoint(packages)


def _is_writing(frame: FrameType | None) -> bool:
    """True if Python or numba is writing a file of its own."""
    while frame is not None:
        if frame.f_code.co_name in WRITING:
            return True
        frame = frame.f_back
    return False


def _watch(signals: int) -> None:
    """Wait for signals, which the system writes to this pipe even while the main thread runs no Python code.

    Then have the main thread look every AGAIN seconds until it is done; end the process if it cannot be reached.
    """
    known = False  # that KeyboardInterrupt has been raised
    while arrived := os.read(signals, 1):
        number = signal.Signals(arrived[0])
        if number.name not in SIGNALS:  # another library's
            continue
        until = time.monotonic() + (2 * PATIENCE if _Asked.running and not known else PATIENCE / 2)
        while known or not _Asked.raised:
            if time.monotonic() > until and not _held:
                _end(_Asked.signal or number)
            time.sleep(AGAIN)
            if not _Asked.raised:
                _Asked.again = True
                signal.pthread_kill(_Asked.main, _Asked.signal or number)
        known = True
        time.sleep(ONE_PRESS)
        while select.select([signals], [], [], 0)[0]:  # those that were sent above, or are the same press of a key
            os.read(signals, 4096)


def _end(number: int) -> None:
    """Remove what is half-written, write one line and end the process, without Python's own shutdown."""
    _ending.acquire()
    clean()
    if _thread.get_ident() == _Asked.main:
        with suppress(BaseException):  # closed, full, or in the middle of being written to
            sys.stdout.flush()
    _Asked.signal = number
    line = said()
    cursor = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""  # a bar hides the cursor
    try:
        os.write(2, f"{cursor}{line}\n".encode() if line else b"")
    finally:
        os._exit(128 + number)
