"""`flockenv play`: the live playground in a browser."""

from __future__ import annotations

import asyncio
import errno
import logging
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flockenv.cli.options import TrustPickle
from flockenv.cli.targets import complete_target, is_scene
from flockenv.cli.terminal import Seed
from flockenv.core.bundled import bundled_scenes
from flockenv.core.errors import printable

if TYPE_CHECKING:
    from flockenv.play.session import Session

__all__ = ["play"]


def play(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENE|TASK", help="A scene or task of `flockenv list`, or a scene file (- for standard input).",
            show_default="a gallery of all", autocompletion=complete_target,
        ),
    ] = None,
    players: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE,...", help="Players of a task, a world for each, side by side; `you` is a person.",
            show_default="rules",
        ),
    ] = None,
    seed: Seed = 0,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0: any that is free.")] = 8712,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Address at which other machines reach the page, which then needs the token in the "
            "printed address.", show_default="this machine only",
        ),
    ] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address and open no browser.")] = False,
    trust_pickle: TrustPickle = False,
) -> None:  # fmt: skip
    """Play a scene or a task live in the browser: change its rules, agents and players while it runs."""
    names = tuple(players.split(",")) if players is not None else ()
    session = _session(tuple(name for name in names if Path(name).suffix), trust_pickle)
    _open(session, what, names, seed)
    try:
        asyncio.run(_serve(session, host, port, no_browser))
    except OSError as error:
        reason = error.strerror or error
        if host is not None and error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise ValueError(f"--host = {printable(host)}: {reason}; must be an address of this machine") from None
        raise ValueError(f"--port = {port}: {reason}; give another, 0 for any that is free") from None


def _session(files: tuple[str, ...], trust_pickle: bool) -> Session:
    """Return a session without a world; raise ValueError if the library of the socket is missing."""
    try:
        import websockets  # noqa: F401
    except ImportError:
        raise ValueError("play needs the package websockets: pip install 'flockenv[play]'") from None
    from flockenv.play.session import Session
    from flockenv.play.task_lane import PlayerFiles

    return Session(PlayerFiles(files, trust_pickle))


def _open(session: Session, what: str | None, players: tuple[str, ...], seed: int) -> None:
    """Open what the command line names; nothing for the gallery."""
    if what is None:
        if players:
            raise ValueError("--players: needs a task, such as `flockenv play pursuit --players rules,ppo`")
        return
    if is_scene(what):
        from flockenv.core.yaml_paths import title_of
        from flockenv.play.gallery import description_of
        from flockenv.scene.yaml_io import load_scene

        if players:
            raise ValueError(f"--players: a scene such as {what} has none; tasks have")
        file = Path(what) if Path(what).is_file() else bundled_scenes().get(what)
        about = description_of(file.read_text(encoding="utf-8")) if file is not None else ""
        session.open_scene(load_scene(Path(what)), title_of(what), seed, about)
        return
    from flockenv.players import trained_task

    session.open_task(trained_task(what), players or ("rules",), seed)


async def _serve(session: Session, host: str | None, port: int, no_browser: bool) -> None:
    from flockenv.play.server import PlayServer

    log = logging.getLogger("flockenv.play")
    log.addHandler(logging.StreamHandler(sys.stderr))
    server = PlayServer(session, host, port)

    def started() -> None:
        print(f"{server.url}  (Ctrl-C ends it)", flush=True)
        if not no_browser:
            webbrowser.open(server.url)

    await server.run(started)
