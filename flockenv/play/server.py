"""The server of the playground: one page, pictures, and a socket on which pages ask, change and watch.

All work on the worlds is done in one thread, in order. A frame is sent only as the answer to a question for one: a slow
page gets fewer frames, and nothing waits for it. A message that breaks the protocol ends its connection, with one line
in the log; the worlds stay as they are.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import socket
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from flockenv.core.errors import printable
from flockenv.play import messages as m
from flockenv.play.edits import read_edit
from flockenv.play.session import Answer, Session
from flockenv.render.page import page, policy

__all__ = ["PORT", "PlayServer"]

PORT: Final = 8712
"""The port if none is given."""

RATE: Final = 240.0
"""Messages a second that a page may send for long, and twice as many at once."""

REST: Final = 0.003
"""Seconds between two looks at the clock while the worlds run."""

WILDCARDS: Final = ("0.0.0.0", "::")  # noqa: S104  # named to be told apart
"""Values of `host` that stand for all addresses: there the token alone keeps others out."""

MOST_PAGES: Final = 32

PATIENCE: Final = 1.0
"""Seconds after which a page is sent a line that an answer takes longer."""

COMPILING: Final = "Computing … the first steps of a world compile its kernels, which takes some seconds, once."

_log = logging.getLogger("flockenv.play")
_quiet = logging.getLogger("flockenv.play.websockets")  # its tracebacks of broken connections are no news
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False


class _HostileError(Exception):
    """A message that no page sends; its text is for the log."""


class _Bucket:
    """Counts messages: RATE a second for long, twice as many at once."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._left, self._last = clock, 2 * RATE, clock()

    def take(self) -> bool:
        """Return False if there have been too many."""
        now = self._clock()
        self._left = min(2 * RATE, self._left + (now - self._last) * RATE) - 1
        self._last = now
        return self._left >= 0


