"""The core of the playground: edits act at once, time runs back exactly, and a saved file gives the same bits."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.engine.workspace import Workspace
from flockenv.geometry.shapes import (
    SHAPES,
    Block,
    Capsule,
    Circle,
    DistanceField,
    HalfSpace,
    Polygon,
    Shape,
    TriangleMesh,
    Wall,
)
from flockenv.play.edits import Edit, read_edit
from flockenv.play.history import EVERY, History
from flockenv.play.limits import pairs_of
from flockenv.play.link import LONGEST, read_link, write_link
from flockenv.play.record_paths import with_item
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.task_lane import PlayerFiles, TaskLane, players_of
from flockenv.scene import Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent

TINY = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 4, spawn: {speed: [1, 2]}}, {count: 2, max_speed: 3, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}]
dt: 0.01
"""


def edit(**data: Any) -> Edit:
    return read_edit(data)


def tiny(**changes: Any) -> SceneLane:
    return SceneLane(load_scene(TINY).model_copy(update=changes), 3)


# --- time -------------------------------------------------------------------------------------------------------------


class Clock:
    """A clock that stands still until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_an_edit_in_the_past_drops_the_later_ones() -> None:
    room = Room([tiny()])
    room.step(10)
    room.edit(edit(kind="set", path="effects[0].rate", value=2))
    room.step(90)
    room.seek(5)
    assert room.last == 100
    room.edit(edit(kind="set", path="effects[0].rate", value=1))
    assert room.last == 5 and [made.tick for made in room.made] == [5]
    room.step(95)
    assert room.lanes[0].record.effects[0].rate == 1


def test_memory_of_history_is_bounded_and_time_still_exact() -> None:
    lane = tiny()
    history = History([lane], budget=30 * lane.keep().nbytes)
    seen = {}
    while history.tick < 6400:
        history.advance(EVERY)
        if history.tick % 1600 == 0:
            seen[history.tick] = lane.digest
            assert history.nbytes <= 30 * lane.keep().nbytes
    for tick in (1600, 6400, 3200):
        history.go_to(tick)
        assert lane.digest == seen[tick]


def slowed(lane: SceneLane, clock: Clock) -> list[int]:
    """Let every tick of a lane take 10 ms of a clock; return the list to which the ticks of each call are added."""
    made, step = list[int](), lane.step

    def slowly(ticks: int = 1) -> None:
        clock.now += 0.01 * ticks
        made.append(ticks)
        step(ticks)

    lane.step = slowly  # type: ignore[method-assign]
    return made


def test_steps_that_take_long_are_not_computed_again_when_time_goes_back() -> None:
    clock, lane = Clock(), tiny()
    history, made, seen = History([lane], clock=clock), slowed(lane, clock), list[str]()
    while history.tick < 4 * EVERY:
        history.advance(1)
        seen.append(lane.digest)
    for tick in (*range(4 * EVERY - 1, 4 * EVERY - 12, -1), 50, 49, 48):
        made.clear()
        history.go_to(tick)
        assert sum(made) <= 3 and lane.digest == seen[tick - 1]


def test_keyframes_that_were_dropped_are_made_again_when_time_goes_back() -> None:
    clock, lane = Clock(), tiny()
    history, made = History([lane], 8 * lane.keep().nbytes, clock), slowed(lane, clock)
    while history.tick < 500:
        history.advance(500 - history.tick)
    history.go_to(201)
    for tick in (200, 199, 198, 197):
        made.clear()
        history.go_to(tick)
        assert sum(made) <= 3 and history.nbytes <= 8 * lane.keep().nbytes


def test_steps_after_a_change_of_numbers_allocate_no_scratch(monkeypatch: pytest.MonkeyPatch) -> None:
    room, allocated = Room([tiny()]), list[int]()
    room.step(2)
    allocate = Workspace.allocate

    def counted(*arguments: Any) -> Workspace:
        allocated.append(1)
        return allocate(*arguments)

    monkeypatch.setattr(Workspace, "allocate", counted)
    room.edit(edit(kind="set", path="effects[0].rate", value=0.25))
    room.step(2)
    assert not allocated
    room.edit(edit(kind="set", path="groups[0].mass", value=2.0))  # which the scratch holds
    room.step(2)
    assert allocated


DENSE = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 20000, spawn: {speed: [1, 2]}}]
effects: [{kind: separation, weight: 1, radius: 0.5}]
"""
"""A scene of which only a smaller one is stepped here."""


