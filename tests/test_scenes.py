"""Scenes of configs/ in which bodies hit things: nobody overlaps or gets out, and each does what its name says."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.space import Box
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from tests.catalogue import Array

ROOT = Path(__file__).parent.parent
SECONDS = {
    "billiards": 1.0, "bouncing_balls": 3.0, "newtons_cradle": 2.0, "sphere": 2.0,
    "snow": 3.0, "stampede": 3.0, "rope_on_ball": 1.0, "cloth_on_ball": 0.7, "funnel": 1.5,
}  # fmt: skip
SLOW = (
    "sphere",
    "snow",
    "stampede",
    "rope_on_ball",
    "cloth_on_ball",
    "funnel",
)  # half a minute of compiling, or many bodies
FAST = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in SECONDS]
)
UNSOLVED = "ignore::flockenv.core.warnings.UnsolvedContactsWarning"


def scene_of(name: str) -> Scene:
    return load_scene(ROOT / "configs" / "scenes" / f"{name}.yaml")


def overlap(scene: Scene, state: State) -> float:
    """The deepest overlap of anybody with anybody or anything, in radii."""
    pos, radius = np.asarray(state.pos[0], float), np.asarray(scene.body.radius, float)
    deep = [(radius - shape.gap(pos)) / radius for shape in scene.obstacles]
    if isinstance(scene.space, Box):
        deep += [((radius[:, None] - pos) / radius[:, None]).max(axis=1)]
        deep += [((radius[:, None] + pos - scene.space.size) / radius[:, None]).max(axis=1)]
    constraint: Any = scene.constraints[0]
    if constraint.agents:
        i, j = np.array([*cKDTree(pos).query_pairs(2 * radius.max()), (0, 0)])[:-1].T
        free = np.isfinite(scene.body.mass[i]) | np.isfinite(scene.body.mass[j])
        far = np.linalg.norm(pos[i] - pos[j], axis=1)
        deep += [((radius[i] + radius[j] - far) / np.minimum(radius[i], radius[j]))[free]]
    return float(max(each.max(initial=0.0) for each in deep))


def energy(state: State, mass: Array) -> float:
    """Kinetic, J."""
    moving = np.where(np.isfinite(mass), mass, 0.0)
    return float((moving * (state.vel[0] ** 2).sum(axis=1)).sum() / 2)


@FAST
@pytest.mark.filterwarnings(UNSOLVED)
def test_in_no_scene_does_anybody_overlap_or_get_out(name: str) -> None:
    """Less than 5 % of the radius, which is what case N23 allows."""
    scene = scene_of(name)
    state, worst = scene.start(0), 0.0
    every = max(1, round(0.05 / scene.dt))
    for _ in range(round(SECONDS[name] / scene.dt / every)):
        state = scene.step(state, steps=every)
        worst = max(worst, overlap(scene, state))
    assert worst < 0.05
    assert state.counted("impacts") > 0
    assert (state.counted("unsolved") > 0) == (name == "funnel"), "its file says so"


@pytest.mark.slow
def test_particles_in_a_sphere_keep_their_energy() -> None:
    scene = scene_of("sphere")
    start = scene.start(1)
    end = scene.run(start, 100)
    assert end.counted("impacts") > 300
    assert energy(end, scene.body.mass) == pytest.approx(energy(start, scene.body.mass), rel=1e-12)


@pytest.mark.filterwarnings(UNSOLVED)
@pytest.mark.parametrize("apart", [0.201, 0.2])
def test_newtons_cradle_passes_everything_on(apart: float) -> None:
    """Also where balls touch: they tremble there until they rest, and what comes from outside goes through them.

    One after another swings out as far as the first, and those between stay; before, the third impact took half of it.
    """
    scene = scene_of("newtons_cradle")
    k = np.arange(5) - 2
    state = scene.start(0)
    pos = np.array(state.pos)
    pos[0, ::2, 0] += k * (apart - 0.201)
    pos[0, 1::2, 0] += k * (apart - 0.201)
    state = state.with_motion(pos, state.vel)
    ways = []
    for _ in range(3300):
        state = scene.step(state)
        ways.append(state.pos[0, 1::2, 0] - pos[0, ::2, 0])
    way = np.array(ways)
    assert way[:, 0].min() == pytest.approx(-np.sqrt(0.5), abs=1e-3)
    assert way[:1500, 4].max() == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert way[1500:2500, 0].min() == pytest.approx(-np.sqrt(0.5), abs=1e-3)
    assert way[2500:, 4].max() == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert np.abs(way[:, 1:4]).max() < 0.01


@pytest.mark.slow
@pytest.mark.filterwarnings(UNSOLVED)
@pytest.mark.parametrize(("name", "seconds", "apart"), [("rope_on_ball", 4.0, 0.08), ("cloth_on_ball", 2.0, 0.04)])
def test_where_it_folds_a_rope_or_a_cloth_keeps_off_itself(name: str, seconds: float, apart: float) -> None:
    """Those whom no spring ties to each other; without the push between them they come as near as 2 mm and less."""
    scene = scene_of(name)
    network: Any = scene.groups[0].network
    springs = network.springs(scene.dimension)
    tied = {(int(i), int(j)) for i, j in zip(springs.i, springs.j, strict=True)}
    state, nearest = scene.start(0), np.inf
    for _ in range(round(seconds / scene.dt / 20)):
        state = scene.step(state, steps=20)
        pos = state.pos[0]
        for i, j in cKDTree(pos).query_pairs(0.1) - tied:
            nearest = min(nearest, float(np.linalg.norm(pos[i] - pos[j])))
    assert apart < nearest < 0.1
    assert state.counted("unsolved") == 0


def test_the_page_of_scenes_has_a_picture_and_a_command_for_each() -> None:
    page = (ROOT / "docs" / "scenes.md").read_text()
    for name in (*SECONDS, "fountain", "fireworks"):
        assert re.search(rf"flockenv render configs/scenes/{name}\.yaml .*--out docs/scenes/{name}\.png", page)
        assert f"scenes/{name}.png" in page
        assert 1000 < (ROOT / "docs" / "scenes" / f"{name}.png").stat().st_size < 150_000


@pytest.mark.slow
def test_the_funnel_says_how_much_its_heap_leaves_unsolved() -> None:
    """More than once in two steps, as its file says; but little: discs hardly overlap, nor go into each other."""
    scene = scene_of("funnel")
    state, deep, rows = scene.start(0), 0.0, round(1.5 / scene.dt) // 20
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnsolvedContactsWarning)
        for _ in range(rows):
            state = scene.run(state, 20)
            deep = max(deep, overlap(scene, state))
    assert 20 * rows / 2 < state.counted("unsolved") < 20 * rows
    assert deep < 0.03
    (told,) = (str(each.message) for each in caught)
    said = re.search(r"; the deepest overlap is ([\d.e-]+) of a radius$", told)
    assert said and float(said[1]) < 0.03
