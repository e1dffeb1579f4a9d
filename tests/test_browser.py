"""The pages in a browser: a script clicks, drags and types, and the worlds on the server are compared.

It needs Chromium and playwright: `apt-get install chromium` and `pip install 'flockenv[browser]'`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("websockets", reason="needs the extra `play`: pip install 'flockenv[play]'")
from flockenv.envs.world import World
from flockenv.model.state import digest_arrays
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.server import PlayServer
from flockenv.play.session import Session
from flockenv.play.task_lane import TaskLane
from flockenv.players import load_player
from flockenv.render import Group, Panel, write_replay
from flockenv.scene.yaml_io import load, load_scene
from flockenv.studies.trajectory import record
from flockenv.tasks import TASKS
from tests.playground import Visit, browsing, digests_of, serving, wait_for
from tests.test_render import run

pytestmark = pytest.mark.slow  # starting a browser takes seconds

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browsing() as browser:
        yield browser


@pytest.fixture
def visit(chromium: Any) -> Iterator[Callable[..., Visit]]:
    made: list[Visit] = []

    def open_page(url: str, width: int = 1280, **options: Any) -> Visit:
        made.append(Visit(chromium, url, width, **options))
        return made[-1]

    yield open_page
    for each in made:
        each.close()
        assert each.problems == []


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
    here.until("document.querySelector('.outcome').textContent === 'captured at 3.9 s'")  # once it is drawn
    colours = "new Set(new Uint32Array(views[0].canvas.getContext('2d').getImageData(0, 0, 200, 200).data.buffer)).size"
    assert here.value(colours) > 3
    assert here.value("document.documentElement.scrollWidth <= innerWidth")
    assert len(here.requests) == 1


def test_a_recorded_world_in_three_dimensions_turns(tmp_path: Path, visit: Callable[..., Visit]) -> None:
    shots = [replace(shot, faces=[(0, 1, 2)]) for shot in run(5, dimension=3)]
    write_replay(tmp_path / "r.html", [Group("one", [Panel("", shots, None, "")])], "cube")
    here = visit((tmp_path / "r.html").as_uri() + "#t=0.1")
    here.until("drawn.count > 0")
    flat = here.value("views[0].eye.flat")
    assert here.value("facesInOrder(views[0].panel, views[0].eye, views[0].panel.bodies, new Set()).length") == 1
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
        assert (state.digest,) == digests_of(server)

        here.drag(here.pixel(7), (60, 40))
        wait_for(lambda: any(made.edit.kind == "move_agent" for made in room.made))
        here.page.keyboard.press("o")
        box = here.page.locator("canvas.world").bounding_box()
        here.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (30, 0))
        wait_for(lambda: len(room.lanes[0].record.obstacles) == 1)
        step_on(here, room, 3)
        digests = digests_of(server)
        for _ in range(5):
            here.page.keyboard.press("ArrowLeft")
        wait_for(lambda: room.tick == 1)
        step_on(here, room, 5)
        assert digests_of(server) == digests


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
        assert "drive" in here.value("chosen.look.forces.map(force => force.kind)")


def opened(here: Visit, session: Session) -> Room:
    """Wait for the open world in a page, and stop time."""
    room = room_of(session)
    here.until("live.room !== null && state.group.panels[0].frames.length > 0 && views[0].eye")
    if room.playing:
        press_play(here, room, on=False)
    return room


def test_keys_alone_move_an_agent_and_draw_an_obstacle(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    with serving(session) as server:
        here = visit(server.url)
        room, keys = opened(here, session), here.page.keyboard
        keys.press("n")
        before = room.lanes[0].drawn.pos[:, 0].copy()
        for key in ("c", "Enter", "ArrowRight", "ArrowRight", "Enter"):
            keys.press(key)
        wait_for(lambda: bool(moves_of(room)))
        wait_for(lambda: room.lanes[0].drawn.pos[0, 0] > before[0] + 1.0)
        for key in ("o", "Enter", "ArrowDown", "ArrowDown", "Enter", "Escape"):
            keys.press(key)
        wait_for(lambda: len(room.lanes[0].record.obstacles) == 1)
        step_on(here, room, 1)  # the arrows are those of time again


def test_two_fingers_zoom_and_leave_the_agents_alone(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    with serving(session) as server:
        here = visit(server.url, 400, has_touch=True)
        room = opened(here, session)
        touch = here.context.new_cdp_session(here.page)
        x, y = here.pixel(here.value("views[0].panel.bodies.there.indexOf(1)"))

        def send(kind: str, *points: tuple[float, float]) -> None:
            fingers = [{"x": a, "y": b, "id": k} for k, (a, b) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

        send("touchStart", (x, y))
        send("touchStart", (x, y), (x + 40, y))
        send("touchMove", (x - 10, y), (x + 50, y))
        send("touchMove", (x - 30, y), (x + 70, y))
        send("touchEnd")
        here.until("views[0].camera.zoom > 1.5")
        assert room.made == () and here.value("chosen.agent") is None


def test_a_finger_scrolls_worlds_that_are_not_all_in_sight(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    room = session.room
    assert room is not None
    scene = room.lanes[0].record
    session._set_room(Room([SceneLane(scene), SceneLane(scene), SceneLane(scene)]), "boids", "", False)
    with serving(session) as server:
        here = visit(server.url, 400, has_touch=True)
        here.until("views.length === 3 && views.every(v => v.panel.frames.length)")
        touch = here.context.new_cdp_session(here.page)
        box, camera = here.value("views[0].canvas.getBoundingClientRect()"), here.value("views[0].camera")
        x, y = box["x"] + 8, box["y"] + box["height"] - 8

        def send(kind: str, *points: tuple[float, float]) -> None:
            fingers = [{"x": a, "y": b, "id": k} for k, (a, b) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

        send("touchStart", (x, y))
        for k in range(1, 5):
            send("touchMove", (x, y - 30 * k))
        send("touchEnd")
        here.until("document.querySelector('.stage').scrollTop > 90")
        assert here.value("document.querySelector('.stage').scrollTop") <= 125
        assert here.value("views[0].camera") == camera


def test_a_world_waits_for_readers_who_want_less_motion(visit: Callable[..., Visit]) -> None:
    session = Session()
    with serving(session) as server:
        here = visit(server.url, reduced_motion="reduce")
        here.page.locator(".card[data-name='boids']").click()
        here.until("live.room !== null && !state.playing")
        wait_for(lambda: session.room is not None and not session.room.playing)
        tick, frames = room_of(session).tick, here.value("live.lastFrame")
        here.until(f"live.lastFrame > {frames} + 300")
        assert room_of(session).tick == tick


def test_a_recording_is_downloaded_as_a_gif(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    with serving(session) as server:
        here = visit(server.url)
        room = opened(here, session)
        here.page.locator("#save").click()
        here.page.locator("dialog button", has_text="GIF").click()
        here.until("live.recording === 'gif'")
        play_until(here, room, room.tick + 3)
        with here.page.expect_download() as download:
            here.page.locator("#save").click()
        assert download.value.suggested_filename == "boids.gif"
        assert Path(download.value.path()).read_bytes().startswith(b"GIF89a")


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


# --- what a visitor does, in worlds of each kind -------------------------------------------------------------------


class Visited(NamedTuple):
    """A world of the gallery, the value that is changed in it, and what is said when an obstacle is drawn.

    obstacles: how many more there are then, 0 if that is refused. share: what a value of a task is multiplied by.
    """

    name: str
    path: str
    said: str = ""
    obstacles: int = 1
    share: float = 0.9


IDLE = "no effect of this scene reacts to obstacles"
SCENES = (
    Visited("boids", "effects[0].weight", IDLE),
    Visited("fireworks", "effects[1].rate", IDLE),
    Visited("cloth", "effects[2].rate", IDLE),
    Visited("billiards", "constraints[0].restitution"),
)
TASK_VISITS = (
    Visited("pursuit", "evader_speed", "pursuit has no obstacles", 0),
    Visited("flock", "sight", "all 6 obstacles are there", 0),
    Visited("obstacles", "max_speed", share=0.02),  # so slow that it touches none, which would end the episode
)
BACK = 100
"""Steps that time goes back."""


@pytest.mark.parametrize("world", [*SCENES, *TASK_VISITS], ids=lambda world: world.name)
def test_a_world_keeps_its_bits_through_all_that_a_visitor_does(world: Visited, visit: Callable[..., Visit]) -> None:
    """Going back and on, a link in another browser and server, and the saved YAML give the same bits as the world."""
    session, elsewhere = Session(), Session()
    with serving(session) as server, serving(elsewhere) as second:
        here = visit(server.url)
        room = open_from_gallery(here, session, world.name)
        begin_again(here, room)  # how long it has played depends on the machine
        change_value(here, room, world)
        drag_an_agent(here, room)
        draw_an_obstacle(here, room, world)
        if world.name in TASKS:
            switch_players(here, room)
        play_until(here, room, BACK + 10)
        tick, digests = room.tick, digests_of(server)
        go_back_and_on(here, room)
        assert (room.tick, digests_of(server)) == (tick, digests)
        here.page.locator("#share").click()
        here.until("location.hash.startsWith('#w=')")
        there = visit(second.url + here.value("location.hash"))
        there.until(f"live.header.tick === {tick}")
        assert digests_of(second) == digests
        restart_and_run(here, server, room, world.name)


def open_from_gallery(here: Visit, session: Session, name: str) -> Room:
    """Click a picture of the gallery, and stop time."""
    here.page.locator(f".card[data-name='{name}']").click()
    wait_for(lambda: session.name == name)
    return opened(here, session)


def begin_again(here: Visit, room: Room) -> None:
    here.page.locator("#again").click()
    wait_for(lambda: room.tick == 0 and not room.made)
    here.until("live.header.tick === 0")


def press_play(here: Visit, room: Room, on: bool) -> None:
    here.until(f"state.playing === {str(not on).lower()}")
    here.page.locator("#play").click()
    wait_for(lambda: room.playing == on or room.ended)
    assert not room.ended, room.lanes[0].stopped
    here.until("state.playing" if on else f"!state.playing && live.header.tick === {room.tick}")


def play_until(here: Visit, room: Room, tick: int) -> None:
    """Let time pass until a tick; the world stops at it or after it."""
    press_play(here, room, on=True)
    wait_for(lambda: room.tick >= tick or room.ended)
    if not room.ended:
        press_play(here, room, on=False)
    assert room.tick >= tick


def change_value(here: Visit, room: Room, world: Visited) -> None:
    """Drag a value of a sentence, or give one of a task another number under Values."""
    before = room.lanes[0].record
    if world.name not in TASKS:
        value = here.page.locator(f"#rules .value[data-path='{world.path}']")
        value.scroll_into_view_if_needed()
        box = value.bounding_box()
        here.drag((box["x"] + 5, box["y"] + box["height"] / 2), (40, 0))
    else:
        here.page.locator("#tab-values").click()
        field = here.page.locator(f"#values input[type=number][data-path='{world.path}']")
        field.fill(str(world.share * getattr(before, world.path)))
        field.press("Enter")
    wait_for(lambda: room.lanes[0].record != before)
    here.page.locator("h1").click()  # the keys belong to the world again


def drag_an_agent(here: Visit, room: Room) -> None:
    """Drag a living agent, and find it where the page says that it was put."""
    while not room.lanes[0].drawn.alive.any():  # stopped before the first was born
        play_until(here, room, room.tick + 10)
    here.until("views[0].panel.bodies && views[0].panel.bodies.there.includes(1)")
    living = here.value("views[0].panel.bodies.there.indexOf(1)")
    before = room.lanes[0].drawn.pos.copy()
    here.drag(here.pixel(living), (36, 24))
    wait_for(lambda: bool(moves_of(room)))
    moved: Any = room.lanes[0]
    space = getattr(moved.record, "scene", moved.record).space

    def is_there() -> bool:
        edit = moves_of(room)[-1]
        return bool(np.allclose(moved.drawn.pos[:, edit.agent], space.wrap(edit.pos)))

    wait_for(is_there)
    assert not np.allclose(moved.drawn.pos, before)


def moves_of(room: Room) -> list[Any]:
    return [made.edit for made in room.made if made.edit.kind == "move_agent"]


def draw_an_obstacle(here: Visit, room: Room, world: Visited) -> None:
    """Draw a circle with its tool; it is there, or one line says why not."""
    shown = "document.getElementById('toast').textContent"
    count = obstacles_in(room)
    here.page.keyboard.press("o")
    box = here.page.locator("canvas.world").bounding_box()
    here.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 4), (26, 0))
    if world.said:
        here.until(f"{shown}.includes('{world.said}')")
    wait_for(lambda: obstacles_in(room) == count + world.obstacles)
    here.page.keyboard.press("v")


def obstacles_in(room: Room) -> int:
    lane: Any = room.lanes[0]
    if isinstance(lane, TaskLane):
        return int((lane.world.state.obstacle_radius[0] > 0).sum())
    return len(lane.record.obstacles)


def switch_players(here: Visit, room: Room) -> None:
    """Let the policy steer one learner, then a person all; hold a key for a while."""
    lane: Any = room.lanes[0]
    here.page.mouse.click(*here.pixel(0))
    here.page.locator("#agent select[aria-label=player]").select_option("ppo")
    wait_for(lambda: lane.players[0] == "ppo")
    play_until(here, room, room.tick + 10)
    here.page.locator("#tab-rules").click()
    here.page.locator("#rules select[aria-label=player]").select_option("you")
    wait_for(lambda: set(lane.players) == {"you"})
    here.page.locator("h1").click()
    press_play(here, room, on=True)
    here.page.keyboard.down("d")
    wait_for(lambda: float(np.abs(lane.actions).max()) > 0.5)
    here.page.keyboard.up("d")
    wait_for(lambda: not lane.actions.any())
    press_play(here, room, on=False)


def go_back_and_on(here: Visit, room: Room) -> None:
    tick = room.tick
    here.page.keyboard.press("ArrowLeft")
    for _ in range(BACK // 10):
        here.page.keyboard.press("PageUp")
    here.page.keyboard.press("ArrowRight")
    wait_for(lambda: room.tick == tick - BACK)
    step_on(here, room, BACK)


def restart_and_run(here: Visit, server: PlayServer, room: Room, name: str, steps: int = 25) -> None:
    """Begin again, save the record, and run it without the playground: as many steps give the same digest."""
    if name in TASKS:
        here.page.locator("#tab-rules").click()
        here.page.locator("#rules select[aria-label=player]").select_option("rules")
        lane: Any = room.lanes[0]
        wait_for(lambda: set(lane.players) == {"rules"})
        here.page.locator("h1").click()
    begin_again(here, room)
    step_on(here, room, steps)
    here.page.locator("#save").click()
    text = here.page.locator("dialog textarea").input_value() + "\n"
    here.page.keyboard.press("Escape")
    seed = room.lanes[0].seed
    if name in TASKS:
        digest = played_by_rules(load(text, TASKS[name]), seed, steps)
    else:
        digest = record(load_scene(text), seed, steps, steps).last.digest
    assert (digest,) == digests_of(server)


def played_by_rules(task: Any, seed: int, steps: int) -> str:
    """Return the digest of a task's world after some decisions of the rules."""
    world, player = World(task, 1, task.horizon), load_player("rules", task, seed)
    if hasattr(player, "watch"):
        player.watch(world)
    observation, state = world.reset(seed), None
    for k in range(steps):
        begins = np.full(task.learners, k == 0)
        actions, state = player.predict(observation[0], state, begins, deterministic=True)
        observation = world.step(np.asarray(actions, np.float32)[None]).observation
    return digest_arrays({name: array for name, array in world.arrays().items() if name != "state.work"})
