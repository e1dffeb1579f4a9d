"""What a server plays: worlds that are opened, described, compared, saved and recorded, without a socket."""

from __future__ import annotations

import base64
import io
import json
import re
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flockenv.model.surface import faces_of
from flockenv.physics.effects import EFFECTS
from flockenv.play.additions import additions_of
from flockenv.play.description import describe_lane
from flockenv.play.frames import decode_frame
from flockenv.play.gallery import entries, read_entry
from flockenv.play.lane import collected_warnings
from flockenv.play.messages import read_message
from flockenv.play.record_paths import with_item
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.session import Session
from flockenv.play.task_lane import TaskLane
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS
from tests.test_play import TINY, edit


def opened(text: str = TINY) -> tuple[Session, Room]:
    session = Session()
    session.open_scene(load_scene(text), "tiny")
    assert session.room is not None
    session.room.play(False)
    return session, session.room


def ask(session: Session, **message: Any) -> Any:
    answers = session.answer(read_message(json.dumps(message)))
    return answers[0] if answers else None


def test_a_description_is_json_that_counts_every_agent() -> None:
    session, room = opened()
    described = json.loads(json.dumps(session.describe(), allow_nan=False))
    (lane,) = described["lanes"]
    assert sum(count for _, count in lane["roles"]) == sum(count for _, count in lane["radius"]) == 6
    assert {"effects[0].rate", "groups[0].count", "dt"} <= {control["path"] for control in described["controls"]}
    assert any(part["path"] == "effects[0].rate" for each in described["sentences"] for part in each["parts"])
    assert (described["kind"], described["interval"], described["players"]) == ("scene", room.interval, [])


def test_the_key_of_a_lane_changes_with_what_is_drawn_without_frames() -> None:
    scene = load_scene(TINY)
    key = describe_lane(SceneLane(scene, 0), "")["key"]
    assert describe_lane(SceneLane(scene, 7), "other")["key"] == key
    larger = load_scene(TINY.replace("count: 4,", "count: 4, radius: 0.7,"))
    assert describe_lane(SceneLane(larger, 0), "")["key"] != key


def test_a_frame_decodes_to_the_world() -> None:
    session, room = opened()
    header, (blocks,) = decode_frame(ask(session, type="frame"))
    low, high = (np.array(header["lanes"][0][name]) for name in ("low", "high"))
    shown = (low - 0.5 * (high - low))[:, None] + blocks["pos"] / 65535 * (2 * (high - low))[:, None]
    assert np.abs(shown - room.lanes[0].drawn.pos).max() <= 9 / 65535 + 1e-9


def test_time_is_stepped_sought_and_recorded() -> None:
    session, room = opened()
    ask(session, type="step", n=3)
    assert room.tick == 3
    ask(session, type="seek", tick=1)
    assert (room.tick, room.playing) == (1, False)
    assert ask(session, type="record", on=True) == {"type": "record", "on": True, "seconds": 0.0}
    for _ in range(5):
        ask(session, type="step", n=4)
        session.advance()  # nothing is due, as time stands still
        assert session._recording is not None
        session._recording.take()
    ended, replay = session.answer(read_message('{"type": "record", "on": false}'))
    assert ended["seconds"] == pytest.approx(20 * room.interval)  # type: ignore[index]
    html = replay["html"]  # type: ignore[index]
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', html)
    (panel,) = json.loads(data)["groups"][0]["panels"]
    assert len(panel["time"]) == 6 and len(panel["roles"]) == 6
    with pytest.raises(ValueError, match="record: nothing is being recorded"):
        ask(session, type="record", on=False)


def test_pages_learn_of_other_agents_also_when_time_goes_past_an_edit() -> None:
    session, room = opened()
    ask(session, type="step", n=2)
    before, agents = session.version, room.lanes[0].record.agents
    session.edit(edit(kind="move_agent", agent=0, pos=[1.0, 1.0]))
    assert session.version == before
    session.edit(edit(kind="add_agents", count=2))
    added = session.version
    assert added != before and room.lanes[0].record.agents == agents + 2
    ask(session, type="step", n=1)
    assert session.version == added
    ask(session, type="step", n=-2)
    gone = session.version
    assert gone != added and room.lanes[0].record.agents == agents
    ask(session, type="seek", tick=3)
    assert session.version != gone and room.lanes[0].record.agents == agents + 2


