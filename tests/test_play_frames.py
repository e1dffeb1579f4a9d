"""What pages of the playground see: frames, colours, grids, measures, and all about one agent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flockenv.physics.effects.effect import Sight
from flockenv.play.edits import read_edit
from flockenv.play.fields import colour_of, colours_of, grid_of, measures_of
from flockenv.play.frames import Want, decode_frame, encode_frame
from flockenv.play.gallery import entries, read_entry, text_of
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.play.sight import look, neighbours_in
from flockenv.play.task_lane import TaskLane
from flockenv.render.quantise import ABSENT, LEVELS, RESTING, quantise_headings, quantise_positions
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent

TINY = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 40, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}, {kind: separation, weight: 0.2, radius: 1}]
obstacles: [{centre: [4, 4], radius: 0.5}]
dt: 0.01
"""


def test_a_frame_decodes_to_the_state() -> None:
    room = Room([SceneLane(load_scene(TINY), 1), SceneLane(load_scene(TINY.replace("rate: 0.5", "rate: 2")), 1)])
    room.step(30)
    frame = encode_frame(room, Want(colour="speed", field="density"))
    head, blocks = decode_frame(frame)
    assert len(frame) % 4 == 0 and (head["tick"], head["last"]) == (30, 30)
    assert head["time"] == pytest.approx(0.3)
    for about, arrays, lane in zip(head["lanes"], blocks, room.lanes, strict=True):
        low, high = np.array(about["low"]), np.array(about["high"])
        pos = low - 0.5 * (high - low) + arrays["pos"].T / LEVELS * 2 * (high - low)
        assert np.abs(pos - lane.drawn.pos.T).max() < 9 / 32000
        angle = arrays["heading"] / 254 * 2 * np.pi
        unit = lane.drawn.vel / np.linalg.norm(lane.drawn.vel, axis=0)
        assert np.abs(np.stack([np.cos(angle), np.sin(angle)]) - unit).max() < 0.02
        speed = np.linalg.norm(lane.drawn.vel, axis=0)
        assert arrays["shade"] / 255 * about["colour"]["high"] == pytest.approx(speed, abs=0.01)
        assert arrays["field"].shape == (48, 48) and arrays["field"].max() == 255
    assert head["lanes"][0]["apart"] is None and head["lanes"][1]["apart"] > 0


def test_scenery_is_sent_once() -> None:
    room = Room([SceneLane(load_scene(TINY), 1)])
    key, data = decode_frame(encode_frame(room))[0]["lanes"][0]["scenery"]
    assert data["stones"] == [[4, 4, 0.5]]
    assert decode_frame(encode_frame(room, Want(scenery=(key,))))[0]["lanes"][0]["scenery"] == [key]
    room.edit(read_edit({"kind": "move_obstacle", "index": 0, "centre": [6, 4]}))
    again = decode_frame(encode_frame(room, Want(scenery=(key,))))[0]["lanes"][0]["scenery"]
    assert again[0] != key and again[1]["stones"] == [[6, 4, 0.5]]


def test_a_frame_in_3d_has_the_direction_of_every_agent() -> None:
    text = (
        "{dimension: 3, space: {kind: box, size: [4, 4, 4]}, groups: [{count: 20, spawn: {speed: [1, 2]}}], dt: 0.01}"
    )
    lane = SceneLane(load_scene(text), 2)
    arrays = decode_frame(encode_frame(Room([lane])))[1][0]
    turn, tilt = arrays["heading"] / 254 * 2 * np.pi, arrays["tilt"] / 127 * np.pi / 2
    found = np.stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    assert np.abs(found - lane.drawn.vel / np.linalg.norm(lane.drawn.vel, axis=0)).max() < 0.03


def test_quantised_places_are_clipped_and_headings_have_two_more_values() -> None:
    pos = np.array([[-100.0, 0.0, 10.0, 100.0, -5.0, 15.0]])
    assert quantise_positions(pos, [0.0], [10.0]).tolist() == [[0, 16384, 49151, LEVELS, 0, LEVELS]]
    aim = np.array([[1.0, 0.0, -1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 0.0, 0.0, 0.0, -1e-9]])
    shown = np.array([True, True, True, True, False, True])
    assert quantise_headings(aim, shown).tolist() == [0, 64, 127, RESTING, ABSENT, 0]


def test_a_quantity_that_there_is_not_is_refused() -> None:
    room = Room([SceneLane(load_scene(TINY), 1)])
    with pytest.raises(ValueError, match=r"colour = 'sped': unknown, did you mean `speed`\?"):
        encode_frame(room, Want(colour="sped"))
    with pytest.raises(ValueError, match="field = 'heat': unknown"):
        encode_frame(room, Want(field="heat"))


def test_every_colour_has_a_value_per_agent() -> None:
    lane = SceneLane(load_scene(TINY), 1)
    for name in colours_of(lane):
        found = colour_of(lane, name)
        assert found.values.shape == (40,) and found.low < found.high
        assert ((found.values >= found.low - 1e-9) & (found.values <= found.high + 1e-9)).all()


def test_density_counts_every_agent_once() -> None:
    lane = SceneLane(load_scene(TINY), 1)
    grid = grid_of(lane, "density")
    cell = (9 / 48) ** 2
    assert (grid.levels / 255 * grid.high * cell).sum() == pytest.approx(40, rel=0.01)
    assert grid_of(lane, "flow").high > 0


