"""A playground for tests: a server in a thread of its own, and a browser."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from flockenv.play.server import PlayServer
from flockenv.play.session import Session

__all__ = ["browsing", "serving"]

ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
"""Options of Chromium: it may run as root, and asks nothing of the network by itself."""

PATIENCE = 120_000
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
