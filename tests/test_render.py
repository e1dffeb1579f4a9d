from __future__ import annotations

import base64
import json
import math
import os
import pickle
import re
import subprocess
import sys
import weakref
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flockenv.cli.films import Shutter, write_picture
from flockenv.geometry.space import Box, Torus
from flockenv.model.appearance import Appearance
from flockenv.model.networks import Blocks, Cloth
from flockenv.model.snapshot import ROLES, Mark, Snapshot
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Springs
from flockenv.play.fields import colour_of
from flockenv.play.scene_lane import SceneLane
from flockenv.render import Group, Panel, Window, draw, turned, write_gif, write_png, write_replay
from flockenv.render.camera import rows_of
from flockenv.render.palette import ROLE_COLOURS, rgb
from flockenv.render.view import view_of
from flockenv.scene import Group as SceneGroup
from flockenv.scene import Scene
from flockenv.studies.trajectory import record


def shot(pos: Any = ((5.0, 5.0),), vel: Any = None, **fields: Any) -> Snapshot:
    pos = np.array(pos, dtype=float)
    n, d = pos.shape
    given = {
        "time": 0.0,
        "vel": np.zeros((n, d)) if vel is None else vel,
        "alive": np.ones(n, dtype=bool),
        "radius": np.full(n, 0.5),
        "roles": ("evader",) * n,
        "obstacle_centre": np.empty((0, d)),
        "obstacle_radius": np.empty(0),
        "marks": (),
        "low": np.zeros(d),
        "high": np.full(d, 10.0),
        "periodic": False,
        "title": "",
    }
    return Snapshot(pos=pos, **{**given, **fields})


def close_to(image: np.ndarray, colour: tuple[int, int, int], within: int = 12) -> np.ndarray:
    return np.abs(image.astype(int) - colour).max(axis=2) <= within


def blob(image: np.ndarray, role: str) -> tuple[float, float]:
    # The caption above the world also shows the colours of the roles.
    rows, columns = np.nonzero(close_to(image, rgb(ROLE_COLOURS[role][0])) & (np.arange(len(image)) > 50)[:, None])
    assert len(rows)
    return columns.mean(), rows.mean()


def difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one.astype(int) - other).max(axis=2)


# ---- metaballs and motion blur


RED = Appearance(form="metaball", colours=("#ff0000",))


def reds(pos: Any, **look: Any) -> np.ndarray:
    """Return the red pixels of a picture of agents with a radius of 0.5 m in a field of 10 m."""
    n = len(pos)
    return close_to(
        draw(shot(pos, looks=(RED.model_copy(update=look),), look=np.zeros(n, dtype=int)), 400), (255, 0, 0)
    )


def test_metaballs_melt_if_they_are_near_and_are_discs_of_their_size_if_not() -> None:
    alone, disc = reds([(5, 5)]).sum(), reds([(5, 5)], form="disc").sum()
    assert alone == pytest.approx(disc, rel=0.05)
    assert reds([(2, 5), (8, 5)]).sum() == pytest.approx(2 * disc, rel=0.05)
    near, apart = [(4.2, 5), (5.8, 5)], reds([(4.2, 5), (5.8, 5)], form="disc")
    row, column = (int(np.round(np.nonzero(apart)[k].mean())) for k in (0, 1))
    assert reds(near)[row, column] and not apart[row, column], "the gap of 0.6 m is filled"
    assert reds(near).sum() > apart.sum()


def test_a_billboard_is_opaque_in_its_middle_and_fades_to_its_edge_and_the_nearest_covers_others() -> None:
    soft = Appearance(form="billboard", colours=("#ff0000",), size=(2.0, 2.0))
    picture = draw(shot([(5, 5)], looks=(soft,), look=[0]), 400)
    view = view_of(shot(), 400, 1)
    x, y = view.to_pixels(np.array((5.0, 5.0))).round().astype(int)
    for share in (0.0, 0.25, 0.5, 0.75):  # green where the paper, which is white, shows
        green = picture[y, x + round(share * 2.0 * view.metre), 1]
        assert green == pytest.approx(255 * (1 - (1 - share**2) ** 2), abs=12)
    assert (picture[y, x + round(2.1 * view.metre)] == 255).all()
    blue = soft.model_copy(update={"colours": ("#0000ff",)})
    for heights, channel in (((2.0, 8.0), 2), ((8.0, 2.0), 0)):
        pair = shot([(5, 5, z) for z in heights], looks=(soft, blue), look=[0, 1])
        assert draw(pair, 400)[y, x, channel] > 250


def test_a_billboard_larger_than_the_picture_has_its_whole_radius() -> None:
    soft = Appearance(form="billboard", colours=("#ff0000",), size=(30.0, 30.0))
    view = view_of(shot(), 200, 1)
    x, y = view.to_pixels(np.array((2.0, 5.0))).round().astype(int)
    rows, columns = np.mgrid[math.ceil(view.top) : int(view.bottom), math.ceil(view.left) : int(view.right)]
    part = ((columns - x) ** 2 + (rows - y) ** 2) / (30.0 * view.metre) ** 2
    inside = np.s_[rows[0, 0] : rows[-1, 0] + 1, columns[0, 0] : columns[0, -1] + 1, 1]
    small = soft.model_copy(update={"size": (1.0, 1.0)})
    near, far, empty = (
        draw(shot([at], looks=(look,), look=[0]), 200, 1)
        for at, look in (((2.0, 5.0), soft), ((60.0, 60.0), soft), ((60.0, 60.0), small))
    )
    np.testing.assert_allclose(near[inside], empty[inside] * (1 - (1 - part) ** 2), atol=2)
    np.testing.assert_array_equal(far, empty)


def test_a_metaball_without_a_size_is_not_drawn() -> None:
    assert not reds([(5, 5)], size=(0.0, 0.0)).any()


def test_metaballs_melt_across_the_edge_of_a_torus_and_take_mean_colours() -> None:
    assert reds([(0.2, 5)]).sum() < reds([(5, 5)]).sum()
    whole = {"looks": (RED,), "look": np.zeros(1, dtype=int), "periodic": True}
    parts = close_to(draw(shot([(0.2, 5)], **whole), 400), (255, 0, 0))
    assert parts.sum() == pytest.approx(reds([(5, 5)]).sum(), rel=0.05)
    both = Appearance(form="metaball", by="speed", over=(0, 1), colours=("#ff0000", "#0000ff"))
    two = shot([(4.4, 5), (5.6, 5)], vel=[(0, 0), (1, 0)], looks=(both,), look=np.zeros(2, dtype=int))
    purple = close_to(draw(two, 400), (128, 0, 128), within=30)
    assert purple.any()


