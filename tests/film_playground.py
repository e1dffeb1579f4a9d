"""Make the moving pictures of docs/play.md: python -m tests.film_playground [NAME ...]

A script clicks and drags in the page, makes the steps of the world one by one with a key, and takes a picture after
each; so the films do not depend on how fast the machine is. It needs what tests/test_browser.py needs.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from flockenv.play.gallery import description_of, text_of
from flockenv.play.room import Room
from flockenv.play.session import Session
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS
from tests.playground import Visit, browsing, serving, wait_for

OUT = Path(__file__).resolve().parent.parent / "docs" / "play"

WIDTH, HEIGHT, SHOWN = 1280, 720, 640
"""Size of the page, and the width of a film, pixels."""

SMALL = 480
"""Width of a film in which almost everything moves, pixels."""

DURATION = 80
"""Time of a picture, ms."""

QUALITY = 20
"""Of WebP, 0 to 100."""

POINTER = ((0, 0), (0, 17), (4, 13), (7, 19), (10, 18), (7, 12), (12, 12))


class Film:
    """Pictures of a page with its pointer."""

    def __init__(self, here: Visit, room: Room, shown: int) -> None:
        self.here, self.room, self.pictures, self.shown = here, room, list[Image.Image](), shown
        self.at = (WIDTH * 0.4, HEIGHT * 0.9)

    def take(self, count: int = 1) -> None:
        """Take a picture, and show it for a while."""
        self.here.until("!state.dirty && !live.waiting")
        picture = Image.open(io.BytesIO(self.here.page.screenshot())).convert("RGB")
        shape = [(self.at[0] + x, self.at[1] + y) for x, y in POINTER]
        ImageDraw.Draw(picture).polygon(shape, "#1d2633", "#ffffff", 1)
        self.pictures += [picture.resize((self.shown, self.shown * HEIGHT // WIDTH), Image.Resampling.LANCZOS)] * count

    def step(self, pictures: int, steps: int = 1) -> None:
        """Let the world make some steps before each picture."""
        for _ in range(pictures):
            end = self.room.tick + steps
            for _ in range(steps):
                self.here.page.keyboard.press("ArrowRight")
            wait_for(lambda end=end: self.room.tick == end or self.room.ended)  # type: ignore[misc]
            self.here.until(f"live.header.tick >= {end} || live.header.lanes.every(lane => lane.stopped)")
            self.take()

    def move(self, to: tuple[float, float], pictures: int = 4) -> None:
        """Move the pointer, slowly; a button that is down drags."""
        start = self.at
        for k in range(1, pictures + 1):
            self.at = tuple(a + (b - a) * k / pictures for a, b in zip(start, to, strict=True))  # type: ignore[assignment]
            self.here.page.mouse.move(*self.at)
            self.take()

    def click(self, to: tuple[float, float]) -> None:
        self.move(to)
        self.here.page.mouse.down()
        self.here.page.mouse.up()

    def drag(self, start: tuple[float, float], to: tuple[float, float], pictures: int = 5) -> None:
        self.move(start)
        self.here.page.mouse.down()
        self.move(to, pictures)
        self.here.page.mouse.up()

    def middle(self, selector: str) -> tuple[float, float]:
        box = self.here.page.locator(selector).first.bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def save(self, path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        first, *others = self.pictures
        first.save(path, append_images=others, duration=DURATION, loop=0, quality=QUALITY, method=6, minimize_size=True)
        print(f"{path}: {len(self.pictures)} pictures, {path.stat().st_size:,} bytes", flush=True)


def rules(film: Film) -> None:
    """Birds stop aligning, then do it again; one of them is clicked."""
    film.step(6, 2)
    value = film.middle(".value[data-path='effects[1].weight']")
    film.drag(value, (value[0] - 90, value[1]))
    film.here.page.locator("h1").click()
    film.step(7, 8)
    value = film.middle(".value[data-path='effects[1].weight']")
    film.drag(value, (value[0] + 60, value[1]))
    film.here.page.locator("h1").click()
    film.step(7, 8)
    film.click(film.here.pixel(7))
    film.here.until("chosen.look !== null && chosen.look.forces !== undefined")
    film.step(6, 1)


def players(film: Film) -> None:
    """Rules, a policy and a person chase in the same world."""
    film.step(4)
    box = film.here.page.locator("canvas.world").nth(2).bounding_box()
    film.move((box["x"] + box["width"] * 0.3, box["y"] + box["height"] * 0.7))
    film.here.page.mouse.down()
    for _ in range(30):
        film.at = film.here.pixel(1, 2)
        film.here.page.mouse.move(*film.at)
        film.step(1)
    film.here.page.mouse.up()
    film.take(10)


def space(film: Film) -> None:
    """A bird in space is clicked, and the world is turned while the forces on it are shown."""
    pos = film.room.lanes[0].drawn.pos
    middle = np.abs(pos - pos.mean(axis=1, keepdims=True)).max(axis=0).argmin()
    film.click(film.here.pixel(int(middle)))
    film.here.until("chosen.look !== null && chosen.look.forces !== undefined")
    film.step(3, 2)
    box = film.here.page.locator("canvas.world").bounding_box()
    film.drag((box["x"] + 20, box["y"] + 40), (box["x"] + 190, box["y"] + 190), 7)
    film.step(7, 2)


FILMS: dict[str, tuple[str, tuple[str, ...], int, Callable[[Film], None]]] = {
    "rules": ("boids", (), 160, rules),
    "players": ("pursuit", ("rules", "ppo", "you"), 0, players),
    "space": ("boids3d", (), 200, space),
}
"""Films by name: what is open, with which players, at which step the film begins, and what happens in it."""


def make(browser: Any, name: str) -> None:
    """Make one film."""
    what, names, start, act = FILMS[name]
    session = Session()
    if names:
        session.open_task(TASKS[what](), names)
    else:
        session.open_scene(load_scene(text_of(what)), what, about=description_of(text_of(what)))
    session.pause()
    assert session.room is not None
    session.room.step(start)
    with serving(session) as server:
        here = Visit(browser, server.url, WIDTH)
        here.page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
        here.until(f"live.room !== null && live.header.tick === {start} && views.every(v => v.eye)")
        film = Film(here, session.room, SMALL if name == "space" else SHOWN)
        act(film)
        film.save(OUT / f"{name}.webp")
        here.close()


if __name__ == "__main__":
    with browsing() as chromium:
        for each in sys.argv[1:] or FILMS:
            make(chromium, each)