def test_the_saved_text_of_a_task_is_loaded_into_that_task_with_its_players() -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](size=12), ("rules", "ppo"), seed=3)
    saved = ask(session, type="save")
    assert saved["note"] == "The arguments of the task pursuit, whose defaults are left out."
    ask(session, type="load", yaml=saved["text"].replace("12", "14"))
    assert session.room is not None
    assert [lane.record for lane in session.room.lanes] == 2 * [TASKS["pursuit"](size=14)]
    assert [lane.players[0] for lane in session.room.lanes if isinstance(lane, TaskLane)] == ["rules", "ppo"]
    assert session.room.lanes[0].seed == 3
    with pytest.raises(ValueError, match=r"^text:1: sise = .*: unknown key, did you mean"):
        ask(session, type="load", yaml="sise: 3")
    assert session.room.lanes[0].record == TASKS["pursuit"](size=14)


def test_the_text_of_a_scene_is_loaded_as_a_scene_while_a_task_is_open() -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules", "random"), seed=3)
    ask(session, type="load", yaml=TINY)
    assert session.room is not None
    (lane,) = session.room.lanes
    assert lane.record == load_scene(TINY) and lane.seed == 3 and session.describe()["kind"] == "scene"
    assert session.name == "scene" and session.describe()["players"] == []
    assert not any("groups" in task.model_fields for task in TASKS.values())


def test_pages_learn_of_other_players() -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules",))
    session.pause()
    before = session.version
    session.edit(edit(kind="player", player="you"))
    assert session.version != before and session.describe()["lanes"][0]["players"] == ["you"]


def test_measures_have_the_time_of_the_world_that_still_runs() -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules", "random"))
    session.pause()
    assert session.room is not None
    ask(session, type="step", n=100)
    first, second = session.room.lanes
    assert first.stopped and not second.stopped and first.time < second.time
    assert ask(session, type="measures")["time"] == second.time


def test_a_restart_keeps_a_seed_that_pages_cannot_write() -> None:
    session = Session()
    session.open_scene(load_scene(TINY), "tiny", seed=2**63 - 1)
    ask(session, type="seed")
    assert session.room is not None and session.room.lanes[0].seed == 2**63 - 1
    ask(session, type="seed", seed=3)
    assert session.room.lanes[0].seed == 3


def test_a_recording_that_ends_with_its_world_is_told_to_the_page() -> None:
    session, _ = opened()
    ask(session, type="record", on=True)
    told = session.answer(read_message(json.dumps({"type": "load", "yaml": TINY})))
    assert told == [{"type": "record", "on": False, "seconds": 0.0, "note": LOST}]
    assert ask(session, type="save")["type"] == "yaml"
    assert session.answer(read_message(json.dumps({"type": "load", "yaml": TINY}))) == []


LOST = "The recording was not saved: it ended with its world."


def test_a_recording_is_drawn_as_a_gif() -> None:
    session, _ = opened()
    ask(session, type="record", on=True)
    for _ in range(3):
        ask(session, type="step", n=4)
        assert session._recording is not None
        session._recording.take()
    _, film = session.answer(read_message('{"type": "record", "on": false, "form": "gif"}'))
    picture = Image.open(io.BytesIO(base64.b64decode(film["data"])))  # type: ignore[index]
    assert (picture.format, picture.n_frames, picture.width) == ("GIF", 4, 640)  # type: ignore[attr-defined]
    assert picture.info["duration"] == 40


def test_what_a_scene_says_about_itself_is_described() -> None:
    session = Session()
    session.answer(read_message('{"type": "open", "what": "boids"}'))
    assert session.about.startswith("The flock of Reynolds 1987: 300 birds")
    session.answer(read_message(json.dumps({"type": "load", "yaml": "# Three points.\n" + TINY})))
    assert session.describe()["about"] == "Three points."


def test_a_saved_text_is_the_record_and_tells_what_it_lacks() -> None:
    session, room = opened()
    session.edit(edit(kind="set", path="effects[0].rate", value=0.25))
    session.edit(edit(kind="move_agent", agent=0, pos=[1.0, 1.0]))
    saved = ask(session, type="save")
    assert load_scene(saved["text"]) == room.lanes[0].record
    assert saved["note"] == "1 changes of this run, such as moved agents, are not in the YAML; a link has them."


@pytest.mark.slow
def test_costs_are_measured_from_a_copy_of_the_world() -> None:
    session, room = opened()
    message = read_message('{"type": "costs"}')
    later = session.prepare(message)()
    assert callable(later)
    ask(session, type="step", n=3)
    digests = room.digests
    (answer,) = later()
    assert isinstance(answer, dict) and [row["path"] for row in answer["rows"]] == ["effects[0]"]
    assert answer["step"] > 0 and room.tick == 3 and room.digests == digests