def test_a_picture_with_motion_blur_is_the_mean_of_the_last_instants_of_its_frame(tmp_path: Path) -> None:
    film = [replace(shot([(1.0 + 0.2 * k, 5)]), time=0.025 * k) for k in range(41)]
    write_picture(tmp_path / "blur.webp", [Panel("", film, None, "")], "", 10.0, 200, Shutter(4, 2))
    with Image.open(tmp_path / "blur.webp") as file:
        assert file.n_frames == 11, "the first instant, and ten frames of four parts"
    write_picture(tmp_path / "blur.png", [Panel("", film, None, "")], "", 10.0, 200, Shutter(4, 2))
    with Image.open(tmp_path / "blur.png") as file:
        found = np.asarray(file)
    ends = [draw(film[k], 200, trails=film[:k]).astype(float) for k in (40, 39)]
    np.testing.assert_allclose(found, np.mean(ends, axis=0), atol=0.51)


def test_a_shutter_needs_several_steps_in_a_frame() -> None:
    assert Shutter.of(0.5, 16) == Shutter(8, 4) and Shutter.of(0, 1) == Shutter(1, 1)
    assert [Shutter.of(1, steps).parts for steps in (2, 15, 17, 20)] == [2, 5, 8, 5], "whole steps, no other frame rate"
    assert Shutter.of(0.01, 3) == Shutter(3, 2)
    with pytest.raises(ValueError, match=r"--shutter 0\.5: each frame of this scene is one time step"):
        Shutter.of(0.5, 1)


def test_a_picture_in_few_colours_keeps_those_of_its_areas(tmp_path: Path) -> None:
    whole = draw(shot([(3.0, 5.0), (7.0, 5.0)], [(1.0, 0.0), (0.0, 1.0)], roles=("pursuer", "agent")), 300)
    write_png(tmp_path / "few.png", whole, 64)
    with Image.open(tmp_path / "few.png") as file:
        assert file.mode == "P" and len(file.getcolors() or []) <= 64
        few = np.asarray(file.convert("RGB"))
    assert difference(few, whole).max() <= 14 and (difference(few, whole) > 0).mean() < 0.1
    for colours in (15, 257, 64.0):
        with pytest.raises(ValueError, match=f"^colours: must be an integer from 16 to 256, got {colours}$"):
            write_png(tmp_path / "new.png", whole, colours)  # type: ignore[arg-type]
    assert [path.name for path in tmp_path.iterdir()] == ["few.png"]


# ---- snapshot


def test_snapshot_copies_and_is_read_only() -> None:
    vel = np.ones((1, 2))
    snapshot = shot(vel=vel)
    vel[:] = 7.0
    assert (snapshot.vel == 1.0).all()
    for name in "pos vel alive radius obstacle_centre obstacle_radius low high bonds faces".split():
        with pytest.raises(ValueError, match="read-only"):
            getattr(snapshot, name)[...] = 0
    with pytest.raises(AttributeError):
        snapshot.time = 1.0  # type: ignore[misc]


def test_snapshot_survives_pickling() -> None:
    snapshot = shot(marks=(Mark("goal", [1.0, 2.0], [0.0, 0.0], 1.0),))
    again = pickle.loads(pickle.dumps(snapshot))
    assert (draw(again) == draw(snapshot)).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pos": [[1.0, 2.0, 3.0, 4.0]]}, "Snapshot.pos: must have 2 or 3 coordinates, got 4"),
        ({"vel": np.zeros((2, 2))}, r"Snapshot.vel: must have shape \(1, 2\), got shape \(2, 2\)"),
        ({"vel": "fast"}, "Snapshot.vel: must be numbers, got str"),
        ({"alive": [1.0]}, "Snapshot.alive: must be bool, got float64"),
        ({"radius": [-1.0]}, "Snapshot.radius: must be >= 0 m, got -1.0"),
        ({"radius": [np.nan]}, "Snapshot.radius: must be finite, got nan"),
        ({"roles": ("evdaer",)}, "Snapshot.roles: unknown 'evdaer'.*did you mean 'evader'"),
        ({"roles": "evader"}, "Snapshot.roles: must be a tuple of 1 names"),
        ({"roles": ("evader", "evader")}, "Snapshot.roles: must have 1 names"),
        ({"obstacle_radius": [1.0]}, r"Snapshot.obstacle_radius: must have shape \(0,\)"),
        ({"high": [10.0, 0.0]}, "Snapshot.low: must be below high"),
        ({"time": np.inf}, "Snapshot.time: must be finite"),
        ({"title": 3}, "Snapshot.title: must be a str, got int"),
        ({"marks": ("goal",)}, "Snapshot.marks: must hold Mark, got str"),
        ({"bonds": [(0, 1)]}, r"Snapshot.bonds: must be agents from 0 to 0, got \[1\]"),
        ({"bonds": [(0, -1)]}, r"Snapshot.bonds: must be agents from 0 to 0, got \[-1\]"),
        ({"bonds": [0, 0]}, r"Snapshot.bonds: must have shape \(any, 2\), got shape \(2,\)"),
        ({"bonds": [(0.0, 0.0)]}, "Snapshot.bonds: must be integers, got float64"),
        ({"faces": [(0, 0, 1)]}, r"Snapshot.faces: must be agents from 0 to 0, got \[1\]"),
        ({"faces": [(0, 0)]}, r"Snapshot.faces: must have shape \(any, 3\), got shape \(1, 2\)"),
        ({"marks": (Mark("goal", np.ones(3), np.ones(3), 0.0),)}, "Snapshot.marks: must have 2 coordinates, got 3"),
    ],
)
def test_a_bad_snapshot_raises_an_error_of_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        shot(**fields)
    assert "\n" not in str(caught.value)


def test_mark_refuses_an_unknown_kind_and_a_negative_radius() -> None:
    with pytest.raises(ValueError, match="did you mean 'goal'"):
        Mark("gaol", np.zeros(2), np.zeros(2), 1.0)
    with pytest.raises(ValueError, match=r"Mark.radius: must be >= 0 m, got -1.0"):
        Mark("goal", np.zeros(2), np.zeros(2), -1.0)


# ---- draw


@pytest.mark.parametrize("role", ROLES)
def test_an_agent_is_drawn_at_its_position_in_the_colour_of_its_role(role: str) -> None:
    x0, y0 = blob(draw(shot([(5.0, 5.0)], roles=(role,))), role)
    x1, y1 = blob(draw(shot([(7.0, 6.0)], roles=(role,))), role)
    metre = (x1 - x0) / 2.0
    assert 45.0 < metre < 60.0  # 10 m over most of the 600 px
    assert y0 - y1 == pytest.approx(metre, abs=0.6)  # y points up
    assert x0 == pytest.approx(299.5, abs=0.6)  # both middles coincide