@pytest.mark.parametrize(
    ("text", "path", "value", "refusal"),
    [
        (TINY, "groups[0].count", 300_000, "300,002 agents; a page may ask for at most 250,000"),
        (
            DENSE,
            "groups[0].count",
            200_000,
            "a step would compare about",
        ),
        (DENSE, "effects[0].radius", 4.0, "a step would compare about 4.0e+08 pairs of agents"),
        (DENSE, "groups[0].count", 10**9, "agents need about"),
    ],
)
def test_what_would_take_long_to_start_or_step_is_refused_before_anything_is_allocated(
    text: str, path: str, value: float, refusal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other pages see the same worlds, and would wait."""
    lane = SceneLane(load_scene(text), 3)
    scene, digest = lane.record, lane.digest
    monkeypatch.setattr(Workspace, "allocate", lambda *a: pytest.fail("scratch is allocated"))
    change = edit(kind="set", path=path, value=value)
    for act in (lane.prepare, lane.apply):
        with pytest.raises(ValueError, match=re.escape(refusal)) as caught:
            act(change)
        assert "\n" not in str(caught.value) and (lane.record, lane.digest) == (scene, digest)
        assert value == 10**9 or str(caught.value).startswith(f"{path} = {value}: ")


def test_a_scene_that_is_large_from_the_start_may_be_changed_but_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockenv.play.limits.MOST_AGENTS", 3)
    monkeypatch.setattr("flockenv.play.limits.MOST_PAIRS", 1.0)
    lane = SceneLane(load_scene(DENSE.replace("20000", "40")), 3)
    for path, value in (("effects[0].weight", 2.0), ("effects[0].radius", 0.1), ("groups[0].count", 39)):
        lane.prepare(edit(kind="set", path=path, value=value))
    for path, more in (("effects[0].radius", 3.0), ("groups[0].count", 41)):
        with pytest.raises(ValueError, match="a page may ask for at most"):
            lane.prepare(edit(kind="set", path=path, value=more))
    with pytest.raises(ValueError, match=r"^add_agents = 1: 41 agents"):
        lane.apply(edit(kind="add_agents"))


@pytest.mark.slow
@pytest.mark.parametrize("reach", [0.3, 1.0])
def test_pairs_are_estimated_as_steps_count_them(reach: float) -> None:
    scene = load_scene(DENSE.replace("20000", "2000").replace("radius: 0.5", f"radius: {reach}"))
    state = scene.start(3)
    assert 0.5 < scene.step(state).work[0, 2] / pairs_of(scene, state.pos[0]) < 2


def test_a_law_that_reaches_all_agents_compares_all_pairs_unless_it_joins_far_ones() -> None:
    scene = load_scene(DENSE.replace("torus", "box").replace("20000", "9000"))
    far = {"kind": "gravitation", "constant": 1.0, "softening": 0.1}
    pos = scene.start(3).pos[0]
    near, all_pairs, joined = (
        pairs_of(each, pos)
        for each in (scene, *(with_item(scene, "effects", far | {"opening": x}) for x in (0.0, 0.5)))
    )
    assert near < joined < all_pairs == 9000**2


def test_time_goes_on_behind_a_gap_of_keyframes() -> None:
    room = Room([tiny()], budget=3 * tiny().keep().nbytes)
    room.step(2000)
    room.seek(900)
    room.edit(edit(kind="set", path="effects[0].rate", value=0.25))
    room.step(300)
    assert (room.tick, room.lanes[0].tick) == (1200, 1200)
    end = room.digests
    room.seek(1000)
    room.seek(1200)
    assert room.digests == end


def test_a_room_keeps_its_speed_and_drops_what_takes_too_long() -> None:
    clock = Clock()
    room = Room([tiny()], clock=clock)
    room.set_speed(2)
    room.play()
    for _ in range(50):
        clock.now += 0.02
        room.advance()
    assert room.tick == 200  # 1 s at speed 2 in steps of 0.01 s
    advance = room.history.advance

    def slowly(ticks: int) -> int:
        clock.now += 0.01 * (made := advance(ticks))
        return made

    room.history.advance = slowly  # type: ignore[method-assign]  # steps now take 10 ms, twice what there is
    for k in range(200):
        began = clock.now
        room.advance(0.02)
        assert clock.now - began <= 0.045 or k == 0  # until it has noticed
        clock.now = max(clock.now, began + 0.02)
    assert 200 < room.tick < 900
    room.play(False)
    clock.now += 10
    assert room.advance() == 0


# --- edits ------------------------------------------------------------------------------------------------------------


def test_a_value_acts_in_the_next_step() -> None:
    lane = tiny()
    lane.step(5)
    change = lane.apply(edit(kind="set", path="effects[0].rate", value=4))
    other = load_scene(TINY.replace("rate: 0.5", "rate: 4"))
    expected = other.step(lane.state)
    lane.step()
    assert not change.restarts and lane.tick == 6 and lane.digest == expected.digest


def test_only_new_code_is_compiled_before_an_edit(monkeypatch: pytest.MonkeyPatch) -> None:
    lane, started = tiny(), list[Scene]()
    lane.step()
    monkeypatch.setattr(Scene, "start", lambda self, seed: started.append(self))
    monkeypatch.setattr(Scene, "step", lambda self, state: None)
    lane.prepare(edit(kind="set", path="effects[0].rate", value=4))
    lane.prepare(edit(kind="move_agent", agent=0, pos=[1, 1]))
    assert not started
    lane.prepare(edit(kind="add", path="effects", value={"kind": "separation", "weight": 1, "radius": 2}))
    assert [len(scene.effects) for scene in started] == [2] and len(lane.record.effects) == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [("groups[0].count", 5), ("groups[0].spawn.speed", [0, 1]), ("dtype", "float32"), ("groups[1].alive", 1)],
)
def test_what_a_world_begins_with_begins_it_again(path: str, value: object) -> None:
    room = Room([tiny()])
    room.step(7)
    assert room.lanes[0].would_restart(path, value)
    assert room.edit(edit(kind="set", path=path, value=value)).restarts
    assert room.tick == 0 and not room.made
    assert room.digests[0] == SceneLane(room.lanes[0].record, 3).digest


@pytest.mark.parametrize(
    ("path", "value"), [("groups[1].max_speed", 2), ("groups[0].mass", 2), ("space.size", [8, 9]), ("dt", 0.02)]
)
def test_what_acts_on_steps_goes_on(path: str, value: object) -> None:
    room = Room([tiny()])
    room.step(6)
    before = room.lanes[0].drawn.pos.copy()
    assert not room.edit(edit(kind="set", path=path, value=value)).restarts
    assert room.tick == 6 and (room.lanes[0].drawn.pos == before).all()
    assert room.lanes[0].time == pytest.approx(0.06)
    room.step(1)


def test_a_saved_file_gives_the_bits_of_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    room = Room([tiny()])
    room.step(9)
    room.edit(edit(kind="set", path="effects[0].rate", value=1.25))
    room.edit(edit(kind="add_obstacle", shape={"centre": [4, 4], "radius": 1}))
    room.edit(edit(kind="move_agent", agent=0, pos=[1, 1]))
    room.restart()
    room.step(40)
    Path("saved.yaml").write_text(dump_scene(room.lanes[0].record))
    assert main(["run", "saved.yaml", "--seed", "3", "--duration", "0.4", "--out", "saved.npz"]) == 0
    assert json.loads(Path("saved.json").read_text())["digest"] == room.digests[0]


def test_agents_come_and_go_and_the_others_stay() -> None:
    lane = tiny()
    lane.step(3)
    before = lane.state.copy()
    lane.apply(edit(kind="add_agents", group=0, count=2, at=[2, 3]))
    assert [group.count for group in lane.record.groups] == [6, 2]
    assert (lane.state.pos[0, [0, 1, 2, 3, 6, 7]] == before.pos[0]).all()
    assert (lane.state.pos[0, 4:6] == [2, 3]).all()
    lane.apply(edit(kind="remove_agents", agents=[4, 0]))
    assert (lane.state.pos[0, [0, 1, 2]] == before.pos[0, [1, 2, 3]]).all() and lane.record.agents == 6
    lane.step(2)


def test_the_pointer_attracts_and_repels() -> None:
    far = {}
    for acts in ("goal", "flee"):
        lane = tiny()
        lane.apply(edit(kind="pointer", acts=acts, at=[4, 4], group=1))
        lane.step(60)
        offset = lane.record.space.displacement(lane.state.pos[0], [4.0, 4.0])
        far[acts] = np.linalg.norm(offset, axis=1)
    free = tiny()
    free.step(60)
    unmoved = np.linalg.norm(free.record.space.displacement(free.state.pos[0], [4.0, 4.0]), axis=1)
    assert (far["goal"][4:] < unmoved[4:]).all() and (far["flee"][4:] > unmoved[4:]).all()
    assert (far["goal"][:4] == unmoved[:4]).all()


@pytest.mark.parametrize("kind", sorted(SHAPES))
def test_a_shape_moves_to_a_place(kind: str) -> None:
    shapes: dict[str, Shape] = {
        "circle": Circle(centre=(1, 2), radius=1), "capsule": Capsule(start=(0, 0), end=(2, 0)),
        "wall": Wall(vertices=((0, 0), (1, 0), (1, 3))), "polygon": Polygon(vertices=((0, 0), (2, 0), (2, 1))),
        "block": Block(centre=(1, 1), size=(2, 3)), "half_space": HalfSpace(point=(0, 0), direction=(0, 1)),
        "distance_field": DistanceField(low=(0, 0), spacing=1, values=((1, 1), (1, 1))),
        "mesh": TriangleMesh(
            vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), spacing=0.1,
            triangles=((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
        ),
    }  # fmt: skip
    shape = shapes[kind]
    by, place = np.array([3.0, -1.0, 0.5])[: shape.dimension], np.array([0.3, 2.7, 0.4])[: shape.dimension]
    if kind == "distance_field":
        with pytest.raises(ValueError, match="cannot be moved"):
            shape.moved_to((1.0, 1.0))
        return
    moved = shape.moved_to(tuple(np.array(shape.anchor) + by))
    assert moved.gap(place + by) == pytest.approx(shape.gap(place))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"kind": "set", "path": "effects[0].rate", "value": -1}, r"^effects\[0\].rate = -1: must be a number >= 0"),
        ({"kind": "set", "path": "effects[0].rat", "value": 1}, r"did you mean `rate`\?"),
        ({"kind": "set", "path": "effects[4].rate", "value": 1}, r"^effects\[4\]: there are 1 items"),
        ({"kind": "add", "path": "effects", "value": {"kind": "drg"}}, r"did you mean `drag`\?"),
        ({"kind": "remove", "path": "dt"}, "is not an item of a list"),
        ({"kind": "remove", "path": "groups[7]"}, r"^groups\[7\]: there are 2 items"),
        ({"kind": "move_agent", "agent": 9, "pos": [1, 1]}, "there is no such living agent among 6"),
        ({"kind": "move_agent", "agent": 1, "pos": [1, 1, 1]}, "must have 2 numbers"),
        ({"kind": "remove_agents", "agents": [4, 5]}, "group 1 must keep at least one agent"),
        ({"kind": "add_agents", "group": 3}, "there are 2 groups"),
        ({"kind": "pointer", "at": [1, 1], "group": 2}, "there are 2 groups"),
        ({"kind": "player", "player": "you"}, "a scene has no players"),
        ({"kind": "set", "path": "dt", "value": 1, "lane": 3}, "lane = 3: there are 1 lanes"),
    ],
)
def test_what_is_not_possible_is_refused_and_changes_nothing(data: dict[str, Any], message: str) -> None:
    room = Room([tiny()])
    room.step(2)
    before = room.digests, room.lanes[0].record
    with pytest.raises(ValueError, match=message) as refused:
        room.edit(read_edit(data))
    assert "\n" not in str(refused.value) and (room.digests, room.lanes[0].record) == before and not room.made


@pytest.mark.parametrize(
    "data",
    [
        None, [], {"kind": "run"}, {"kind": "set"}, {"kind": "set", "path": "a b", "value": 1},
        {"kind": "set", "path": "dt", "value": 1, "lane": "0"}, {"kind": "move_agent", "agent": 1.5, "pos": [1, 1]},
        {"kind": "move_agent", "agent": 1, "pos": [1, float("nan")]}, {"kind": "input", "action": [2]},
        {"kind": "add_agents", "count": 10**6}, {"kind": "player", "player": "x" * 1000},
    ],
)  # fmt: skip
def test_an_edit_of_another_form_is_refused_in_one_line(data: object) -> None:
    with pytest.raises(ValueError, match="edit") as refused:
        read_edit(data)
    assert "\n" not in str(refused.value)


def test_an_edit_that_one_lane_refuses_changes_none() -> None:
    room = Room([tiny(), SceneLane(load_scene(TINY.replace("drag, rate: 0.5", "gravity, acceleration: [0, 0]")), 3)])
    before = room.digests, [lane.record for lane in room.lanes]
    with pytest.raises(ValueError, match="unknown key"):
        room.edit(edit(kind="set", path="effects[0].rate", value=1))
    assert (room.digests, [lane.record for lane in room.lanes]) == before


def test_lanes_have_one_clock() -> None:
    half = load_scene(TINY).model_copy(update={"dt": 0.005})
    room = Room([tiny(), SceneLane(half, 3, per_tick=2)])
    room.step(50)
    assert [lane.time for lane in room.lanes] == pytest.approx([0.5, 0.5])
    apart = room.apart[1]
    assert room.apart[0] is None and apart is not None and 0 < apart < 0.1
    with pytest.raises(ValueError, match=r"its tick takes 0\.005 s"):
        Room([tiny(), SceneLane(half, 3)])
    with pytest.raises(ValueError, match="its tick takes"):
        room.edit(edit(kind="set", path="dt", value=0.02))


def test_a_lane_that_diverges_stops_at_its_last_finite_state() -> None:
    brake = TINY.replace("drag, rate: 0.5", "quadratic_drag, rate: 0.5")
    room = Room([SceneLane(load_scene(brake), 3), tiny()])
    room.step(3)
    room.edit(edit(kind="set", path="effects[0].rate", value=1e6, lane=0))
    room.step(40)
    stopped, other = room.lanes
    assert "position or velocity is not finite" in stopped.stopped and "\n" not in stopped.stopped
    assert np.isfinite(stopped.drawn.pos).all() and stopped.tick < 43 and other.tick == 43 and not room.ended
    digest = room.digests
    room.seek(1)
    assert not stopped.stopped
    room.seek(43)
    assert room.digests == digest and stopped.stopped


# --- players and links ------------------------------------------------------------------------------------------------


def test_a_learner_is_handed_to_a_person_and_back() -> None:
    lane = TaskLane(TASKS["pursuit"](), "rules", 1)
    assert players_of(lane.record) == ("random", "textbook", "rules", "ppo", "you")
    lane.step(3)
    lane.apply(edit(kind="player", player="you"))
    lane.step()
    assert (lane.actions == 0).all()
    lane.apply(edit(kind="input", action=[0.5, -1]))
    lane.step()
    assert lane.actions.tolist() == [[0.5, -1]]
    lane.apply(edit(kind="player", player="textbook"))
    lane.step()
    assert lane.actions.tolist() != [[0.5, -1]]
    for player in ("rulez", "/etc/passwd", "x.py", "queueing"):
        with pytest.raises(ValueError, match="player"):
            lane.apply(edit(kind="player", player=player))
    with pytest.raises(ValueError, match="pursuit has no obstacles"):
        lane.apply(edit(kind="add_obstacle", shape={"centre": [1, 1], "radius": 1}))


def test_a_link_opens_the_same_moment() -> None:
    room = Room([tiny()])
    room.step(11)
    room.edit(edit(kind="set", path="effects[0].rate", value=2))
    room.edit(edit(kind="move_agent", agent=1, pos=[3, 4]))
    room.step(30)
    text = write_link(room, "tiny", {"x": 1.5})
    link = read_link(text)
    opened = link.room()
    assert (opened.digests, opened.tick, link.camera, link.title) == (room.digests, 41, {"x": 1.5}, "tiny")
    opened.seek(5)
    room.seek(5)
    assert opened.digests == room.digests


def bomb() -> str:
    """Return a short link whose JSON is larger than what is read."""
    content = b'{"seed": 1, "lanes": [' + b" " * 10**7 + b"]}"
    return "1." + base64.urlsafe_b64encode(zlib.compress(content, 9)).decode().rstrip("=")


SEES = """
import numpy as np
class Player:
    def watch(self, world):
        self.world = world
    def predict(self, observation):
        return np.full((len(observation), 2), self.world.state.pos[0, 0, 0] % 1, np.float32)
"""


def test_a_player_that_sees_the_state_sees_that_of_the_present_world(tmp_path: Path) -> None:
    """Also when it is switched to, when other sensors make another world, and after going back over both."""
    path = tmp_path / "sees.py"
    path.write_text(SEES)
    room = Room([TaskLane(TASKS["pursuit"](), "rules", 1, files=PlayerFiles((str(path),)))])
    (lane,) = room.lanes
    assert isinstance(lane, TaskLane)

    def sees() -> bool:
        x = float(lane.world.state.pos[0, 0, 0]) % 1
        room.step(1)
        return bool(np.allclose(lane.actions, np.float32(x)))

    room.step(3)
    room.edit(read_edit({"kind": "player", "learners": "all", "player": str(path)}))
    assert sees()
    room.edit(read_edit({"kind": "disturb", "noise": 0.1, "delay": 0, "dropped": 0.0}))
    assert sees()
    digest = lane.digest
    room.seek(0)
    room.seek(4)
    assert sees() and lane.digest == digest
    room.seek(2)
    room.edit(read_edit({"kind": "player", "learners": "all", "player": str(path)}))
    assert sees()


def corrupted(change: Callable[[str], str]) -> str:
    room = Room([tiny()])
    return change(write_link(room))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "must begin with"), (lambda text: "1." + "A" * LONGEST, "characters"),
        (lambda text: text[:-4], "cut off"), (lambda text: bomb(), "holds more than is read"),
        (lambda text: text + "A", "damaged"), (lambda text: text[:-20], "cut off|damaged"),
        (lambda text: text[:30] + "!" + text[31:], "damaged"), (lambda text: "1.eJxTBAAAIgAi", "damaged"),
    ],
)  # fmt: skip
def test_a_damaged_link_is_refused_in_one_line(change: Callable[[str], str], message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        read_link(corrupted(change))
    assert "\n" not in str(refused.value)