def test_two_time_steps_are_compared_side_by_side() -> None:
    session, _ = opened()
    ask(session, type="lanes", variants=[{}, {"dt": 0.005}])
    room = session.room
    assert room is not None and [lane.record.dt for lane in room.lanes] == [0.01, 0.005]
    assert room.lanes[0].interval == room.lanes[1].interval == 0.01
    names = [lane["name"] for lane in session.describe()["lanes"]]
    assert names[0] != names[1] and "0.005" in names[1]
    with pytest.raises(ValueError, match="integer multiples"):
        ask(session, type="lanes", variants=[{}, {"dt": 0.0073}])
    with pytest.raises(ValueError, match=r"lanes\.variants: missing"):
        ask(session, type="lanes", players=["rules"])


def test_a_link_is_opened_at_its_moment() -> None:
    session, room = opened()
    ask(session, type="step", n=5)
    text = ask(session, type="share", camera={"zoom": 2.0})["text"]
    other = Session()
    assert ask(other, type="link", text=text) == {"type": "camera", "camera": {"zoom": 2.0}}
    assert other.room is not None and other.room.digests == room.digests and not other.room.playing


def test_another_seed_begins_again() -> None:
    session, room = opened()
    before = room.digests
    ask(session, type="seed", seed=9)
    assert room.tick == 0 and room.lanes[0].seed == 9 and room.digests != before
    ask(session, type="seed", seed=0)
    assert room.digests == before


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ({"type": "look", "lane": 2, "agent": 0}, "look.lane = 2: there are 1 lanes"),
        ({"type": "open", "what": "bods"}, "boids"),
        ({"type": "hello", "version": 0}, "version = 0: the server speaks 1"),
        ({"type": "load", "yaml": "groups: []"}, "groups"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(message: dict[str, Any], line: str) -> None:
    session, room = opened()
    with pytest.raises(ValueError, match=re.escape(line)):
        ask(session, **message)
    assert session.room is room


def test_nothing_is_played_before_a_world_is_open() -> None:
    session = Session()
    assert session.version == (0, 0) and not session.is_playing
    assert ask(session, type="hello", version=1)["open"] is False
    with pytest.raises(ValueError, match="nothing is open"):
        ask(session, type="play", on=True)


def test_a_task_is_described_with_its_players() -> None:
    session = Session()
    session.open_task(TASKS["pursuit"](), ("rules", "you"))
    described = session.describe()
    assert [lane["name"] for lane in described["lanes"]] == ["rules", "you"]
    assert {"rules", "ppo", "you"} <= set(described["players"]) and described["action"]["size"] == 2
    assert described["sentences"] == [] and described["about"].endswith(".")


QUICK = ("boids", "crowd_circle", "rope", "sphere")
"""Scenes that are quickly built with each of their additions."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each.name, marks=() if each.name in QUICK else pytest.mark.slow)
        for each in entries()
        if each.kind == "scene"
    ],
)
def test_every_addition_that_is_offered_is_accepted(name: str) -> None:
    scene = read_entry(name)
    assert isinstance(scene, Scene)
    found = additions_of(scene)
    assert len(found) > 40 and all(each["value"]["kind"] in EFFECTS and each["description"] for each in found)
    for each in found:
        with collected_warnings():
            added = with_item(scene, each["path"], each["value"])
        assert len(added.effects) == len(scene.effects) + 1


def test_an_addition_becomes_an_effect() -> None:
    session, room = opened()
    (drag,) = (each for each in ask(session, type="additions")["additions"] if each["title"] == "drag")
    session.edit(edit(kind="add", path=drag["path"], value=drag["value"]))
    assert [effect.kind for effect in room.lanes[0].record.effects] == ["drag", "drag"]


@pytest.mark.parametrize(
    "value", [{"kind": "springs", "stiffness": 1}, {"kind": "drag", "rate": 1e9}, {"kind": "journey"}, {"preset": "x"}]
)
def test_an_effect_that_a_scene_cannot_have_is_refused_in_one_line(value: dict[str, Any]) -> None:
    session, room = opened()
    with pytest.raises(ValueError, match=r"effects|dt|preset") as refused:
        ask(session, type="edit", edit={"kind": "add", "path": "effects", "value": value})
    assert "\n" not in str(refused.value) and len(room.lanes[0].record.effects) == 1


def test_faces_are_those_of_sheets_and_the_outer_ones_of_bodies() -> None:
    sheet = "groups: [{network: {kind: cloth, cells: [3, 2], sides: [3, 2]}}]\neffects: []\nspace: {kind: plane}\n"
    assert len(faces_of(load_scene(sheet))) == 12
    body = "dimension: 3\n" + sheet.replace(
        "cloth, cells: [3, 2], sides: [3, 2]", "jelly, cells: [2, 2, 2], sides: [1, 1, 1]"
    )
    scene: Scene = load_scene(body)
    faces = faces_of(scene)
    assert len(faces) == 6 * 4 * 2  # two triangles on each square of each side
    middle = 13  # of 27 particles, the one inside
    assert middle not in faces
