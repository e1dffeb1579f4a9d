"""Signal handling of commands: one line on stderr, exit code 128 + signal, and removal of unfinished files.

Python raises KeyboardInterrupt wherever the main thread happens to be: in an import, inside numba's compiler, in a
callback that swallows it and prints a traceback. A command handles its signals itself instead. KeyboardInterrupt is
raised only while a line of flockenv or agents is being executed, outside of imports and compilation. If no such line
is reached for PATIENCE seconds, or the command has not started yet, partly written files are removed and the process
ends.

This module imports nothing slow, so that it takes effect before Gymnasium, numba and torch are imported.
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

__all__ = [
    "begin",
    "begin_early",
    "begin_worker",
    "defer_signals",
    "exit_code",
    "exit_now",
    "handle_signals",
    "raise_if_received",
    "remove_at_end",
    "remove_unfinished",
    "set_message",
    "signal_line",
    "take_handlers_back",
    "take_message",
]

PATIENCE = 1.0
"""Seconds to wait for a line at which KeyboardInterrupt can be raised."""

AGAIN = 0.02
"""Seconds between two attempts to raise KeyboardInterrupt."""

ONE_PRESS = 0.3
"""Signals within this number of seconds count as one, as a terminal and a wrapper may each send one."""

SIGNALS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminated: the terminal was closed"}
"""Handled signals, if the system has them, and the text of their line on stderr."""

SAFE = {"flockenv", "agents", "__main__", "threading"}
"""Packages, by the first part of a module's name, with lines at which KeyboardInterrupt may be raised."""

CLOSED = {"numba", "llvmlite", "importlib", "_frozen_importlib", "_frozen_importlib_external", "pickle"}
"""Packages that are left in a broken state if an exception passes through them."""

PARENT = "FLOCKENV_PARENT"
"""Environment variable with the process id of a command; the processes that it starts end with it."""

WRITING = {"_write_atomic", "save_overload", "_save_overload", "_save_index", "_save_data"}
"""Functions of Python and numba that write a temporary file and rename it: these are not interrupted."""


class _Received:
    """State of the signal that this process is handling, if any."""

    name = "flockenv"
    text = ""  # the text of the line, instead of that of SIGNALS
    written = False  # the line has been written
    main = 0  # the thread that handles signals
    running = False  # the command itself has started: it may have results to save
    signal = 0
    since = 0.0
    raised = False  # KeyboardInterrupt has been raised; it may have been caught since
    again = False  # the next signal was sent by _watch


_ending = _thread.RLock()
"""Lock of the thread that ends the process; any other thread that tries to end it waits for the end."""

_unfinished: dict[str, bool] = {}
"""Files and folders that are not complete yet, in order of creation; True: removed only if empty."""

_deferring: set[object] = set()
"""Sections, in any thread, that must not be interrupted."""


def begin_early() -> None:
    """Start to handle signals if this process is a command of flockenv or agents; otherwise do nothing."""
    if "--multiprocessing-fork" in sys.orig_argv:
        if os.environ.get(PARENT) == str(os.getppid()):
            begin_worker()
            _thread.start_new_thread(_end_after, (os.getppid(),))
    elif name := early_signals.command():
        begin(name)


def begin(name: str) -> None:
    """Start to handle signals; every line begins with `name`. Ignored signals, as under nohup, stay ignored."""
    _Received.name = name
    if os.name != "posix":  # only Python's own KeyboardInterrupt is available
        return
    if not _Received.main:
        _Received.main = _thread.get_ident()
        arrived, written = os.pipe()
        os.set_blocking(written, False)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        _thread.start_new_thread(_watch, (arrived,))
    for which in SIGNALS:
        number = getattr(signal, which)
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def _finish() -> None:
    """Ignore signals from now on: the command is done, and its exit code is already determined.

    While Python shuts down, a thread that ends the process would write its line but not set the exit code.
    """
    if _Received.main:
        for which in SIGNALS:
            signal.signal(getattr(signal, which), signal.SIG_IGN)
        _ending.acquire()  # never released


def exit_now(code: int) -> None:
    """End an interrupted process at once: Python's own shutdown could be interrupted again."""
    remove_unfinished()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


def begin_worker() -> None:
    """Let SIGTERM alone end a worker process, without output; the command handles the other signals."""
    begin(_Received.name)
    _Received.written = True
    for which in ("SIGINT", "SIGHUP"):
        if hasattr(signal, which):
            signal.signal(getattr(signal, which), signal.SIG_IGN)