@pytest.mark.parametrize("degrees", range(0, 360, 30))
def test_a_dart_points_along_the_velocity(degrees: int) -> None:
    direction = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    image = draw(shot(vel=[3.0 * direction], radius=[1.0]))
    x, y = blob(draw(shot(radius=[1.0])), "evader")
    solid = close_to(image, rgb(ROLE_COLOURS["evader"][0]), 30)
    ahead, behind = (tuple(np.rint((y - r * direction[1], x + r * direction[0])).astype(int)) for r in (36.0, -36.0))
    assert solid[ahead]
    assert not solid[behind]


def test_an_agent_is_drawn_with_its_radius() -> None:
    image = draw(shot([(5.0, 5.0)], [(1.0, 0.0)], radius=[1.5]))
    rows = np.flatnonzero(difference(image, draw(shot(np.empty((0, 2))))).max(axis=1)[60:])
    metre = np.diff([blob(draw(shot([(x, 5.0)])), "evader")[0] for x in (2.0, 8.0)])[0] / 6.0
    assert rows[-1] - rows[0] == pytest.approx(2.0 * 1.5 * metre, abs=2.5)


def test_dead_and_diverged_agents_are_not_drawn() -> None:
    empty = draw(shot(np.empty((0, 2))))
    assert (difference(draw(shot([(2.0, 2.0)])), empty)[60:].max()) > 100
    for hidden in (
        shot([(2.0, 2.0)], alive=[False], roles=("agent",)),  # an unused row of the table
        shot([(np.nan, 2.0)]),
        shot([(2.0, 2.0)], [(np.inf, 0.0)]),
        shot([(1e300, -1e300)], [(1e300, 1e300)]),
    ):
        assert difference(draw(hidden), empty)[60:].max() == 0


def test_a_caught_agent_leaves_a_cross() -> None:
    image = draw(shot(alive=[False], radius=[1.0]))
    x, y = np.rint(blob(draw(shot(radius=[1.0])), "evader")).astype(int)
    marked = difference(image, draw(shot(np.empty((0, 2))))) > 60
    assert marked[y + 25, x + 25]
    assert marked[y - 25, x + 25]
    assert not marked[y, x + 25]


def test_a_body_on_the_seam_is_drawn_on_both_sides_inside_the_world() -> None:
    here = {"pos": [(0.1, 5.0)], "radius": [0.8]}
    box, torus = draw(shot(**here)), draw(shot(**here, periodic=True))
    empty = draw(shot(np.empty((0, 2)), periodic=True))
    seen = difference(torus, empty) > 20
    assert not (difference(box, draw(shot(np.empty((0, 2))))) > 20)[60:, 400:].any()
    assert seen[60:, 540:572].any()
    assert not seen[60:, :28].any()
    assert not seen[60:, 574:].any()


def test_no_body_covers_the_caption() -> None:
    plain = draw(shot(np.empty((0, 2)), title="x"))
    covered = draw(shot([(5.0, 10.3)], title="x", radius=[2.0], roles=("agent",)))
    assert (covered[:38, :100] == plain[:38, :100]).all()


def test_the_legend_leaves_out_roles_that_no_agent_is_drawn_in_the_colour_of() -> None:
    looks = {"looks": (Appearance(colours=("#d55e00",)), Appearance(size=(0.3, 0.3)))}
    red, bare, mixed = (draw(shot([(3, 3), (7, 7)], **looks, look=look)) for look in ((0, 0), (1, 1), (0, 1)))
    dots = [int(close_to(image[:38], rgb(ROLE_COLOURS["evader"][0])).sum()) for image in (red, bare, mixed)]
    assert dots[0] == 0 < dots[1] == dots[2]


def test_obstacles_goals_and_headings_are_drawn() -> None:
    empty = draw(shot(np.empty((0, 2))))

    def change(**fields: Any) -> np.ndarray:
        return difference(draw(shot(np.empty((0, 2)), **fields)), empty) > 20

    stone = change(obstacle_centre=[(5.0, 5.0)], obstacle_radius=[2.0])
    goal = change(marks=(Mark("goal", [5.0, 5.0], [0.0, 0.0], 2.0),))
    assert stone.sum() == pytest.approx(np.pi * (2.0 * 54.0) ** 2, rel=0.05)
    assert goal.sum() == pytest.approx(stone.sum(), rel=0.02)
    ring = close_to(draw(shot(np.empty((0, 2)), marks=(Mark("goal", [5.0, 5.0], [0.0, 0.0], 2.0),))), (0, 158, 115))
    assert 0 < ring.sum() < 0.1 * goal.sum()  # a ring: agents inside stay visible
    x, y = 300, np.nonzero(stone)[0].mean()
    east = change(marks=(Mark("heading", [5.0, 5.0], [9.0, 0.0], 0.0),))
    north = change(marks=(Mark("heading", [5.0, 5.0], [0.0, 0.01], 0.0),))
    assert np.nonzero(east)[1].mean() > x + 30
    assert np.nonzero(north)[0].mean() < y - 30
    assert east.sum() == pytest.approx(north.sum(), rel=0.1)  # only the direction counts
    assert not change(marks=(Mark("heading", [5.0, 5.0], [0.0, 0.0], 0.0),)).any()


def test_nearer_agents_in_3d_are_larger_and_on_top() -> None:
    empty = draw(shot(np.empty((0, 3))))
    area = [(difference(draw(shot([(5.0, 5.0, z)])), empty)[60:] > 8).sum() for z in (0.0, 5.0, 10.0)]
    assert area[0] < area[1] < area[2]
    two = {"roles": ("evader", "pursuer"), "radius": [1.0, 1.0]}
    image = draw(shot([(5.0, 5.0, 10.0), (5.0, 5.0, 2.0)], **two))
    x, y = np.rint(blob(image, "evader")).astype(int)
    assert close_to(image, rgb(ROLE_COLOURS["evader"][0]), 20)[y, x]


def test_bonds_are_lines_between_dots() -> None:
    pair = {"pos": [(2.0, 5.0), (8.0, 5.0)], "vel": [(1.0, 0.0), (1.0, 0.0)], "radius": [0.1, 0.1]}
    empty = draw(shot(np.empty((0, 2))))
    free, tied = (
        difference(draw(shot(**pair, bonds=bonds)), empty) > 20 for bonds in (np.zeros((0, 2), int), [(1, 0)])
    )
    assert not free[60:, 200:400].any()
    assert tied[60:, 200:400].any(axis=0).all()
    assert 1 <= tied[60:, 300].sum() <= 3  # a thin line
    dot = np.flatnonzero(tied[60:, :].any(axis=0))[0], np.flatnonzero(free[60:, :].any(axis=0))[0]
    assert dot[0] > dot[1]  # a dot instead of a dart
    for gone in ({"alive": [True, False], "roles": ("agent",) * 2}, {"vel": [(1.0, 0.0), (np.nan, 0.0)]}):
        alone = difference(draw(shot(**{**pair, **gone}, bonds=[(0, 1)])), empty) > 20
        assert not alone[60:, 200:400].any()