def test_a_flow_has_the_direction_of_its_agents() -> None:
    text = "{space: {kind: torus, size: [12, 12]}, groups: [{count: 60, spawn: {speed: [2, 2], heading: [0, -1]}}], dt: 0.01}"  # noqa: E501
    room = Room([SceneLane(load_scene(text), 1)])
    header, (blocks,) = decode_frame(encode_frame(room, Want(field="flow")))
    ny, nx = header["lanes"][0]["field"]["shape"]
    along, across = blocks["arrows"].astype(int)
    assert (ny, nx) == (24, 24) and not along.any() and across.max() == 0 and across.min() == -127
    whole = -across.sum() / 127 * header["lanes"][0]["field"]["high"] * (12 / 24) ** 2
    assert whole == pytest.approx(60 * 2, rel=0.05)


def test_pressure_is_the_contact_forces_over_the_circumference() -> None:
    text = """
        space: {kind: torus, size: [10, 10]}
        groups: [{count: 3, radius: 0.5, spawn: {low: [0, 0], high: [9, 9]}}]
        effects: [{kind: contact, stiffness: 100}]
        dt: 0.001
    """
    lane = SceneLane(load_scene(text), 1)
    assert "pressure" not in colours_of(SceneLane(load_scene(TINY), 1))
    lane.state.pos[0] = [[0.2, 5.0], [9.4, 5.0], [5.0, 5.0]]  # the first two overlap by 0.2 m across the edge
    found = colour_of(lane, "pressure")
    assert found.values == pytest.approx([20 / np.pi, 20 / np.pi, 0.0]) and found.unit == "N/m"


def test_measures_of_a_free_fall_keep_the_energy() -> None:
    text = "{groups: [{count: 3, mass: 2, spawn: {low: [0, 0], high: [9, 9]}}], effects: [{kind: tether, centre: [4, 4], stiffness: 3}], integrator: {kind: rk4}, dt: 0.01}"  # noqa: E501
    lane = SceneLane(load_scene(text), 1)
    before = measures_of(lane)["energy"]["value"]
    lane.step(100)
    after = measures_of(lane)
    assert after["energy"]["value"] == pytest.approx(before, rel=1e-6) and after["kinetic"]["value"] > 0
    assert measures_of(TaskLane(TASKS["pursuit"](), "rules"))["return"]["value"] == 0


def scene_and_look() -> tuple[Scene, SceneLane]:
    scene = load_scene(TINY)
    lane = SceneLane(scene, 1)
    lane.step(5)
    return scene, lane


def test_forces_on_an_agent_add_up_and_nothing_moves() -> None:
    _, lane = scene_and_look()
    before, pos = lane.digest, lane.state.pos[0, 7].tolist()
    found = look(lane, 7)
    assert lane.digest == before and found["pos"] == pos == pytest.approx(found["path"][0])
    forces = {force["name"]: np.array(force["vector"]) for force in found["forces"]}
    assert forces["drag"] == pytest.approx(-0.5 * np.array(found["vel"]))
    assert forces["drag"] + forces["separation"] == pytest.approx(forces["total"])
    lane.step(round(2 / 0.01) // 24 * 3)
    assert found["path"][3] == pytest.approx(lane.state.pos[0, 7].tolist())
    with pytest.raises(ValueError, match="agent = 99: there is no such living agent"):
        look(lane, 99)


def test_neighbours_are_those_in_sight() -> None:
    scene, lane = scene_and_look()
    gap = np.linalg.norm(scene.space.displacement(lane.state.pos[0, 3], lane.state.pos[0]), axis=1)
    gap[3] = np.inf
    every = neighbours_in(scene, lane.state, 3, Sight(3.0))
    assert every == np.flatnonzero(gap < 3).tolist()
    assert neighbours_in(scene, lane.state, 3, Sight(9.0, nearest=2)) == sorted(np.argsort(gap)[:2].tolist())
    ahead = neighbours_in(scene, lane.state, 3, Sight(3.0, fov=180.0))
    offset = scene.space.displacement(lane.state.pos[0, 3], lane.state.pos[0])
    assert ahead == [k for k in every if offset[k] @ lane.state.vel[0, 3] >= 0]


def test_what_a_learner_observes_has_names_and_units() -> None:
    lane = TaskLane(TASKS["pursuit"](), "rules", 2)
    lane.step(4)
    before = lane.actions[0].tolist()
    found = look(lane, 0)
    slots = {slot["name"]: slot for slot in found["observation"]}
    assert slots["velocity"]["unit"] == "m/s" and slots["velocity"]["value"] == pytest.approx(found["vel"], abs=1e-5)
    assert sum(term["total"] for term in found["reward"]) == pytest.approx(lane.returns)
    assert found["action"] == lane.actions[0].tolist() == pytest.approx(before)
    assert found["player"] == "rules" and [force["kind"] for force in found["forces"]] == ["drive", "total"]


def test_the_gallery_has_all_scenes_and_tasks() -> None:
    configs = {path.stem: path.read_text() for path in (ROOT / "configs" / "scenes").glob("*.yaml")}
    listed = {entry.name: entry for entry in entries()}
    assert listed.keys() == {*configs, *TASKS}
    for name, text in configs.items():
        assert text_of(name) == text
        about = listed[name].description
        assert len(about) > 20 and about.endswith(".") and about[0].isupper()
        assert "flockenv " not in about and "yaml-language" not in about
    assert [name for name, entry in listed.items() if not entry.picture] == [], "python -m flockenv.play.gallery NAME"
    assert isinstance(read_entry("boids"), Scene) and read_entry("pursuit") == TASKS["pursuit"]()
    for name in ("boid", "../scene", "/etc/passwd", ""):
        with pytest.raises(ValueError, match="unknown"):
            read_entry(name)
