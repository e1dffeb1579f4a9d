"""Time in the playground is exact: back and on, a saved file and a link give the same bits, in every shipped world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.play.controls import controls_of
from flockenv.play.edits import Edit, read_edit
from flockenv.play.gallery import entries, read_entry
from flockenv.play.lane import Lane, collected_warnings
from flockenv.play.messages import read_message
from flockenv.play.room import Room
from flockenv.play.session import Session
from flockenv.play.task_lane import TaskLane
from flockenv.scene import Scene
from flockenv.scene.yaml_io import dump_scene, load, load_scene
from flockenv.tasks import TASKS, Task
from tests.test_play import TINY

SEED = 7
STEPS = 40
"""Ticks between two edits: more than between two keyframes."""

SCENES = [entry.name for entry in entries() if entry.kind == "scene"]
PLAYED = ["pursuit", "obstacles", "flock", "school"]


def marked(names: list[str], *quick: str) -> list[Any]:
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in names]


def opened(name: str) -> Session:
    """Return a session that plays a world, which stands still at its start."""
    session = Session()
    with collected_warnings():
        record = load_scene(TINY) if name == "tiny" else read_entry(name)
    if isinstance(record, Task):
        session.open_task(
            record, ("rules", "textbook" if name == "obstacles" else "random"), SEED
        )  # random soon hits one
    else:
        session.open_scene(record, name, SEED)
    session.pause()
    return session


def room_of(session: Session) -> Room:
    assert session.room is not None
    return session.room


def ask(session: Session, **message: Any) -> Any:
    answers = session.answer(read_message(json.dumps(message)))
    return answers[-1] if answers else None


def number_of(lane: Lane) -> Edit:
    """Return an edit of the first number that the world takes without beginning again, of an effect if there is one."""
    controls = controls_of(lane.record)
    for control in sorted(controls, key=lambda control: not control.path.startswith("effects")):
        if control.kind == "number" and control.value:
            for factor in (1.02, 0.98):
                value = control.value * factor
                if lane.would_restart(control.path, value) is False:
                    return read_edit({"kind": "set", "path": control.path, "value": value})
    raise AssertionError("no number can be changed")


def place_of(lane: Lane) -> Edit:
    """Return an edit that moves an agent a little."""
    drawn = lane.drawn
    agent = int(np.flatnonzero(drawn.alive)[0])
    pos = [float(x) + 0.01 for x in drawn.pos[:, agent]]
    return read_edit({"kind": "move_agent", "agent": agent, "pos": pos})


def check_back_and_on(room: Room) -> None:
    """Go back some ticks, or to the start, and on again."""
    end, tick = room.digests, room.tick
    for back in (1, STEPS + 3, tick):
        room.step(-back)
        assert room.tick == tick - back and room.digests != end
        room.step(back)
        assert room.digests == end and room.tick == tick


def check_link(session: Session) -> None:
    """Open the link in another session."""
    room, other = room_of(session), Session()
    ask(other, type="link", text=ask(session, type="share")["text"])
    assert room_of(other).digests == room.digests and room_of(other).tick == room.tick


@pytest.mark.parametrize("name", marked(["tiny", *SCENES], "tiny"))
def test_a_scene_goes_back_and_on_and_its_file_and_link_give_the_same_bits(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = opened(name)
    room = room_of(session)
    lane = room.lanes[0]
    for make in (number_of, place_of):
        room.step(STEPS)
        with collected_warnings():
            assert not room.edit(make(lane)).restarts
            fresh, state = load_scene(dump_scene(lane.record)), lane.state.copy()  # type: ignore[attr-defined]
        fresh.step(state, out=state, steps=2)
        room.step(2)
        assert room.digests == (state.digest,)
    room.step(STEPS)
    assert [made.edit.kind for made in room.made] == ["set", "move_agent"] and not lane.stopped
    check_back_and_on(room)
    check_link(session)

    monkeypatch.chdir(tmp_path)
    Path("saved.yaml").write_text(ask(session, type="save")["text"])
    room.restart()
    room.step(STEPS)
    with collected_warnings():
        assert load_scene(Path("saved.yaml")) == lane.record
    duration = repr(STEPS * lane.interval)
    assert main(["run", "saved.yaml", "--seed", str(SEED), "--duration", duration, "--out", "saved.npz"]) == 0
    assert json.loads(Path("saved.json").read_text())["digest"] == room.digests[0]


@pytest.mark.parametrize("name", marked(PLAYED, "pursuit"))
def test_a_task_goes_back_and_on_and_its_file_and_link_give_the_same_bits(name: str) -> None:
    session = opened(name)
    room = room_of(session)
    lane = room.lanes[0]
    edits: list[dict[str, Any]] = [
        {"kind": "player", "player": "you", "learners": [0], "lane": 0}, {"kind": "input", "action": [0.1, -0.1]},
        {"kind": "disturb", "noise": 0.02, "delay": 1}, {"kind": "player", "player": "rules"},
    ]  # fmt: skip
    for edit in (place_of(lane), number_of(lane), *map(read_edit, edits)):
        room.step(4)
        assert not room.edit(edit).restarts
    room.step(STEPS)
    assert room.tick == STEPS + 24 and len(room.made) == 6
    check_back_and_on(room)
    check_link(session)

    text = ask(session, type="save")["text"]
    room.restart()
    room.step(STEPS)
    players, disturbance = lane.begun  # type: ignore[attr-defined]  # of a TaskLane
    saved = TaskLane(load(text, TASKS[name]), players, SEED, disturbance)
    saved.step(STEPS)
    assert saved.record == lane.record and saved.digest == room.digests[0]


def test_all_worlds_that_ship_are_in_these_tests() -> None:
    root = Path(__file__).resolve().parent.parent
    assert sorted(SCENES) == sorted(path.stem for path in (root / "configs" / "scenes").glob("*.yaml"))
    assert all(isinstance(read_entry(name), Scene) for name in ("boids", "particles")) and set(PLAYED) <= set(TASKS)