def test_a_bond_across_the_seam_takes_the_shortest_path() -> None:
    pair = {"pos": [(1.0, 5.0), (9.0, 5.0)], "radius": [0.1, 0.1], "periodic": True}
    seen = difference(draw(shot(**pair, bonds=[(0, 1)])), draw(shot(np.empty((0, 2)), periodic=True))) > 20
    assert not seen[60:, 100:500].any()
    assert seen[60:, 30:60].any(axis=0).all()
    assert seen[60:, 540:570].any(axis=0).all()


# ---- faces


def faced(pos: Any, faces: Any, **fields: Any) -> np.ndarray:
    """Return which pixels of a field of 10 m differ from those without agents, below the caption."""
    given = {"roles": ("agent",) * len(pos), "radius": np.full(len(pos), 0.01), "faces": faces} | fields
    empty = draw(shot(np.empty((0, len(pos[0]))), periodic=fields.get("periodic", False)), scale=1)
    return (difference(draw(shot(pos, **given), scale=1), empty) > 20)[60:]


CORNERS = [(2.0, 2.0), (7.0, 2.0), (2.0, 7.0)]


def test_a_face_covers_its_area_and_its_corners_are_no_dots() -> None:
    metre = view_of(shot(), 600, 1).metre
    for corners in (CORNERS, CORNERS[::-1]):
        assert faced(corners, [(0, 1, 2)]).sum() == pytest.approx(12.5 * metre**2, rel=0.01)
    assert not faced(CORNERS, [(0, 1, 2)], alive=[True, True, False]).any()


def test_an_edge_that_broke_takes_its_face_away_and_the_inside_of_a_body_is_hidden() -> None:
    pos, bonds, faces = [*CORNERS, (7.0, 7.0)], [(1, 0), (1, 2), (3, 2)], [(0, 1, 2), (1, 3, 2)]
    whole = faced(pos, faces, bonds=bonds)
    torn = faced(pos, faces, bonds=bonds, broken=[True, False, False])
    assert torn.sum() == pytest.approx(whole.sum() / 2, rel=0.02)
    inner = [*CORNERS, (3.0, 3.0)]
    tied = faced(inner, faces[:1], covered=[True] * 4, radius=np.full(4, 0.5))
    np.testing.assert_array_equal(tied, faced(CORNERS, faces[:1]))


def test_faces_that_cross_hide_each_other_pixel_by_pixel_and_backs_have_their_own_colour() -> None:
    one = [(1.0, 1.0, 1.0), (9.0, 1.0, 9.0), (5.0, 9.0, 5.0)]
    other = [(1.0, 1.0, 9.0), (9.0, 1.0, 1.0), (5.0, 9.0, 5.0)]
    roles = ("pursuer",) * 3 + ("flockmate",) * 3
    image = draw(shot([*one, *other], roles=roles, radius=np.full(6, 0.01), faces=[(0, 1, 2), (3, 4, 5)]), scale=1)
    left, right = (image[400, x].astype(int) for x in (200, 400))
    assert left[2] > left[0] and right[0] > right[2]  # the flockmates' blue is higher on the left
    flipped = draw(shot(one, roles=roles[3:], radius=np.full(3, 0.01), faces=[(0, 2, 1)]), scale=1)
    assert flipped[400, 300, 0] > flipped[400, 300, 2]  # orange


def test_a_face_across_the_seam_is_drawn_at_both_edges() -> None:
    seen = faced([(9.0, 4.0), (1.0, 4.0), (9.0, 6.0)], [(0, 1, 2)], periodic=True)
    assert seen[:, :40].any() and seen[:, -40:].any() and not seen[:, 100:500].any()


def test_corners_and_centres_of_blocks_are_drawn_as_their_surface_and_other_agents_are_not() -> None:
    block = SceneGroup(network=Blocks(sides=(1.0, 1.0, 1.0), centres=((0.0, 0.0, 0.0),)))
    scene = Scene(dimension=3, groups=(SceneGroup(count=2, spawn=Spawn(low=(3, 3, 3), high=(4, 4, 4))), block), dt=0.01)
    assert scene.snapshot(scene.start(0)).covered.tolist() == [False] * 2 + [True] * 9


STRAINED = Appearance(by="strain", over=(0.0, 0.1), colours=("#0000ff", "#ff0000"))


def strained(springs: Springs, by: float = 1.0, **fields: Any) -> tuple[Scene, State]:
    """Return a sheet of two cells of 1 m by 1 m, pulled along x by a factor."""
    sheet = SceneGroup(network=Cloth(cells=(2, 1), sides=(2.0, 1.0)), appearance=STRAINED)
    scene = Scene(dimension=3, groups=(sheet,), effects=(springs,), dt=0.001, **fields)
    state = scene.start(0)
    return scene, state.with_motion(state.pos * (by, 1.0, 1.0), state.vel)


def test_strain_is_the_mean_over_the_edges_at_an_agent_and_colours_faces() -> None:
    scene, state = strained(Springs(stiffness=1.0), 1.05)
    expected = np.array([0.025, 0.1 / 3, 0.025] * 2)
    np.testing.assert_allclose(scene.view.strain(state), expected, atol=1e-12)
    np.testing.assert_allclose(scene.snapshot(state).shade, expected / 0.1, atol=1e-9)
    np.testing.assert_allclose(next(record(scene, 0, 0, 1).snapshots()).shade, 0.0, atol=1e-9)
    lane = SceneLane(scene)
    lane.state = state
    np.testing.assert_allclose(lane.drawn.shade, expected / 0.1, atol=1e-9)
    np.testing.assert_allclose(colour_of(lane, "strain").values, expected, atol=1e-12)
    for factor, channel in ((1.0, 2), (1.5, 0)):  # blue at rest, red if strained
        scene, state = strained(Springs(stiffness=1.0), factor)
        picture = draw(scene.snapshot(state), 200)
        assert (picture[..., channel].astype(int) - picture[..., 2 - channel] > 100).sum() > 500


