"""The server of the playground: one page, pictures, and a socket on which pages ask, change and watch.

All work on the worlds is done in one thread, in order. What must be built for it first is built in another thread, and
what must be compiled is compiled in a child process, so that worlds and frames go on meanwhile. A frame is sent only as
the answer to a question for one: a slow page gets fewer frames, and nothing waits for it. A message that breaks the
protocol ends its connection, with one line in the log; the worlds stay as they are.
"""

from __future__ import annotations

import asyncio
import functools
import json
import logging
import secrets
import socket
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from flockenv.core.errors import printable
from flockenv.jit.lock import NotCachedError, only_cached
from flockenv.play import messages as m
from flockenv.play.compiling import Compiler
from flockenv.play.session import Answer, Session
from flockenv.play.visit import HostileError, Visit
from flockenv.render.page import page, policy

__all__ = ["PlayServer"]

REST: Final = 0.003
"""Seconds between two looks at the clock while the worlds run."""

WILDCARDS: Final = ("0.0.0.0", "::")  # noqa: S104  # named to be told apart
"""Values of `host` that stand for all addresses: there the token alone keeps others out."""

MOST_PAGES: Final = 32

PATIENCE: Final = 0.5
"""Seconds after which a page is sent a line that an answer takes longer."""

COMPILING: Final = "Compiling … this takes some seconds, the first time only."
DONE: Final = {"type": "notice", "text": ""}

_log = logging.getLogger("flockenv.play")
_quiet = logging.getLogger("flockenv.play.websockets")  # its tracebacks of broken connections are no news
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False


