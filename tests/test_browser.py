"""The pages in a browser: a script clicks, drags and types, and the worlds on the server are compared.

It needs Chromium and playwright: `apt-get install chromium` and `pip install 'flockenv[browser]'`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("websockets", reason="needs the extra `play`: pip install 'flockenv[play]'")
from flockenv.play.room import Room
from flockenv.play.session import Session
from flockenv.render import Group, Panel, write_replay
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS
from tests.playground import PATIENCE, browsing, serving
from tests.test_render import run

pytestmark = pytest.mark.slow  # starting a browser takes seconds

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browsing() as browser:
        yield browser


class Visit:
    """A page in a browser of its own, and what went wrong in it."""

    def __init__(self, chromium: Any, url: str, width: int = 1280) -> None:
        self.context = chromium.new_context(viewport={"width": width, "height": 800})
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


@pytest.fixture
def visit(chromium: Any) -> Iterator[Callable[..., Visit]]:
    made: list[Visit] = []

    def open_page(url: str, width: int = 1280) -> Visit:
        made.append(Visit(chromium, url, width))
        return made[-1]

    yield open_page
    for each in made:
        each.close()
        assert each.problems == []


def wait_for(test: Callable[[], bool]) -> None:
    """Return when something is true; fail after two minutes."""
    end = time.monotonic() + PATIENCE / 1000
    while not test():
        assert time.monotonic() < end
        time.sleep(0.02)


def room_of(session: Session) -> Room:
    assert session.room is not None
    return session.room


@pytest.mark.parametrize("width", [1280, 400])
def test_a_replay_plays_and_stops(tmp_path: Path, visit: Callable[..., Visit], width: int) -> None:
    panels = [Panel(name, run(40), np.linspace(0, 1, 40), "captured at 3.9 s") for name in ("rules", "ppo")]
    write_replay(tmp_path / "r.html", [Group("one", panels)], "two players")
    here = visit((tmp_path / "r.html").as_uri() + "#t=1&play", width)
    here.until("state.time > 1.05")
    here.page.keyboard.press(" ")
    still = here.value("state.time")
    assert here.value("state.playing") is False and here.value("drawn.count") > 1
    here.page.keyboard.press("ArrowRight")
    assert here.value("state.time") > still
    here.page.keyboard.press("End")
    assert here.value("document.querySelector('.outcome').textContent") == "captured at 3.9 s"
    colours = "new Set(new Uint32Array(views[0].canvas.getContext('2d').getImageData(0, 0, 200, 200).data.buffer)).size"
    assert here.value(colours) > 3
    assert here.value("document.documentElement.scrollWidth <= innerWidth")
    assert len(here.requests) == 1


def test_a_recorded_world_in_three_dimensions_turns(tmp_path: Path, visit: Callable[..., Visit]) -> None:
    write_replay(tmp_path / "r.html", [Group("one", [Panel("", run(5, dimension=3), None, "")])], "cube")
    here = visit((tmp_path / "r.html").as_uri() + "#t=0.1")
    here.until("drawn.count > 0")
    flat = here.value("views[0].eye.flat")
    box = here.page.locator("canvas.world").bounding_box()
    here.drag((box["x"] + 60, box["y"] + 60), (80, -120))
    here.until("!views[0].eye.flat")
    assert flat and here.value("views[0].camera.yaw") > 0 and here.value("views[0].camera.tilt") > 0
    here.page.mouse.dblclick(box["x"] + 60, box["y"] + 60)
    here.until("views[0].eye.flat")


def shown_boids() -> Session:
    session = Session()
    session.open_scene(load_scene(ROOT / "configs" / "scenes" / "boids.yaml"), "boids")
    return session


def test_a_world_is_changed_saved_and_stepped_back(visit: Callable[..., Visit]) -> None:
    """A dragged value is in the saved record, which gives the same bits; so does going back and on."""
    session = shown_boids()
    room = room_of(session)
    with serving(session) as server:
        here = visit(server.url)
        here.until("live.room !== null && state.group.panels[0].frames.length > 1")
        here.page.keyboard.press(" ")
        wait_for(lambda: not room.playing)
        here.page.keyboard.press("Home")
        wait_for(lambda: room.tick == 0)
        before = room.lanes[0].record.effects[0].weight
        value = here.page.locator(".value[data-path='effects[0].weight']").first.bounding_box()
        here.drag((value["x"] + 5, value["y"] + 8), (60, 0))
        wait_for(lambda: room.lanes[0].record.effects[0].weight > before)
        step_on(here, room, 3)
        here.page.locator("#save").click()
        saved = load_scene(here.page.locator("dialog textarea").input_value() + "\n")
        here.page.keyboard.press("Escape")
        assert saved.effects[0].weight == room.lanes[0].record.effects[0].weight
        state = saved.start(0)
        for _ in range(3):
            state = saved.step(state)
        assert state.digest == room.digests[0]

        here.drag(here.pixel(7), (60, 40))
        wait_for(lambda: any(made.edit.kind == "move_agent" for made in room.made))
        here.page.keyboard.press("o")
        box = here.page.locator("canvas.world").bounding_box()
        here.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (30, 0))
        wait_for(lambda: len(room.lanes[0].record.obstacles) == 1)
        step_on(here, room, 3)
        digests = room.digests
        for _ in range(5):
            here.page.keyboard.press("ArrowLeft")
        wait_for(lambda: room.tick == 1)
        step_on(here, room, 5)
        assert room.digests == digests


def step_on(here: Visit, room: Room, steps: int) -> None:
    """Press the key of a single step some times, and wait for the world."""
    end = room.tick + steps
    for _ in range(steps):
        here.page.keyboard.press("ArrowRight")
    wait_for(lambda: room.tick == end)


def test_a_person_steers_beside_rules(visit: Callable[..., Visit]) -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules", "you"))
    room = room_of(session)
    with serving(session) as server:
        here = visit(server.url)
        here.until("live.room !== null && state.group.panels[1].frames.length > 1")
        assert here.value("views.map(v => v.panel.player)") == ["rules", "you"]
        here.page.keyboard.down("d")
        lane: Any = room.lanes[1]
        wait_for(lambda: float(lane.actions[0, 0]) == 1.0)
        here.page.keyboard.up("d")
        wait_for(lambda: float(lane.actions[0, 0]) == 0.0 or bool(lane.stopped))
        here.page.keyboard.press("n")
        here.until("chosen.look !== null && chosen.look.forces !== undefined")


def test_only_the_own_server_is_asked(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    with serving(session) as server:
        here = visit(server.url, 400)
        here.until("live.room !== null && state.group.panels[0].frames.length > 1")
        assert all(url.startswith(f"http://127.0.0.1:{server.port}/") for url in here.requests if "favicon" not in url)
        assert here.value("document.documentElement.scrollWidth <= innerWidth")


def test_a_hostile_title_is_text(visit: Callable[..., Visit]) -> None:
    session = Session()
    name = "<img src=x onerror=alert(1)></script>"
    session.open_scene(load_scene(ROOT / "configs" / "scenes" / "boids.yaml"), name)
    session.pause()
    with serving(session) as server:
        here = visit(server.url)
        here.until("live.room !== null")
        assert here.value("document.querySelector('h1').textContent") == name
        assert here.value("document.querySelectorAll('h1 *').length") == 0