class PlayServer:
    """Serves a session to pages.

    host: an address to listen at instead of the loopback's; then `token` is part of every address. port: 0: any that is
    free.
    """

    def __init__(self, session: Session, host: str | None = None, port: int = PORT) -> None:
        self.session, self.host, self.port = session, host, port
        self.token = secrets.token_urlsafe(24) if host else ""
        self._work = ThreadPoolExecutor(1, "flockenv-play")
        self._pages: set[ServerConnection] = set()
        self._html = page("live", "flockenv", {"version": m.VERSION})
        self._pictures = session.pictures()

    @property
    def url(self) -> str:
        """The address of the page."""
        host = socket.gethostname() if self.host in WILDCARDS else self.host or "127.0.0.1"
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    async def run(self, started: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled; raises OSError if the port is taken."""
        server = await self._listen()
        clock = asyncio.create_task(self._keep_time())
        started()
        try:
            await clock
        finally:
            clock.cancel()
            server.close()
            await server.wait_closed()
            self._work.shutdown(wait=False, cancel_futures=True)

    async def _listen(self) -> Server:
        server = await serve(
            self._talk, self.host or "127.0.0.1", self.port, origins=None, compression=None,
            process_request=self._answer_request, server_header=None, max_size=m.LARGEST, max_queue=16,
            open_timeout=10, close_timeout=1, ping_interval=20, ping_timeout=60, logger=_quiet,
        )  # fmt: skip
        self.port = server.sockets[0].getsockname()[1]
        return server

    async def _do(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Do some work on the worlds, after what was asked before."""
        return await asyncio.get_running_loop().run_in_executor(self._work, work, *arguments)

    async def _keep_time(self) -> None:
        """Let time pass in the worlds while a page is open."""
        while True:
            if self._pages and self.session.is_playing:
                await self._do(self.session.advance)
                await asyncio.sleep(REST)
            else:
                await asyncio.sleep(0.02)

    # --- requests ---------------------------------------------------------------------------------------------------

    def _names(self) -> set[str]:
        """Return the hosts by which this server may be addressed; none: by any, as it listens at all addresses."""
        if self.host in WILDCARDS:
            return set()
        hosts = {"127.0.0.1", "localhost", "[::1]"} if self.host is None else {self.host, f"[{self.host}]"}
        return {f"{host}:{self.port}".lower() for host in hosts}

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request, None to go on with the socket; a foreign Host or Origin gets none of it."""
        refused = self._refusal(request)
        if refused:
            _log.warning("%s: refused: %s", _address(connection), refused)
            return _response(HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", b"forbidden\n")
        path = urlsplit(request.path).path
        if path == "/ws":
            if len(self._pages) < MOST_PAGES:
                return None
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain; charset=utf-8", b"too many pages\n")
        if path == "/":
            return _response(HTTPStatus.OK, "text/html; charset=utf-8", self._html)
        if path == "/favicon.ico":
            return _response(HTTPStatus.NO_CONTENT, "image/x-icon", b"")
        picture = self._pictures.get(path.removeprefix("/pictures/")) if path.startswith("/pictures/") else None
        if picture is not None:
            return _response(HTTPStatus.OK, "image/png", picture)
        return _response(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"not found\n")

    def _refusal(self, request: Request) -> str:
        """Return why a request is not answered; "" if it is."""
        names, hosts, origins = self._names(), *map(request.headers.get_all, ("Host", "Origin"))
        if len(hosts) != 1 or (names and hosts[0].lower() not in names):
            return f"Host {printable(', '.join(hosts)[:80])}"
        if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
            return f"Origin {printable(', '.join(origins)[:80])}"
        address = urlsplit(request.path)
        if address.path == "/ws" and not origins:
            return "a socket without an Origin"
        given = parse_qs(address.query).get("token", [""])[0]
        if self.token and not secrets.compare_digest(given.encode(), self.token.encode()):
            return "no token, or a wrong one"
        return ""

    # --- a page -----------------------------------------------------------------------------------------------------

    async def _talk(self, connection: ServerConnection) -> None:
        """Answer the messages of a page until it goes; a message that breaks the protocol ends it."""
        self._pages.add(connection)
        try:
            await self._serve_page(connection)
        except _HostileError as error:
            _log.warning("%s: closed: %s", _address(connection), error)
            await connection.close(1008, str(error).encode()[:100].decode(errors="ignore"))
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code not in (1000, 1001, 1005):
                _log.warning("%s: closed: %s", _address(connection), error.sent.reason or error.sent.code)
        except Exception:
            _log.exception("%s: closed: an error of the server", _address(connection))
            await connection.close(1011)
        finally:
            self._pages.discard(connection)
            if not self._pages:
                await self._do(self.session.pause)

    async def _serve_page(self, connection: ServerConnection) -> None:
        bucket, seen = _Bucket(asyncio.get_running_loop().time), _Seen()
        async for text in connection:
            if not bucket.take():
                raise _HostileError(f"more than {RATE:g} messages a second")
            try:
                message = m.read_message(text)
            except ValueError as error:
                raise _HostileError(str(error)) from None
            if not seen.hello:
                if not isinstance(message, m.Hello):
                    raise _HostileError(f"{message.type}: the first message must be hello")
                seen.hello = True
            await self._reply(connection, message, seen)

    async def _reply(self, connection: ServerConnection, message: m.Message, seen: _Seen) -> None:
        """Send the answers to a message; a refusal is an answer too."""
        try:
            answers = await self._with_notice(connection, message)
        except (ValueError, TypeError, KeyError, IndexError, FloatingPointError, MemoryError) as error:
            answers = ({"type": "error", "text": _line(error), "about": message.type},)
        if seen.version != self.session.version:
            seen.version = self.session.version
            await connection.send(_json(await self._do(self.session.describe)))
        for answer in answers:
            await connection.send(answer if isinstance(answer, bytes) else _json(answer))

    async def _with_notice(self, connection: ServerConnection, message: m.Message) -> Sequence[Answer]:
        """Return the answers to a message; if they take long, tell the page."""
        task = asyncio.ensure_future(self._answer(message))
        if not isinstance(message, m.Frame):
            await asyncio.wait({task}, timeout=PATIENCE)
            if not task.done():
                await connection.send(_json({"type": "notice", "text": COMPILING, "busy": True}))
        return await task

    async def _answer(self, message: m.Message) -> Sequence[Answer]:
        if not isinstance(message, m.EditMessage):
            answers: Sequence[Answer] = await self._do(self.session.answer, message)
            return answers
        edit = await self._read_edit(message)
        await asyncio.to_thread(self.session.prepare, edit)
        done: Sequence[Answer] = await self._do(self.session.edit, edit)
        return done

    async def _read_edit(self, message: m.EditMessage) -> Any:
        try:
            return read_edit(message.edit)
        except ValueError as error:
            if not isinstance(message.edit.get("kind"), str):
                raise _HostileError(str(error)) from None
            raise


class _Seen:
    """What a page has been sent: whether it said hello, and the version of the room that it knows."""

    def __init__(self) -> None:
        self.hello, self.version = False, (0, 0)


def _json(data: object) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _line(error: BaseException) -> str:
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split())[:500] or type(error).__name__


def _address(connection: ServerConnection) -> str:
    return str((connection.remote_address or ("a page",))[0])


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    """Return a response that no cache keeps, no other site frames and no browser guesses the type of."""
    headers = Headers({
        "Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close", "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
        "Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Resource-Policy": "same-origin",
        "Content-Security-Policy": policy("live") + "; frame-ancestors 'none'",
    })  # fmt: skip
    return Response(status.value, status.phrase, headers, body)