def test_strain_is_over_the_present_rest_lengths_and_leaves_broken_edges_out() -> None:
    scene, state = strained(Springs(stiffness=1.0, break_strain=0.5))
    assert scene.edges[:2].tolist() == [[0, 1], [0, 3]]
    first, second = scene.edge_springs[:2]
    state.bonds[0, first], state.bonds[0, second] = np.inf, 0.8  # broken, and yielded from 1 m
    np.testing.assert_allclose(scene.view.strain(state), [0.25, 0, 0, 0.25 / 2, 0, 0], atol=1e-12)
    scene, state = strained(Springs(stiffness=1.0, rest=0.5))
    np.testing.assert_allclose(scene.view.strain(state), 1.0)
    scene, state = strained(Springs(stiffness=1.0, rest=0.0))
    np.testing.assert_array_equal(scene.view.strain(state), 0.0)


@pytest.mark.parametrize("at", [np.nan, np.inf, 1e200, 1.5e308])
def test_a_run_that_diverged_is_drawn_in_the_colours_of_its_strain(at: float) -> None:
    """Also the neighbours of an agent at a position that is not finite, whose strain has no finite value."""
    scene, state = strained(Springs(stiffness=1.0), space=Box(size=(9, 9, 9)))
    state.pos[0, 0, 0] = at
    shown = scene.view.strain(state)
    assert np.isfinite(shown).all() and shown[5] == pytest.approx(0.0)
    snapshot = scene.snapshot(state)
    assert snapshot.shade[1] == (0.0 if np.isnan(at) else 1.0) and snapshot.shade[5] == pytest.approx(0.0)
    assert draw(snapshot, 100).shape[1] == 100


def test_strain_takes_the_shortest_path_on_a_torus_and_needs_a_network() -> None:
    scene, state = strained(Springs(stiffness=1.0), space=Torus(size=(9, 9, 9)))
    state = state.with_motion(scene.space.wrap(state.pos - 0.5), state.vel)
    np.testing.assert_allclose(scene.view.strain(state), 0.0, atol=1e-12)
    with pytest.raises(ValueError, match=r"groups\[0\].appearance.by = strain: needs a network"):
        Scene(groups=(SceneGroup(count=2, appearance=STRAINED),), space=Torus(size=(9, 9)), dt=0.1)


# ---- camera


def test_the_rotation_is_that_of_the_page() -> None:
    """Numbers of `turned` in page/lens.js, by Node: tests/test_browser_page.py compares again, in a browser."""
    points = np.array([(1.0, 2.0, 3.0), (-0.5, 0.0, 4.0)])
    for camera, expected in (
        ((30, 60), [(1.8660254037844386, 3.214101615137755, 0.43301270189221963),
                    (-0.43301270189221935, 3.5891016151377544, 1.7834936490538909)]),
        ((-100, 140), [(-2.1432636836913463, 1.4400007654431075, -2.7079177568185235),
                       (0.08682408883346515, 2.948353692113902, -2.747666661696167)]),
    ):  # fmt: skip
        np.testing.assert_allclose(points @ rows_of(*camera).T, expected, atol=1e-14)


def test_a_turned_snapshot_shows_a_side_and_keeps_distances_and_speeds() -> None:
    world = shot(
        [(2.0, 5.0, 9.0), (8.0, 5.0, 1.0)],
        vel=[(0, 0, 3.0), (1.0, 0, 0)],
        obstacle_centre=[(2.0, 5.0, 9.0)],
        obstacle_radius=[1.0],
        outlines=(np.array([(1.0, 1.0), (2.0, 1.0), (2.0, 9.0)]),),
        marks=(Mark("goal", np.array((8.0, 5.0, 1.0)), np.zeros(3), 1.0),),
    )
    side = turned(world, 0, 90)
    np.testing.assert_allclose(side.pos, [(-3.0, 4.0, 0.0), (3.0, -4.0, 0.0)], atol=1e-12)
    np.testing.assert_allclose(side.vel, [(0.0, 3.0, 0.0), (1.0, 0.0, 0.0)], atol=1e-12)
    np.testing.assert_allclose(side.obstacle_centre[0], side.pos[0])
    np.testing.assert_allclose(side.marks[0].at, side.pos[1])
    np.testing.assert_allclose(side.outlines[0][:, 1], -5.0)  # on the ground, which is seen from its edge
    np.testing.assert_allclose((side.low, side.high), ([-5.0] * 3, [5.0] * 3), atol=1e-12)
    assert turned(world, 0, 0) is world
    oblique = turned(world, 35, 50)
    np.testing.assert_allclose(np.linalg.norm(np.diff(oblique.pos, axis=0)), 10.0)
    assert (np.abs(oblique.pos) <= oblique.high).all() and draw(oblique, 200).shape[1] == 200


@pytest.mark.parametrize("camera", [(0, 90), (35, 90), (20, 60)])
def test_no_trail_is_drawn_across_a_turned_torus(camera: tuple[float, float]) -> None:
    """Seen from the side, a jump along y is one towards the viewer, which moves an agent by a pixel or two."""
    for axis in range(3):
        path = np.full((3, 3), 5.0)
        path[:, axis] = (9.6, 0.4, 1.2)
        path[:, (axis + 1) % 3] = (4.0, 4.4, 4.8)
        film = [turned(shot([at], periodic=True), *camera) for at in path]
        for trails in (film[:1], film[:2]):
            plain, drawn = draw(film[len(trails)], 300), draw(film[len(trails)], 300, trails=trails)
            assert (difference(plain, drawn) > 0).any() == (len(trails) == 2), "the second step only"