class PlayServer:
    """Serves a session to pages.

    host: an address to listen at instead of the loopback's; then `token` is part of every address. port: 0: any that is
    free.
    """

    def __init__(self, session: Session, host: str | None = None, port: int = 0) -> None:
        self.session, self.host, self.port = session, host, port
        self.token = secrets.token_urlsafe(24) if host else ""
        self._work = ThreadPoolExecutor(1, "flockenv-play")
        self._beside = ThreadPoolExecutor(1, "flockenv-compile")
        self._measuring = ThreadPoolExecutor(1, "flockenv-measure")
        self._compiler = Compiler()
        self._colouring: asyncio.Task[None] | None = None
        self._pages: set[ServerConnection] = set()
        self._html = page("live", "flockenv", {"version": m.VERSION, "largest": m.LARGEST, "longest": m.LARGEST_TEXT})
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
            self._compiler.close()
            for pool in (self._work, self._beside, self._measuring):
                pool.shutdown(wait=False, cancel_futures=True)

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

    async def _aside(self, work: Callable[[], Any], message: m.Message | None = None) -> Any:
        """Do the part of a message that may compile, None: of the steps, beside the work on the worlds."""
        twin = functools.partial(self.session.twin, message)
        return await asyncio.get_running_loop().run_in_executor(self._beside, self._compiler.do, work, twin)

    async def _keep_time(self) -> None:
        """Let time pass in the worlds while a page is open."""
        while True:
            if not self._pages or not self.session.is_playing:
                await asyncio.sleep(0.02)
                continue
            await self._compile()
            await self._do(self.session.advance)
            await asyncio.sleep(REST)

    async def _compile(self) -> None:
        """Compile the steps of the open worlds if that is due."""
        if not self.session.is_compiled:
            await self._announced(self._aside(self.session.compile))

    async def _announced(self, work: Coroutine[Any, Any, Any]) -> None:
        """Wait for what compiles; all pages get a line if it takes long."""
        task = asyncio.ensure_future(work)
        await asyncio.wait({task}, timeout=PATIENCE)
        is_late = not task.done()
        if is_late:
            broadcast(self._pages, _json({"type": "notice", "text": COMPILING, "busy": True}))
        await task
        if is_late:
            broadcast(self._pages, _json(DONE))

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
            _log.warning("%s: refused: %s", (connection.remote_address or ("a page",))[0], refused)
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
        visit = Visit(connection)
        self._pages.add(connection)
        long = asyncio.create_task(self._answer_long(visit))
        try:
            await self._answer_all(visit)
        except HostileError as error:
            _log.warning("%s: closed: %s", visit.address, error)
            await connection.close(1008, str(error).encode()[:100].decode(errors="ignore"))
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code not in (1000, 1001, 1005, 1011):
                _log.warning("%s: closed: %s", visit.address, error.sent.reason or error.sent.code)
        except Exception:
            await self._give_up(visit)
        finally:
            long.cancel()
            self._pages.discard(connection)
            if not self._pages:
                await self._do(self.session.pause)

    async def _give_up(self, visit: Visit) -> None:
        """End a page because of an error of the server, which is in the log."""
        _log.exception("%s: closed: an error of the server", visit.address)
        await visit.connection.close(1011)

    async def _answer_all(self, visit: Visit) -> None:
        """Read the messages of a page; answer all but the long ones."""
        async for text in visit.connection:
            message = visit.read(text)
            steps = isinstance(message, (m.Step, m.Seek)) and not self.session.is_compiled
            if steps or self.session.is_long(message):
                await visit.put(message)
                continue
            if not isinstance(message, m.Frame):
                await visit.calm()
            await self._reply(visit, message)

    async def _answer_long(self, visit: Visit) -> None:
        """Answer the long messages of a page one after the other; what effects cost is measured beside the rest."""
        measuring: asyncio.Task[None] | None = None
        try:
            while True:
                message = await visit.take()
                if not isinstance(message, m.Costs):
                    await self._reply_or_end(visit, message)
                    continue
                if measuring is not None:
                    await measuring
                measuring = asyncio.create_task(self._reply_or_end(visit, message))
        finally:
            if measuring is not None:
                measuring.cancel()
            visit.end()

    async def _reply_or_end(self, visit: Visit, message: m.Message) -> None:
        """Send the answers to a long message; an error of the server ends the page."""
        try:
            await self._reply(visit, message)
        except ConnectionClosed:
            pass  # the reader of its messages sees this too
        except Exception:
            await self._give_up(visit)

    async def _reply(self, visit: Visit, message: m.Message) -> None:
        """Send the answers to a message; a refusal is an answer too."""
        try:
            answers = await self._with_notice(visit, message)
        except (ValueError, TypeError, KeyError, IndexError, FloatingPointError, MemoryError) as error:
            answers = ({"type": "error", "text": _line(error), "about": message.type},)
        if visit.version != self.session.version:
            visit.version = self.session.version
            await visit.connection.send(_json(await self._do(self.session.describe)))
        for answer in answers:
            await visit.connection.send(answer if isinstance(answer, bytes) else _json(answer))

    async def _with_notice(self, visit: Visit, message: m.Message) -> Sequence[Answer]:
        """Return the answers to a message; if they take long, tell the page, also when they are there."""
        task = asyncio.ensure_future(self._answer(message))
        if isinstance(message, m.Frame):
            return await task
        await asyncio.wait({task}, timeout=PATIENCE)
        if task.done():
            return await task
        await visit.connection.send(_json({"type": "notice", "text": COMPILING, "busy": True}))
        return (DONE, *await task)

    async def _answer(self, message: m.Message) -> Sequence[Answer]:
        if isinstance(message, (m.Step, m.Seek)):
            await self._compile()
        if isinstance(message, m.Frame) and message.want.colour:
            return await self._coloured(message)
        if self.session.is_long(message):
            work = await self._aside(functools.partial(self.session.prepare, message), message)
        else:
            work = functools.partial(self.session.answer, message)
        answers = await self._do(work)
        if callable(answers):
            answers = await asyncio.get_running_loop().run_in_executor(self._measuring, answers)
        found: Sequence[Answer] = answers
        return found

    async def _coloured(self, message: m.Frame) -> Sequence[Answer]:
        """Return a frame with colours; without them while their kernel is being compiled, for which no page waits."""
        answer = functools.partial(self.session.answer, message)
        if self._colouring is None or self._colouring.done():
            try:
                coloured: Sequence[Answer] = await self._do(_from_cache, answer)
                return coloured
            except NotCachedError:
                self._colouring = asyncio.create_task(self._compile_colours(message))
        plain = message.model_copy(update={"want": message.want.model_copy(update={"colour": ""})})
        without: Sequence[Answer] = await self._do(self.session.answer, plain)
        return without

    async def _compile_colours(self, message: m.Frame) -> None:
        try:
            await self._announced(self._aside(functools.partial(self.session.prepare, message), message))
        except Exception as error:
            _log.warning("the colours of a frame were not compiled: %s", _line(error))


def _from_cache(work: Callable[[], Any]) -> Any:
    """Do some work that raises NotCachedError where it would compile."""
    with only_cached():
        return work()


def _json(data: object) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _line(error: BaseException) -> str:
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split())[:500] or type(error).__name__


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    """Return a response that no cache keeps, no other site frames and no browser guesses the type of."""
    headers = Headers({
        "Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close", "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
        "Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Resource-Policy": "same-origin",
        "Content-Security-Policy": policy("live") + "; frame-ancestors 'none'",
    })  # fmt: skip
    return Response(status.value, status.phrase, headers, body)
