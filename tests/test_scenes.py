"""Scenes of configs/ with collisions: no body overlaps another or escapes, and each shows what its file describes."""

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
from flockenv.model.networks import EDGE
from flockenv.model.state import State
from flockenv.model.surface import faces_of
from flockenv.physics.integrators import SemiImplicitEuler
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from tests.catalogue import Array
from tests.exact_crossings import crossings
from tests.test_corotated import volumes

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
)  # they compile for half a minute or have many bodies
PICTURES = (
    "fountain", "fireworks", "drop", "waterfall", "fire", "smoke", "draped_cloth", "torn_paper", "jelly_on_stairs",
    "dice", "flag", "curtain",
)  # fmt: skip
UNSOLVED = pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")
FAST = pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=[*([pytest.mark.slow] if name in SLOW else []), *([UNSOLVED] if name == "funnel" else [])]
        )
        for name in SECONDS
    ],
)


def scene_of(name: str) -> Scene:
    return load_scene(ROOT / "configs" / "scenes" / f"{name}.yaml")


def overlap(scene: Scene, state: State) -> float:
    """Return the deepest overlap of a body with another, an obstacle or the box, in radii."""
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
    """Return the kinetic energy, J."""
    moving = np.where(np.isfinite(mass), mass, 0.0)
    return float((moving * (state.vel[0] ** 2).sum(axis=1)).sum() / 2)


@FAST
def test_no_body_overlaps_or_escapes_by_more_than_5_percent_of_its_radius(name: str) -> None:
    """The bound is that of case N23."""
    scene = scene_of(name)
    state, worst = scene.start(0), 0.0
    every = max(1, round(0.05 / scene.dt))
    for _ in range(round(SECONDS[name] / scene.dt / every)):
        state = scene.step(state, steps=every)
        worst = max(worst, overlap(scene, state))
    assert worst < 0.05
    assert state.count_of("impacts") > 0
    assert (state.count_of("unsolved") > 0) == (name == "funnel"), "only funnel.yaml announces unsolved contacts"


@pytest.mark.slow
def test_particles_in_a_sphere_keep_their_energy() -> None:
    scene = scene_of("sphere")
    start = scene.start(1)
    end = scene.run(start, 100)
    assert end.count_of("impacts") > 300
    assert energy(end, scene.body.mass) == pytest.approx(energy(start, scene.body.mass), rel=1e-12)


@pytest.mark.parametrize("apart", [0.201, 0.2])
def test_newtons_cradle_passes_on_the_whole_impulse(apart: float) -> None:
    """Impulses also pass through touching balls: the outer balls swing to the same height, and the inner ones rest."""
    scene = scene_of("newtons_cradle")
    k = np.arange(5) - 2
    state = scene.start(0)
    pos = np.array(state.pos)
    pos[0, ::2, 0] += k * (apart - 0.201)
    pos[0, 1::2, 0] += k * (apart - 0.201)
    state = state.with_motion(pos, state.vel)
    offsets = []
    for _ in range(3300):
        state = scene.step(state)
        offsets.append(state.pos[0, 1::2, 0] - pos[0, ::2, 0])
    offset = np.array(offsets)
    assert offset[:, 0].min() == pytest.approx(-np.sqrt(0.5), abs=1e-3)
    assert offset[:1500, 4].max() == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert offset[1500:2500, 0].min() == pytest.approx(-np.sqrt(0.5), abs=1e-3)
    assert offset[2500:, 4].max() == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert np.abs(offset[:, 1:4]).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seconds", "apart"), [("rope_on_ball", 4.0, 0.08), ("cloth_on_ball", 2.0, 0.04)])
def test_folds_of_a_rope_or_cloth_keep_their_distance(name: str, seconds: float, apart: float) -> None:
    """Particles without a common spring are compared; without their repulsion they come as near as 2 mm or less."""
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
    assert state.count_of("unsolved") == 0


def test_the_page_of_scenes_has_a_picture_and_a_command_for_each_scene() -> None:
    page = (ROOT / "docs" / "scenes.md").read_text()
    for name in (*SECONDS, *PICTURES):
        assert re.search(rf"flockenv render {name} .*--out docs/scenes/{name}\.png", page)
        assert f"scenes/{name}.png" in page
        assert 1000 < (ROOT / "docs" / "scenes" / f"{name}.png").stat().st_size < 150_000