def test_bonds_across_the_edge_of_a_torus_are_left_out_of_a_turned_picture() -> None:
    pos = [(0.5, 5.0, 5.0), (9.5, 5.0, 5.0), (8.0, 5.0, 5.0)]
    world = shot(pos, bonds=[(0, 1), (1, 2)], periodic=True, faces=[(0, 1, 2)])
    side = turned(world, 20, 60)
    assert side.whole_bonds.tolist() == [[1, 2]] and not len(side.whole_faces) and not side.periodic


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ((361, 0), "yaw = 361: must be from -360 to 360 degrees"),
        ((0, -1), "tilt = -1: must be from 0 to 180 degrees"),
        ((math.nan, 0), "yaw = nan: must be"),
        ((10, 0), "yaw = 10, tilt = 0: for worlds in 3-D only; this one is in 2-D"),
    ],
)
def test_bad_cameras_are_refused(camera: tuple[float, float], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        turned(shot(), *camera)


def test_agents_with_bonds_leave_no_trail() -> None:
    shots = [shot([(3.0 + k, 5.0), (3.0 + k, 6.0)], bonds=[(0, 1)]) for k in range(4)]
    assert (draw(shots[-1], trails=shots[:-1]) == draw(shots[-1])).all()


def test_trails_follow_the_path_and_are_cut_at_the_seam() -> None:
    shots = [shot([((8.0 + 0.5 * k) % 10.0, 5.0)], [(1.0, 0.0)], radius=[0.2], periodic=True) for k in range(8)]
    trail = difference(draw(shots[-1], trails=shots[:-1]), draw(shots[-1])) > 8
    columns = np.flatnonzero(trail.any(axis=0))
    assert columns[-1] > 520  # before the seam
    assert columns[0] < 40  # behind it
    assert not trail[:, 120:420].any()
    with pytest.raises(ValueError, match="trails: must have positions of shape"):
        draw(shots[0], trails=[shot(np.zeros((3, 2)))])


@pytest.mark.parametrize("high", [(10.0, 10.0), (40.0, 10.0), (3.0, 30.0), (1000.0, 1.0)])
def test_pictures_have_even_sides_that_fit_the_size(high: tuple[float, float]) -> None:
    image = draw(shot(np.empty((0, 2)), high=high), size=301)
    assert image.dtype == np.uint8
    assert image.shape[1:] == (300, 3)
    assert image.shape[0] % 2 == 0
    assert image.shape[0] <= 302


def test_drawing_is_repeatable_and_does_not_change_the_cached_backdrop() -> None:
    one = shot(np.random.default_rng(0).uniform(0, 10, (9, 2)), title="same")
    first = draw(one)
    draw(shot(title="same"))
    assert (draw(one) == first).all()
    first[:] = 0
    assert draw(one).any()


@pytest.mark.parametrize("title", ["\x1b[2J", "a\nb", "\ud800", "🐟" * 500, "", "<script>"])
def test_any_title_can_be_drawn(title: str) -> None:
    assert draw(shot(title=title), size=200).shape == (200, 200, 3)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"size": 0}, ValueError),
        ({"size": 10**9}, ValueError),
        ({"size": 3.5}, TypeError),
        ({"scale": 0}, ValueError),
        ({"scale": True}, TypeError),
    ],
)
def test_draw_refuses_a_bad_size(options: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error, match=f"^{next(iter(options))}: must be"):
        draw(shot(), **options)


# ---- backends


def test_importing_the_package_imports_no_backend_and_drawing_needs_no_display() -> None:
    program = (
        "import sys, flockenv.render; loaded = lambda *names: [n for n in names if n in sys.modules];"
        "assert not loaded('PIL', 'matplotlib', 'pygame'), loaded('PIL', 'matplotlib', 'pygame');"
        "from flockenv.render import draw, write_gif, write_replay; from flockenv.model.snapshot import Snapshot;"
        "draw(Snapshot(0, [[1, 1]], [[1, 0]], [True], [1], ['agent'], [[2, 2]], [1], (), [0, 0], [3, 3], True, 'x'));"
        "assert not loaded('matplotlib', 'pygame', 'torch'), loaded('matplotlib', 'pygame', 'torch')"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parents[1], env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_an_unknown_attribute_raises_an_error_that_lists_the_known_ones() -> None:
    import flockenv.render

    with pytest.raises(AttributeError, match="write_replay"):
        _ = flockenv.render.write_mp4  # type: ignore[attr-defined]
    assert "draw" in dir(flockenv.render)


def test_a_window_shows_the_frame_and_may_be_closed_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    window = Window("test")
    frame = draw(shot(), size=100)
    window.show(frame, fps=1000.0)
    assert (pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1) == frame).all()
    assert not pygame.mixer.get_init()  # the display only, not pygame.init()
    assert not pygame.font.get_init()
    window.show(draw(shot(), size=80), fps=1000.0)
    assert pygame.display.get_surface().get_size() == (80, 80)
    with pytest.raises(ValueError, match="fps: must be above 0"):
        window.show(frame, fps=0.0)
    window.close()
    window.close()
    window.show(frame, fps=1000.0)
    assert not pygame.display.get_init()


def test_a_run_continues_after_its_window_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    window, frame = Window(), draw(shot(), size=64)
    window.show(frame, fps=1000.0)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(frame, fps=1000.0)
    assert not window.is_open
    window.show(frame, fps=1000.0)


def test_closing_one_window_keeps_the_other_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    one, two, frame = Window(), Window(), draw(shot(), size=64)
    one.show(frame, fps=1000.0)
    two.show(frame, fps=1000.0)
    one.close()
    two.show(frame, fps=1000.0)
    assert two.is_open
    two.close()


def test_without_pygame_the_error_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pip install 'flockenv\[render\]'") as caught:
        Window()
    assert "\n" not in str(caught.value)


# ---- files


def noise(n: int, height: int = 40, width: int = 60) -> Iterator[np.ndarray]:
    # Few colours per frame, new ones each time, and black: palettes must change and stay correct.
    draws = np.random.default_rng(0)
    for _ in range(n):
        colours = np.vstack([draws.integers(0, 256, (20, 3)), np.zeros((1, 3))]).astype(np.uint8)
        yield colours[draws.integers(0, 21, (height, width))]


def test_a_gif_holds_every_frame_and_the_whole_duration(tmp_path: Path) -> None:
    path = tmp_path / "run.gif"
    frames = list(noise(7))
    frames[0] = np.full((40, 60, 3), 255, np.uint8)  # its palette of one colour lacks the black of the next
    frames[1] = frames[0].copy()
    frames[1][:9] = 0
    frames[3:5] = [frames[2], frames[2].copy()]  # equal frames also count
    frames[4][5:9, 5:9] = 0
    assert write_gif(path, iter(frames), fps=30) == 7
    with Image.open(path) as gif:
        assert gif.n_frames == 7
        assert gif.info["loop"] == 0
        total = 0
        for k, frame in enumerate(frames):
            gif.seek(k)
            total += gif.info["duration"]
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - frame).max() <= 40
    assert total == 230  # 7/30 s in hundredths


@pytest.mark.parametrize("colours", [40, 63, 64, 200, 300])
def test_a_gif_shows_black_and_new_colours_after_frames_without_them(tmp_path: Path, colours: int) -> None:
    light = np.random.default_rng(colours).integers(150, 256, (colours, 3)).astype(np.uint8)
    frames = [light[np.arange(2400).reshape(40, 60) % colours]]
    frames += [frames[0].copy() for _ in range(2)]
    frames[1][:9], frames[2][9:20] = 0, (200, 20, 20)
    assert write_gif(tmp_path / "run.gif", iter(frames), fps=10) == 3
    with Image.open(tmp_path / "run.gif") as gif:
        for k, frame in enumerate(frames):
            gif.seek(k)
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - frame).max() <= 40


