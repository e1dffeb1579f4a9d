"""A playground for tests: a server in a thread of its own, a browser, and what a visitor does in a page."""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from flockenv.play.server import PlayServer
from flockenv.play.session import Session

__all__ = ["Visit", "browsing", "digests_of", "serving", "wait_for"]

ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
"""Options of Chromium: it may run as root, and asks nothing of the network by itself."""

PATIENCE = 300_000
"""ms until a browser that does not answer fails a test, on a busy machine too."""


@contextmanager
def serving(session: Session, host: str | None = None) -> Iterator[PlayServer]:
    """Run a server in a thread with a loop of its own, at a free port."""
    server, started, loop = PlayServer(session, host, 0), threading.Event(), asyncio.new_event_loop()
    task = loop.create_task(server.run(started.set))

    def run() -> None:
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(task)
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert started.wait(60)
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(60)
        assert not thread.is_alive()


def digests_of(server: PlayServer) -> tuple[str, ...]:
    """Return the digests of a server's worlds in its own thread: a look moves a world ahead for a moment."""

    def digests() -> tuple[str, ...]:
        assert server.session.room is not None
        return server.session.room.digests

    return server._work.submit(digests).result(60)


@contextmanager
def browsing() -> Iterator[Any]:
    """Yield Chromium without a window; skip the test, with one line, if it or playwright is missing."""
    reason = "needs Chromium and playwright: apt-get install chromium; pip install 'flockenv[browser]'"
    sync_api = pytest.importorskip("playwright.sync_api", reason=reason)
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip(reason)
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=list(ARGUMENTS), timeout=PATIENCE)
        try:
            yield browser
        finally:
            browser.close()


def wait_for(test: Callable[[], bool]) -> None:
    """Return when something is true; fail after some minutes: a new kind of world compiles."""
    end = time.monotonic() + PATIENCE / 1000
    while not test():
        assert time.monotonic() < end
        time.sleep(0.02)


class Visit:
    """A page in a browser of its own, and what went wrong in it."""

    def __init__(self, chromium: Any, url: str, width: int = 1280, **options: Any) -> None:
        self.context = chromium.new_context(viewport={"width": width, "height": 800}, **options)
        self.page, self.problems, self.requests = self.context.new_page(), list[str](), list[str]()
        self.page.set_default_timeout(PATIENCE)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda line: self.problems.append(line.text) if line.type == "error" else None)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(url)

    def value(self, script: str) -> Any:
        return self.page.evaluate(script)

    def until(self, script: str) -> None:
        """Wait until an expression is true; the page's policy forbids what playwright waits with."""
        wait_for(lambda: bool(self.value(f"Boolean({script})")))

    def pixel(self, agent: int, view: int = 0) -> tuple[float, float]:
        """Return where an agent is in the window, in CSS pixels."""
        place = f"v = views[{view}], p = placeOf(v.panel.bodies, {agent}), box = v.canvas.getBoundingClientRect()"
        across = "box.left + v.eye.x(...p) / v.canvas.width * box.width"
        down = "box.top + v.eye.y(...p) / v.canvas.height * box.height"
        x, y = self.value(f"(() => {{ const {place}; return [{across}, {down}]; }})()")
        return x, y

    def drag(self, start: tuple[float, float], by: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for k in (1, 2, 3, 4):
            mouse.move(start[0] + by[0] * k / 4, start[1] + by[1] * k / 4)
        mouse.up()

    def close(self) -> None:
        self.context.close()