@pytest.mark.slow
def test_the_funnel_warns_of_unsolved_contacts_with_small_overlaps() -> None:
    """More than half of the steps are unsolved, as its file announces."""
    scene = scene_of("funnel")
    state, deep, rows = scene.start(0), 0.0, round(1.5 / scene.dt) // 20
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnsolvedContactsWarning)
        for _ in range(rows):
            state = scene.run(state, 20)
            deep = max(deep, overlap(scene, state))
    assert 20 * rows / 2 < state.count_of("unsolved") < 20 * rows
    assert deep < 0.03
    (message,) = (str(each.message) for each in caught)
    found = re.search(r"; the deepest overlap is ([\d.e-]+) of a radius$", message)
    assert found and float(found[1]) < 0.03


@pytest.mark.slow
def test_a_sheet_of_paper_tears_around_a_ball_and_stays_bent() -> None:
    scene = scene_of("torn_paper")
    end = scene.run(scene.start(0), round(1.2 / scene.dt))
    network: Any = scene.groups[0].network
    first, rest = network.springs(3).rest, np.asarray(end.bonds[0])
    broken, longer = np.isinf(rest), rest > 1.02 * first
    assert 0.01 < broken.mean() < 0.1
    assert (longer & ~broken).mean() > 0.01  # they yielded
    middle = np.linalg.norm(network.points(3) - (2.1, 2.2, 2.0), axis=1) < 0.3
    assert np.abs(end.pos[0, middle, 2] - 2.0).max() > 0.5  # torn off, or bent out of the sheet
    assert np.abs(end.pos[0, :41, 2] - 2.0).max() == 0  # the frame holds


@pytest.mark.slow
def test_a_stiff_curtain_is_drawn_with_small_strains_at_60_steps_a_second() -> None:
    scene = scene_of("curtain")
    network: Any = scene.groups[0].network
    springs, state, top = network.springs(3), scene.start(0), slice(540, 567)
    i, j, rest = (each[springs.role == EDGE] for each in springs[:3])
    for _ in range(20):
        state = scene.step(state, steps=30)
        strain = np.linalg.norm(state.pos[0, i] - state.pos[0, j], axis=1) / rest - 1
        assert strain.min() > -0.002 and 0.004 < strain.max() < 0.01
        assert np.abs(state.vel).max() < 2
    np.testing.assert_allclose(state.pos[0, [540, 553, 566], 0], [0, 1.5 - 0.045 * 10, 3 - 0.09 * 10], atol=1e-9)
    assert (state.pos[0, top] @ (0, 0.8, 0.6)).min() < 2.4 - 0.2  # it sags between the hooks
    with pytest.raises(ValueError, match=r"at most 3\.3\d*e-05 s is stable"):
        scene.model_copy(update={"integrator": SemiImplicitEuler()})


@pytest.mark.slow
def test_a_jelly_tumbles_down_the_stairs_and_keeps_its_volume() -> None:
    scene = scene_of("jelly_on_stairs")
    state, turned = scene.start(0), 0.0
    for _ in range(30):
        state = scene.step(state, steps=100)
        assert overlap(scene, state) < 0.05
        side = state.pos[0, 4] - state.pos[0, 0]
        turned = max(turned, abs(float(np.degrees(np.arctan2(side[1], side[0])))))
    assert turned > 60
    assert state.pos[0].mean(axis=0)[0] > 3.5  # beyond the last step
    assert (volumes(scene, state) > 0).all()
    assert volumes(scene, state).mean() == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_thrown_dice_come_to_rest_on_their_faces() -> None:
    scene = scene_of("dice")
    up = np.array((0, 0.8, 0.6))
    state, lowest = scene.start(0), np.inf
    for _ in range(100):
        state = scene.step(state, steps=10, out=state)
        lowest = min(lowest, float((state.pos[0] @ up).min()) - 0.088)
    assert lowest > -1e-4 and state.count_of("unsolved") == 0
    assert np.abs(state.vel).max() < 1e-9
    np.testing.assert_allclose((state.pos[0].reshape(7, 9, 3)[:, 8] @ up) - 0.088, 0.008, atol=1e-6)


@pytest.mark.slow
def test_no_vertex_passes_a_face_while_two_sheets_drape_over_a_ball() -> None:
    """Each step is checked by exact predicates."""
    scene = scene_of("draped_cloth")
    faces, state, ball = faces_of(scene), scene.start(0), scene.obstacles[0]
    for _ in range(300):
        before = np.array(state.pos[0])
        state = scene.step(state)
        assert crossings(before, np.array(state.pos[0]), faces) == []
        assert ball.gap(np.asarray(state.pos[0], float)).min() > 0
    assert state.pos[0].mean(axis=0)[1] < 1.5  # it fell
    assert state.count_of("unsolved") == 0