def test_a_gif_of_a_run_looks_like_the_run(tmp_path: Path) -> None:
    run = [shot([(1.0 + k, 5.0)], [(1.0, 0.0)], time=0.1 * k) for k in range(6)]
    write_gif(tmp_path / "run.gif", (draw(s, size=200) for s in run), fps=10)
    with Image.open(tmp_path / "run.gif") as gif:
        for k, one in enumerate(run):
            gif.seek(k)
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - draw(one, size=200)).max() <= 40


def test_a_gif_is_written_with_few_frames_in_memory(tmp_path: Path) -> None:
    alive: list[weakref.ref[np.ndarray]] = []
    most = 0

    def frames() -> Iterator[np.ndarray]:
        nonlocal most
        for frame in noise(40):
            alive.append(weakref.ref(frame))
            most = max(most, sum(ref() is not None for ref in alive))
            yield frame
            del frame

    write_gif(tmp_path / "long.gif", frames(), fps=20)
    assert most <= 2


@pytest.mark.parametrize("fps", [0, -1, 51, float("nan"), float("inf"), "10", True])
def test_a_gif_refuses_a_bad_rate_before_it_writes(tmp_path: Path, fps: Any) -> None:
    with pytest.raises((ValueError, TypeError), match=r"^fps: must be"):
        write_gif(tmp_path / "x.gif", noise(2), fps)
    assert not list(tmp_path.iterdir())


def test_a_failed_gif_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.gif"
    with pytest.raises(ValueError, match="at least one"):
        write_gif(path, [], 10)
    assert not list(tmp_path.iterdir())
    path.write_bytes(b"old")
    for frames, message in (
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], r"frame 1: must have the shape of frame 0"),
        ([np.zeros((4, 4, 3))], "frame 0: must be a uint8 array .* got float64 array"),
        ([np.zeros((4, 4), np.uint8)], r"frame 0: must have shape \(height, width, 3\)"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            write_gif(path, frames, 10)
        assert path.read_bytes() == b"old"
        assert list(tmp_path.iterdir()) == [path]


def test_a_png_is_the_frame(tmp_path: Path) -> None:
    frame = draw(shot(title="x"), size=120)
    write_png(tmp_path / "x.png", frame)
    assert (np.asarray(Image.open(tmp_path / "x.png")) == frame).all()


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("no/such/x.png", FileNotFoundError),
        (".", IsADirectoryError),
        ("a\0b.png", ValueError),
        ("x" * 300 + ".png", OSError),
    ],
)
def test_an_impossible_path_raises_an_error_of_one_line(tmp_path: Path, name: str, error: type[Exception]) -> None:
    with pytest.raises(error) as caught:
        write_png(tmp_path / name, draw(shot(), size=64))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_symbolic_link_is_replaced_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "outside").write_bytes(b"old")
    (tmp_path / "x.png").symlink_to(tmp_path / "outside")
    write_png(tmp_path / "x.png", draw(shot(), size=64))
    assert (tmp_path / "outside").read_bytes() == b"old"


# ---- replay


