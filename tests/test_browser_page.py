"""The live page in a browser: what is refused, what a keyboard and a screen reader reach, and a lost connection."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("websockets", reason="needs the extra `play`: pip install 'flockenv[play]'")
from flockenv.model.appearance import Appearance
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Springs
from flockenv.play.session import Session
from flockenv.render.camera import rows_of
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS
from tests.playground import Visit, serving, wait_for
from tests.test_browser import chromium, room_of, shown_boids, visit

__all__ = ["chromium", "visit"]

pytestmark = pytest.mark.slow  # starting a browser takes seconds

TOAST = "document.getElementById('toast').textContent"


@pytest.fixture(scope="module")
def boids() -> Session:
    session = shown_boids()
    room_of(session).play(False)
    return session


def opened(visit: Callable[..., Visit], url: str, width: int = 1280, **options: Any) -> Visit:
    here = visit(url, width, **options)
    here.until("live.room !== null && state.group.panels[0].frames.length > 0")
    return here


@pytest.mark.parametrize(
    ("path", "text", "refusal"),
    [
        ("effects[0].weight", "abc", "weight = abc: must be a number"),
        ("effects[0].weight", "1,5", "weight = 1,5: must be a number"),
        ("effects[0].weight", "12 apples", "weight = 12 apples: must be a number"),
        ("effects[0].weight", "", "weight = nothing: must be a number"),
        ("groups[0].count", "2.5", "groups[0].count = 2.5: must be an integer"),
    ],
)
def test_what_is_no_number_is_refused_in_one_line(
    boids: Session, visit: Callable[..., Visit], path: str, text: str, refusal: str
) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        before = room_of(boids).lanes[0].record
        here.page.locator(f".value[data-path='{path}']").first.click()
        here.page.keyboard.press("Control+a")
        here.page.keyboard.type(text) if text else here.page.keyboard.press("Delete")
        here.page.keyboard.press("Enter")
        here.until(f"{TOAST}.includes({refusal!r})")
        assert room_of(boids).lanes[0].record == before


def test_a_number_may_be_typed_with_its_unit(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.locator(".value[data-path='effects[0].radius']").first.click()
        here.page.keyboard.press("Control+a")
        here.page.keyboard.type("3.5 m")
        here.page.keyboard.press("Enter")
        wait_for(lambda: room_of(boids).lanes[0].record.effects[0].radius == 3.5)
        here.until("document.querySelector(\".value[data-path='effects[0].radius']\") !== null")  # it is no field now
        assert here.page.locator(".value[data-path='effects[0].radius']").first.inner_text().split() == ["3.5", "m"]


def test_a_world_is_saved_and_linked_more_than_once(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        links = []
        for _ in range(2):
            here.page.keyboard.press("s")
            here.page.locator("dialog textarea").wait_for()
            text = here.page.locator("dialog textarea").input_value()
            assert load_scene(text + "\n") == room_of(boids).lanes[0].record
            here.page.keyboard.press("Escape")
            here.value("history.replaceState(null, '', '/')")
            here.page.locator("#share").click()
            here.until("location.hash.startsWith('#w=')")
            links.append(here.value("location.hash"))
        assert links[0] == links[1]


@pytest.mark.parametrize("seed", ["-1", "1e30", ""])
def test_a_seed_that_is_none_is_refused_and_the_page_stays(
    boids: Session, visit: Callable[..., Visit], seed: str
) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.locator("#seed").fill(seed)
        here.page.locator("#seed").press("Enter")
        here.until(f"{TOAST}.includes('must be an integer from 0 to 9007199254740991')")
        assert here.page.locator("#seed").input_value() == "0"
        here.page.keyboard.press("s")
        here.page.locator("h1").click()
        here.page.keyboard.press("s")
        here.page.locator("dialog textarea").wait_for()  # the server still answers


@pytest.mark.parametrize(
    ("text", "refusal"),
    [("'# no scene'.repeat(6001)", "load: 60010 characters"), ("'#\\n'.repeat(29000)", "load: 87025 bytes")],
)
def test_a_text_that_is_too_long_is_refused_and_the_page_stays(
    boids: Session, visit: Callable[..., Visit], text: str, refusal: str
) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.locator("#save").click()
        here.page.locator("dialog textarea").wait_for()
        here.value(f"document.querySelector('dialog textarea').value = {text}")
        here.page.locator("dialog button", has_text="Load this text").click()
        here.until(f"document.getElementById('saved').textContent.includes({refusal!r})")
        here.page.keyboard.press("Escape")
        here.page.locator("#save").click()
        here.until("document.querySelector('dialog textarea').value.includes('groups')")
        assert load_scene(here.page.locator("dialog textarea").input_value() + "\n") == room_of(boids).lanes[0].record


def test_a_text_with_an_error_stays_to_be_mended(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.locator("#save").click()
        area = here.page.locator("dialog textarea")
        text = area.input_value()
        area.fill(text.replace("weight:", "wieght:", 1))
        here.page.locator("dialog button", has_text="Load this text").click()
        here.until("document.getElementById('saved').textContent.includes('wieght')")
        line = here.page.locator("#saved").inner_text()
        assert "did you mean `weight`" in line and "\n" not in line
        area.fill(text)
        here.page.locator("dialog button", has_text="Load this text").click()
        here.until("!document.getElementById('dialog').open")


def test_a_second_click_removes_and_adds_nothing_more(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.value("window.edits = [], live.edit = edit => edits.push(edit.kind), 0")
        here.page.locator(".sentence:has([data-path='effects[0].weight']) .remove").dblclick(force=True)
        assert here.value("window.edits") == ["remove"]


def test_the_keyboard_stays_in_its_tab_when_a_rule_is_removed(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.locator(".sentence:has([data-path='effects[0].weight']) .remove").focus()
        here.value("keepFocus(() => showRules(live.room))")
        assert here.value("document.activeElement.className") == "add"


def test_measures_name_the_worlds_in_their_colours(visit: Callable[..., Visit]) -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules", "random"))
    room_of(session).play(False)
    with serving(session) as server:
        here = opened(visit, server.url)
        here.page.locator("#tab-measures").click()
        here.until("document.querySelectorAll('.measure').length > 3")
        assert here.page.locator(".measure b").first.inner_text().split() == ["rules", "random"]
        assert len(set(here.value("[0, 1, 2, 3].map(laneColour)"))) == 4


def test_the_gallery_keeps_the_keyboard_and_finds_worlds(visit: Callable[..., Visit]) -> None:
    with serving(Session()) as server:
        here = visit(server.url)
        here.page.locator(".card").first.wait_for()
        for _ in range(4):
            here.page.keyboard.press("Tab")
            assert here.value("document.activeElement.closest('#gallery') !== null")
        here.page.locator("#gallery .find").fill("reynolds")
        assert here.page.locator(".card:visible").evaluate_all("cards => cards.map(c => c.dataset.name)") == ["boids"]
        assert here.page.locator("#gallery h3:visible").count() == 1
        here.page.locator(".card:visible").press("Enter")
        here.until("live.room !== null && document.activeElement === views[0].canvas")
        assert not here.page.locator("#gallery").is_visible()


def test_a_change_by_another_page_leaves_the_gallery_open(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here, other = opened(visit, server.url), opened(visit, server.url)
        here.page.keyboard.press("g")
        here.page.locator(".card").first.wait_for()
        version = here.value("live.room.version")
        agents = room_of(boids).lanes[0].record.agents
        other.value("live.edit({ kind: 'add_agents', count: 1 })")
        wait_for(lambda: room_of(boids).lanes[0].record.agents == agents + 1)
        here.value("live.send({ type: 'save' })")  # its answer comes with the news
        here.until(f"live.room.version !== {version}")
        assert here.page.locator("#gallery").is_visible()


def test_every_control_has_a_name_of_its_own(boids: Session, visit: Callable[..., Visit]) -> None:
    """The names alone tell to which rule a value or a button belongs."""
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.page.keyboard.press("2")
        here.value("document.querySelectorAll('#values details').forEach(group => { group.open = true; })")
        labels = "(e.labels && e.labels[0] || {}).innerText"
        named = f"(e.getAttribute('aria-label') || e.innerText || {labels} || '').trim()"
        controls = "[...document.querySelectorAll('button, input, select, textarea, [tabindex]')]"
        assert here.value(f"{controls}.filter(e => e.checkVisibility() && !{named}).map(e => e.outerHTML)") == []
        for section in ("#rules .value, #rules .remove", "#values input"):
            names = here.value(f"[...document.querySelectorAll('{section}')].map(e => {named})")
            assert len(names) == len(set(names)), names
        value = here.page.locator(".value[data-path='effects[1].weight']").first
        assert value.get_attribute("aria-label") == "weight, effect 2: alignment"
        assert value.get_attribute("aria-valuetext").endswith(" kg/s")


def test_a_page_connects_again(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        (connection,) = server._pages
        connection.loop.call_soon_threadsafe(connection.transport.abort)
        here.until(f"{TOAST}.includes('tries again')")
        here.until("live.socket.readyState === WebSocket.OPEN && live.greeted")
        frames = here.value("live.lastFrame")
        here.until(f"live.lastFrame > {frames}")
        tick = room_of(boids).tick
        here.page.keyboard.press("ArrowRight")
        wait_for(lambda: room_of(boids).tick > tick)
        assert room_of(boids).tick == tick + 1
        assert "tries again" not in here.value(TOAST)


def test_one_frame_is_asked_for_at_a_time(boids: Session, visit: Callable[..., Visit]) -> None:
    """Also if news of the room arrives while a frame is awaited: else every change would make frames later."""
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.value("""(() => {
            const send = live.send, take = live.frame;
            window.open_frames = window.most = window.taken = 0;
            live.send = function (message) {
                const line = send.call(this, message);
                if (message.type === "frame") { most = Math.max(most, ++open_frames); this.takeRoom(this.room); }
                return line;
            };
            live.frame = function (data) {
                taken++; open_frames = Math.max(0, open_frames - 1);
                take.call(this, data);
            };
        })()""")
        here.until("taken > 10")
        assert here.value("most") == 1


def test_pictures_that_take_long_are_drawn_once_a_frame(boids: Session, visit: Callable[..., Visit]) -> None:
    """Those between two frames would keep the page from reading the next one."""
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.value("live.request = () => {}, state.playing = true, 0")
        for took, more in ((0, True), (1e9, False)):
            fixed = f"Object.defineProperty(drawn, 'ms', {{ configurable: true, get: () => {took}, set() {{}} }})"
            before = here.value(f"({fixed}, drawn.count)")
            if more:
                here.until(f"drawn.count > {before} + 5")
            else:
                here.page.wait_for_timeout(400)
                assert here.value("drawn.count") <= before + 1


def test_a_recording_ends_with_its_world(visit: Callable[..., Visit]) -> None:
    session = shown_boids()
    with serving(session) as server:
        here = opened(visit, server.url)
        here.page.locator("#save").click()
        here.page.locator("dialog button", has_text="Replay").click()
        here.until("document.getElementById('save').textContent === 'Stop recording'")
        here.value("live.send({ type: 'open', what: 'vicsek' })")
        here.until("live.room.name === 'vicsek'")
        here.until("document.getElementById('save').textContent === 'Save'")
        assert session._recording is None and here.value("live.recording") in (None, "")


def test_a_phone_shows_all_actions_and_the_whole_title(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url, 400, has_touch=True)
        for name in ("worlds", "again", "save", "share", "open", "help"):
            box = here.page.locator(f"#{name}").bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= 400, name
        rows = {
            here.page.locator(f"#{name}").bounding_box()["y"] for name in ("worlds", "again", "save", "share", "open")
        }
        assert len(rows) == 1
        assert not here.page.locator("#seed").is_visible()
        here.page.locator("#open").click()
        for name in ("seed", "trails"):
            box = here.page.locator(f"#{name}").bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= 400, name
        here.page.locator("#trails").click()
        for seed in (5, 0):
            here.page.locator("#seed").fill(str(seed))
            here.page.locator("#seed").press("Enter")
            here.until(f"live.room.seed === {seed}")  # else its news would overwrite what is typed next
            assert room_of(boids).lanes[0].seed == seed
        here.page.locator("#open").click()
        assert here.value("document.querySelector('h1').scrollWidth <= document.querySelector('h1').clientWidth")
        assert here.value("document.documentElement.scrollWidth <= innerWidth")


def test_the_legend_shows_what_colours_mean(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        legend = "document.getElementById('legend').textContent"
        here.page.locator("#colour").select_option("speed")
        here.page.locator("#field").select_option("density")
        here.until(f"{legend}.includes('speed:') && {legend}.includes('density:') && !{legend}.includes('agent')")
        here.page.locator("#colour").select_option("")
        here.page.locator("#field").select_option("")
        here.until(f"{legend}.includes('agent') && !{legend}.includes('density:')")


STAMPED = """() => {
  const w = 297, h = 261, words = new Int32Array(w * h), other = new Int32Array(w * h);
  const colour = 0x804020, plane = emptyPlane(w, h);
  let dice = 1;
  const random = () => (dice = dice * 16807 % 2147483647) / 2147483647;
  for (let n = 0; n < 3000; n++) {
    const reach = n % 1000 ? 0.5 + 3 * random() : 60;
    const x = Math.floor((w + 99) * random() - 50), y = Math.floor((h + 99) * random() - 50);
    const mark = stampOf("dot", formNumber("dot"), reach, reach, -1, n % 2, (n >> 1) % 2);
    blit(words, w, h, mark, x, y, colour, 1);
    addCover(plane, mark, x, y);
  }
  unfoldPlane(plane, other, w, h, colour);
  return [words.every((word, n) => word === other[n]), words.filter(word => word !== 0).length, new Set(words).size];
}"""


def test_a_crowd_in_one_colour_is_drawn_as_one_in_several(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        equal, filled, levels = here.value(f"({STAMPED})()")
        assert equal
        assert filled > 5000
        assert levels > 50  # not all of them are wholly covered


ASKED = """() => new Promise(done => {
  const send = live.send, sent = [];
  live.send = function (message) { sent.push(message.type); return send.call(this, message); };
  const saves = Object.getOwnPropertyDescriptor(live, "saves");
  Object.defineProperty(live, "saves", { get: () => false, configurable: true }); // however slowly this machine draws
  live.waiting = false; live.lastFrame = -1e9;
  live.request(); live.lastFrame = -1e9; live.request(); // the second while the first is on its way
  const before = sent.length, take = live.frame;
  live.frame = function (data) {
    const follow = this.follow;
    this.follow = () => {}; state.playing = true; // as in a world that plays
    take.call(this, data);
    this.follow = follow; live.frame = take; live.send = send; state.playing = false;
    Object.defineProperty(live, "saves", saves);
    done([before, sent.filter(each => each === "frame").length, live.due]);
  };
})"""


def test_a_frame_that_is_due_is_asked_for_when_the_one_before_has_come(
    boids: Session, visit: Callable[..., Visit]
) -> None:
    with serving(boids) as server:
        here = opened(visit, server.url)
        here.until("!live.waiting")
        assert here.value(f"({ASKED})()") == [1, 2, False]


DRAWN = """() => {
  const found = { bodies: [], faces: 0 }, [body, triangles] = [drawBody, facesInOrder];
  drawBody = (pen, eye, panel, one, k) => { found.bodies.push(one.i); body(pen, eye, panel, one, k); };
  facesInOrder = (...given) => { const all = triangles(...given); found.faces = all; return all; };
  drawWorld(views[0], moment(views[0].panel, state.time));
  drawBody = body; facesInOrder = triangles;
  found.colours = [...new Set(found.faces.map(f => faceColour(views[0].panel, f.face, f.back, 0)))];
  found.faces = found.faces.length;
  found.legend = document.getElementById("legend").textContent;
  return found;
}"""


def test_agents_without_faces_are_drawn_beside_a_sheet(visit: Callable[..., Visit]) -> None:
    look = Appearance(by="strain", colours=("#0000ff", "#00ff00"))  # twice as long as its springs: a strain of 1
    sheet = Group(network=Cloth(cells=(2, 2), sides=(1.0, 1.0)), mass=0.1, appearance=look)
    rope = Group(network=Rope(links=2, length=1.0), mass=0.1)
    scene = Scene(
        dimension=3,
        groups=(sheet, Group(count=3, spawn=Spawn(low=(2, 0, 0), high=(3, 1, 1))), rope),
        effects=(Springs(stiffness=10.0, rest=0.5),),
        dt=0.01,
    )
    session = Session()
    session.open_scene(scene, "sheet")
    room_of(session).play(False)
    with serving(session) as server:
        here = opened(visit, server.url)
        found = here.value(f"({DRAWN})()")
        assert sorted(found["bodies"]) == list(range(9, 15))  # the free agents, and the particles of the rope
        assert found["faces"] == 8 and found["colours"] == ["#00ff00"]
        assert "agent" in found["legend"]
        angles = f"{{yaw: {math.radians(35)}, tilt: {math.radians(50)}}}"
        assert np.array(here.value(f"turned({angles})")) == pytest.approx(rows_of(35, 50), abs=1e-12)


SOFT = """() => {
  const { data, width } = softDisc("#ff0000").getContext("2d").getImageData(0, 0, 64, 64);
  return [32, 48, 63].map(x => data[4 * (32 * width + x) + 3]);
}"""


def test_a_billboard_fades_from_its_middle_to_its_edge(boids: Session, visit: Callable[..., Visit]) -> None:
    with serving(boids) as server:
        assert opened(visit, server.url).value(f"({SOFT})()") == pytest.approx([255, 255 * 0.75**2, 0], abs=12)