def _end_after(parent: int) -> None:
    """End this process once its parent's id is no longer `parent`: the parent has ended, perhaps by SIGKILL."""
    while os.getppid() == parent:
        time.sleep(0.25)
    os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def handle_signals(name: str) -> Iterator[None]:
    """Handle signals while a command runs; at its end remove partly written files and ignore later signals."""
    begin(name)
    _Received.running = True
    try:
        yield
    finally:
        remove_unfinished()
        _Received.running = False
        _finish()


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals until the end of a short block that must not be interrupted, such as renaming several files."""
    section = object()
    _deferring.add(section)  # a set, not a counter: `+= 1` from two threads may lose one
    try:
        yield
    finally:
        _deferring.discard(section)


def take_handlers_back() -> None:
    """Handle signals again if this process is a command: a library may have set handlers of its own."""
    if _Received.main:
        begin(_Received.name)


def raise_if_received() -> None:
    """Raise KeyboardInterrupt now if a signal has arrived at a line where that was not possible."""
    if _Received.signal and not _Received.raised:
        _Received.raised = True
        raise KeyboardInterrupt


@contextmanager
def remove_at_end(path: str | os.PathLike[str], if_empty: bool = False) -> Iterator[str]:
    """Remove a path at the end of the block, or if a signal ends the process; yield the absolute path.

    Complete files are no longer there, as they were renamed. if_empty: a folder is removed only if it is empty.
    """
    name = os.path.abspath(path)
    _unfinished[name] = if_empty
    try:
        yield name
    finally:
        _remove(name, if_empty)
        _unfinished.pop(name, None)


def remove_unfinished() -> None:
    """Remove all files and folders that are not complete."""
    for name, if_empty in reversed(list(_unfinished.items())):
        _remove(name, if_empty)
        _unfinished.pop(name, None)


def set_message(text: str) -> None:
    """Set the text of the line about a signal. A leading "interrupted" is replaced by the signal's own word."""
    _Received.text, _Received.written = text, False


def take_message() -> str:
    """Return the line about the signal and mark it as written; "" if it was written before."""
    if _Received.written:
        return ""
    _Received.written = True
    return signal_line(_Received.text or SIGNALS["SIGINT"])


def signal_line(text: str) -> str:
    """Return a line about the signal. A leading "interrupted" in `text` is replaced by the signal's own word."""
    word = SIGNALS[signal.Signals(_Received.signal or signal.SIGINT).name]
    rest = text.removeprefix(SIGNALS["SIGINT"])
    return f"{_Received.name}: {text if rest == text else word + rest}"


def exit_code() -> int:
    """Return the exit code of a command that was interrupted: 128 + the signal."""
    return 128 + (_Received.signal or signal.SIGINT)


def _remove(name: str, if_empty: bool = False) -> None:
    with suppress(OSError):  # it was renamed or never created
        if os.path.isdir(name) and not os.path.islink(name):
            for entry in () if if_empty else os.listdir(name):
                _remove(os.path.join(name, entry))
            os.rmdir(name)
        else:
            os.unlink(name)


def _handle(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt if the current line allows it; otherwise return, and end the process after PATIENCE."""
    own, now = _Received.again, time.monotonic()
    _Received.again = False
    if not _Received.signal:
        _Received.signal, _Received.since = number, now
    elif not own and now - _Received.since < ONE_PRESS:
        return
    if _deferring or _is_writing(frame) or (own and _Received.raised):
        return
    twice = not own and now - _Received.since > ONE_PRESS
    if not _Received.running or _Received.raised or twice or now - _Received.since > PATIENCE:
        _end(number)
    elif _can_raise(frame):
        _Received.raised = True
        raise KeyboardInterrupt


def _packages(frame: FrameType | None) -> Iterator[str]:
    while frame is not None:
        yield str(frame.f_globals.get("__name__", "")).split(".")[0]
        frame = frame.f_back


def _can_raise(frame: FrameType | None) -> bool:
    """Return True if a line of a SAFE package is being executed and no CLOSED package is on the call stack."""
    packages = list(_packages(frame))
    return bool(packages) and packages[0] in SAFE and CLOSED.isdisjoint(packages)


def _is_writing(frame: FrameType | None) -> bool:
    """Return True if Python or numba is writing a file of its own."""
    while frame is not None:
        if frame.f_code.co_name in WRITING:
            return True
        frame = frame.f_back
    return False


def _watch(signals: int) -> None:
    """Wait for signals, which the system writes to this pipe even while the main thread runs no Python code.

    After a signal, send it to the main thread again every AGAIN seconds until that has raised KeyboardInterrupt; end
    the process if it does not in time.
    """
    known = False  # KeyboardInterrupt has been raised
    while arrived := os.read(signals, 1):
        number = signal.Signals(arrived[0])
        if number.name not in SIGNALS:  # a signal of another library
            continue
        until = time.monotonic() + (2 * PATIENCE if _Received.running and not known else PATIENCE / 2)
        while known or not _Received.raised:
            if time.monotonic() > until and not _deferring:
                _end(_Received.signal or number)
            time.sleep(AGAIN)
            if not _Received.raised:
                _Received.again = True
                signal.pthread_kill(_Received.main, _Received.signal or number)
        known = True
        time.sleep(ONE_PRESS)
        while select.select([signals], [], [], 0)[0]:  # signals sent above, or from the same key press
            os.read(signals, 4096)


def _end(number: int) -> None:
    """Remove partly written files, write one line and end the process, without Python's own shutdown."""
    _ending.acquire()
    remove_unfinished()
    if _thread.get_ident() == _Received.main:
        with suppress(BaseException):  # closed, full, or in the middle of being written to
            sys.stdout.flush()
    _Received.signal = number
    line = take_message()
    cursor = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides the cursor
    try:
        os.write(2, f"{cursor}{line}\n".encode() if line else b"")
    finally:
        os._exit(128 + number)