class Page(HTMLParser):
    """The tags of a file of HTML, and the texts inside them, for example of title and scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags:
            self.texts.append((self.tags[-1][0], data))

    @property
    def data(self) -> dict[str, Any]:
        (raw,) = (text for tag, text in self.texts if tag == "script" and text.startswith("{"))
        return dict(json.loads(raw))


def run(frames: int = 5, agents: int = 3, dimension: int = 2, **fields: Any) -> list[Snapshot]:
    draws = np.random.default_rng(1)
    pos, vel = (draws.uniform(-5, 5, (frames, agents, dimension)) for _ in range(2))
    given = {"low": np.full(dimension, -5.0), "high": np.full(dimension, 5.0), **fields}
    return [shot(pos[k], vel[k], time=0.1 * k, **given) for k in range(frames)]


def panel(snapshots: list[Snapshot], player: str = "rules") -> Panel:
    return Panel(player, snapshots, np.linspace(0.0, 1.0, len(snapshots)), "captured at 6.2 s")


def written(path: Path, groups: list[Group], title: str = "replay") -> Page:
    write_replay(path, groups, title)
    return Page(path.read_text(encoding="utf-8"))


def decoded(packed: dict[str, Any]) -> np.ndarray:
    low, high = np.array(packed["low"]), np.array(packed["high"])
    level = np.frombuffer(base64.b64decode(packed["pos"]), dtype="<u2")
    level = level.reshape(len(packed["time"]), len(packed["roles"]), len(low))
    return low - 0.5 * (high - low) + level / 65535 * 2.0 * (high - low)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_replay_decodes_to_the_run(tmp_path: Path, dimension: int) -> None:
    snapshots = run(frames=40, agents=7, dimension=dimension)
    (packed,) = written(tmp_path / "r.html", [Group("g", [panel(snapshots)])]).data["groups"][0]["panels"]
    pos = np.stack([s.pos for s in snapshots])
    assert np.abs(decoded(packed) - pos).max() <= 0.5 * 20.0 / 65535 + 1e-12
    heading = np.frombuffer(base64.b64decode(packed["heading"]), dtype=np.uint8).reshape(40, 7) / 254 * 2 * np.pi
    vel = np.stack([s.vel for s in snapshots])
    off = heading - np.arctan2(vel[..., 1], vel[..., 0])
    assert np.abs(np.arctan2(np.sin(off), np.cos(off))).max() <= np.pi / 254 + 1e-12
    assert packed["time"] == pytest.approx([s.time for s in snapshots])
    assert packed["reward"] == pytest.approx(np.linspace(0, 1, 40), abs=1e-5)
    assert packed["outcome"] == "captured at 6.2 s"
    assert packed["radius"] == [0.5] * 7


def test_a_replay_marks_dead_resting_and_diverged_agents(tmp_path: Path) -> None:
    pos = [(1.0, 1.0), (2.0, 2.0), (np.nan, 3.0), (1e300, -1e300)]
    one = shot(pos, [(1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], alive=[False, True, True, True])
    (packed,) = written(tmp_path / "r.html", [Group("g", [panel([one])])]).data["groups"][0]["panels"]
    assert list(base64.b64decode(packed["heading"])) == [255, 254, 255, 64]
    assert (decoded(packed)[0, 2:] == [(-5.0, -5.0), (15.0, -5.0)]).all()  # outside the view


def test_a_replay_stores_bonds_once(tmp_path: Path) -> None:
    (packed,) = written(tmp_path / "r.html", [Group("g", [panel(run(bonds=[(0, 2), (2, 1)]))])]).data["groups"][0][
        "panels"
    ]
    assert packed["bonds"] == [[0, 2], [2, 1]]
    with pytest.raises(ValueError, match="snapshot 1 must have the agents, roles, bonds"):
        panel([run(2)[0], run(2, bonds=[(0, 1)])[1]])


def test_a_snapshot_of_a_scene_has_the_edges_of_its_networks() -> None:
    cloth = Cloth(cells=(2, 1), sides=(2, 1))
    scene = Scene(
        groups=(SceneGroup(count=3, spawn=Spawn(low=(0, 0), high=(1, 1))), SceneGroup(network=cloth)), effects=()
    )
    seen = scene.snapshot(scene.start(0))
    assert {tuple(bond) for bond in seen.bonds.tolist()} == {(3, 4), (4, 5), (6, 7), (7, 8), (3, 6), (4, 7), (5, 8)}
    assert seen.has_bonds.tolist() == [False] * 3 + [True] * 6


def test_groups_of_a_scene_have_different_roles() -> None:
    kinds = [{}, {"role": "pursuer"}, {}, {}, {}, {}]
    groups = tuple(SceneGroup(count=2, spawn=Spawn(low=(0, 0), high=(9, 9)), **kind) for kind in kinds)
    shown = Scene(groups=groups).snapshot(Scene(groups=groups).start(0)).roles
    assert shown[::2] == ("agent", "pursuer", "agent 2", "agent 3", "agent 4", "agent")
    assert len({ROLE_COLOURS[role] for role in ROLES}) == len(ROLES)


def test_a_replay_of_a_scene_has_no_reward(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", [Group("boids", [Panel("", run(3), None, "")])])
    assert page.data["groups"][0]["panels"][0]["reward"] is None


def test_a_replay_stores_scenery_only_when_it_changes(tmp_path: Path) -> None:
    there = (Mark("goal", [1.0, 2.0], [0.0, 0.0], 0.5),)
    here = (Mark("heading", [0.0, 0.0], [3.0, 4.0], 0.0),)
    stone = {"obstacle_centre": [(1.0, 1.0)], "obstacle_radius": [0.25]}
    snapshots = run(6, **stone)
    snapshots = [replace(s, marks=there if k < 4 else here) for k, s in enumerate(snapshots)]
    scenery = written(tmp_path / "r.html", [Group("g", [panel(snapshots)])]).data["groups"][0]["panels"][0]["scenery"]
    assert [scene["from"] for scene in scenery] == [0, 4]
    assert scenery[0]["stones"] == [[1.0, 1.0, 0.25]]
    assert scenery[0]["marks"] == [{"kind": "goal", "at": [1.0, 2.0], "vector": [0.0, 0.0], "radius": 0.5}]
    assert scenery[1]["marks"][0]["vector"] == [0.6, 0.8]


HOSTILE = [
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "<!--<script>",
    "__DATA__",
    "\x1b[2J\u2028",
]


@pytest.mark.parametrize("name", [*HOSTILE, "\ud800", "=cmd()", '"&amp;', "🐟", "x" * 5000])
def test_a_hostile_name_adds_no_tags_to_a_replay(tmp_path: Path, name: str) -> None:
    harmless = written(tmp_path / "a.html", [Group("g", [panel(run())])])
    hostile = written(tmp_path / "b.html", [Group(name, [panel(run(), name)])], title=name)
    assert hostile.tags == harmless.tags
    # Browsers, unlike Python's parser, also end a script at "</script" and a space.
    assert (tmp_path / "b.html").read_text(encoding="utf-8").count("<") == (tmp_path / "a.html").read_text(
        encoding="utf-8"
    ).count("<")
    assert hostile.data["groups"][0]["panels"][0]["player"] == name
    assert hostile.data["groups"][0]["title"] == hostile.data["title"] == name
    assert ("title", name.replace("\ud800", "?")) in hostile.texts


def test_a_replay_is_one_file_that_loads_nothing(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", [Group("g", [panel(run())])])
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]
    assert not [attrs for _, attrs in page.tags if {"src", "href", "srcset"} & attrs.keys()]
    assert ("meta", "default-src 'none'") in [(tag, (a.get("content") or "").split(";")[0]) for tag, a in page.tags]
    program = "".join(text for tag, text in page.texts if tag in ("script", "style"))
    assert not re.search(r"https?:|url\(|@import|fetch\(|XMLHttpRequest|innerHTML|eval\(", program)


def test_panels_of_a_replay_have_one_width(tmp_path: Path) -> None:
    """One number, set on the block around all panels, is the width of each, which neither grows nor shrinks."""
    written(tmp_path / "page.html", [Group("many", [panel(run(), str(k)) for k in range(5)])])
    text = (tmp_path / "page.html").read_text()
    rules = {name.strip(): body for name, body in re.findall(r"^ +([^{}\n]+)\{([^{}]*)\}", text, re.MULTILINE)}
    assert "flex: 0 0 var(--panel, 300px)" in rules["figure"]
    sized = [name for name, body in rules.items() if re.search(r"(^|[;\s])(flex|flex-grow|(min-)?width):", body)]
    assert not [name for name in sized if re.search("figure", name) and name != "figure"]
    assert "wrap" in rules["main"] and "grid" not in rules["main"]
    assert re.findall(r"(\w+)\.style\.setProperty\(\"--panel\"", text) == ["panels"]
    assert not re.search(r"figure\.style\.(width|flex|setProperty\(\"(?!--aspect))", text)


def test_a_replay_of_three_tasks_stays_small(tmp_path: Path) -> None:
    groups = [Group(f"task {g}", [panel(run(300, 24), f"player {p}") for p in range(3)]) for g in range(3)]
    page = written(tmp_path / "r.html", groups)
    assert [len(group["panels"]) for group in page.data["groups"]] == [3, 3, 3]
    assert (tmp_path / "r.html").stat().st_size < 750_000


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Panel("p", [], [], ""), "panel 'p': must have at least one snapshot"),
        (lambda: Panel("p", run(3), [0.0], ""), r"panel 'p': must have one reward per snapshot \(3\), got 1"),
        (lambda: Panel("p", run(2), [0.0, np.nan], ""), "panel 'p': rewards must be finite, got nan"),
        (lambda: Panel("p", run(2)[::-1], [0, 0], ""), "panel 'p': times must increase, got 0.1 s then 0 s"),
        (lambda: Panel("p", [run(2)[0], run(2, 4)[1]], [0, 0], ""), "panel 'p': snapshot 1 must have the agents"),
        (lambda: Panel(3, run(1), [0], ""), "Panel.player: must be a str, got int"),  # type: ignore[arg-type]
        (lambda: Group("g", []), "group 'g': must have at least one panel"),
        (lambda: write_replay("never.html", [], "t"), "groups: there must be at least one"),
    ],
)
def test_a_bad_replay_raises_an_error_of_one_line(make: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
    assert not Path("never.html").exists()
