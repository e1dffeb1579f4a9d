"""Visit: one page that is connected: which messages it may send, what it has been sent, and what it waits for."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from typing import Final

from websockets.asyncio.server import ServerConnection

from flockenv.play import messages as m

__all__ = ["HostileError", "Visit"]

RATE: Final = 240.0
"""Messages a second that a page may send for long, and twice as many at once."""

MOST_WAITING: Final = 64
"""Most long messages that wait for their answers; then nothing more is read."""

GRACE: Final = 0.1
"""Seconds for which short messages wait for a long one before them; then they are answered first."""


class HostileError(Exception):
    """A message that no page sends; its text is for the log."""


class Visit:
    """A page that is connected.

    Its long messages, which may need something compiled, wait in a queue and are answered in order. All others are
    answered at once: frames always, the rest after a long message unless that takes longer than GRACE.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.version = (0, 0)
        """The version of the room that the page has been sent."""
        self._has_said_hello = False
        self._clock = asyncio.get_running_loop().time
        self._left, self._last = 2 * RATE, self._clock()
        self._waiting: deque[m.Message] = deque()
        self._news, self._idle, self._overdue = asyncio.Event(), asyncio.Event(), False
        self._space = asyncio.Semaphore(MOST_WAITING)
        self._idle.set()

    @property
    def address(self) -> str:
        """Where the page is."""
        return str((self.connection.remote_address or ("a page",))[0])

    def read(self, text: str | bytes) -> m.Message:
        """Return the message of a text; raise HostileError for one that no page sends."""
        now = self._clock()
        self._left = min(2 * RATE, self._left + (now - self._last) * RATE) - 1
        self._last = now
        if self._left < 0:
            raise HostileError(f"more than {RATE:g} messages a second")
        try:
            message = m.read_message(text)
        except ValueError as error:
            raise HostileError(str(error)) from None
        if not self._has_said_hello and not isinstance(message, m.Hello):
            raise HostileError(f"{message.type}: the first message must be hello")
        self._has_said_hello = True
        return message

    async def put(self, message: m.Message) -> None:
        """Let a long message wait; a newer value of what the last one waiting sets takes its place."""
        if self._waiting and _replaces(message, self._waiting[-1]):
            self._waiting[-1] = message
            return
        await self._space.acquire()
        self._waiting.append(message)
        self._idle.clear()
        self._news.set()

    async def take(self) -> m.Message:
        """Return the next long message when there is one; the one before it is done."""
        self._overdue = False
        if not self._waiting:
            self._news.clear()
            self._idle.set()
            await self._news.wait()
        self._space.release()
        return self._waiting.popleft()

    async def calm(self) -> None:
        """Return when no long message waits, or the present one takes longer than GRACE."""
        if self._idle.is_set() or self._overdue:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(GRACE):
                await self._idle.wait()
                return
        self._overdue = True

    def end(self) -> None:
        """Let nothing wait any longer."""
        self._idle.set()


def _replaces(new: m.Message, old: m.Message) -> bool:
    """Return True if both set the same value, so that the older one need not be answered."""
    if not isinstance(new, m.EditMessage) or not isinstance(old, m.EditMessage):
        return False
    same = all(new.edit.get(name) == old.edit.get(name) for name in ("kind", "path", "lane"))
    return same and new.edit["kind"] == "set"
