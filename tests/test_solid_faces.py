"""Large shows of solid faces, each step checked exactly: sheets draped on a ball and pulled off; a knot, tightened."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockenv.geometry.shapes import Circle
from flockenv.model.networks import Jelly, Mesh
from flockenv.model.state import State
from flockenv.model.surface import faces_of
from flockenv.physics.constraints import FaceCollisions
from flockenv.physics.effects import Bending, Membrane, Springs
from flockenv.physics.integrators import LinearlyImplicitEuler
from flockenv.scene import Group, Scene
from tests.catalogue import Array
from tests.exact_crossings import crossings
from tests.test_face_collisions import EFFECTS, energy, scene_of, sheet

pytestmark = pytest.mark.slow


def total_energy(scene: Scene, state: State) -> float:
    """Return the energy of motion and height of free particles, and of springs and triangles, J."""
    stored = 0.0
    for effect in scene.effects:
        if not isinstance(effect, Springs | Membrane | Bending):
            continue
        found = effect.potential(scene.groups, state, scene.space.displacement)
        assert found is not None
        stored += float(found[0])
    free = np.isfinite(scene.body.mass)
    return energy(state, scene) + 9.81 * float(scene.body.mass[free] @ state.pos[0, free, 2]) + stored


def pull(scene: Scene, state: State, steps: int, force: Array) -> State:
    """Return the state after some steps under a force, (N, 3) N; check crossings and the energy of each step."""
    faces, work, most = faces_of(scene), 0.0, total_energy(scene, state)
    for step in range(steps):
        before = np.array(state.pos[0])
        state = scene.step(state, force[None], out=state)
        after = np.array(state.pos[0])
        assert crossings(before, after, faces) == [], f"step {step}"
        work += float((force * (after - before)).sum())
        assert total_energy(scene, state) <= most + work, f"step {step}"
    assert state.count_of("unsolved") == state.count_of("stopped") == 0
    return state


def test_two_sheets_drape_on_a_ball_and_are_pulled_off_without_a_crossing() -> None:
    """The lower one has 40 x 40 cells; the upper one is held until that is draped. Then each is pulled by an edge."""
    groups = sheet(40, 1.2, (-0.6, -0.6, 0.22)), sheet(12, 0.5, (-0.24, -0.26, 0.25))
    scene = Scene(
        dimension=3, groups=groups, dt=0.005, integrator=LinearlyImplicitEuler(),
        effects=(*EFFECTS, Springs(group=1, stiffness=200.0, shear=50.0, bend=1.0, ratio=0.1)),
        constraints=(FaceCollisions(friction=0.3, thickness=0.005),), obstacles=(Circle(centre=(0, 0, 0), radius=0.2),),
    )  # fmt: skip
    state, lower, upper = scene.start(0), slice(groups[0].size), slice(groups[0].size, None)
    force = np.zeros((scene.agents, 3))
    force[upper, 2] = 9.81 * scene.body.mass[upper]
    state = pull(scene, state, 60, force)
    assert state.pos[0, lower, 2].min() < -0.1 and np.abs(state.pos[0, upper, 2] - 0.25).max() < 1e-9
    force[:] = 0
    state = pull(scene, state, 60, force)
    draped = np.array(state.pos[0])
    assert draped[lower, 2].min() < -0.3 and draped[upper, 2].max() > 0.2 and draped[upper, 2].min() < 0

    start = scene.start(0).pos[0]
    east, west = np.isclose(start[lower, 0], 0.6), np.isclose(start[upper, 0], -0.24)
    force[lower][east], force[upper][west] = (0.4, 0, 0.4), (-0.3, 0, 0.3)
    state = pull(scene, state, 60, force)
    moved = state.pos[0] - draped
    assert moved[lower, 0].mean() > 0.2 and moved[upper, 0].mean() < -0.2


def test_a_sheet_of_triangles_drapes_on_a_ball_without_a_crossing() -> None:
    effects = (EFFECTS[0], Membrane(stretch=2e3, shear=500.0, damping=0.02), Bending(stiffness=0.01, damping=0.02))
    scene = Scene(
        dimension=3, groups=(sheet(8, 1.0, (-0.5, -0.5, 0.45)),), effects=effects, integrator=LinearlyImplicitEuler(),
        constraints=(FaceCollisions(friction=0.4, thickness=0.01),), obstacles=(Circle(centre=(0, 0, 0), radius=0.4),),
        dt=0.005,
    )  # fmt: skip
    place = pull(scene, scene.start(0), 200, np.zeros((scene.agents, 3))).pos[0]
    assert np.linalg.norm(place, axis=1).min() > 0.4 and place[:, 2].min() < 0 and place[:, 2].max() > 0.4


def knotted_strip() -> Group:
    """Return a strip of 2.7 m along a trefoil knot that is cut open at its outermost place: an overhand knot."""
    t = math.pi / 3 + np.linspace(0.2, 2 * np.pi - 0.2, 81)
    curve = 0.1 * np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    side = np.cross(np.gradient(curve, axis=0), [0.0, 0.0, 1.0])
    side *= 0.04 / np.linalg.norm(side, axis=1)[:, None]
    place = curve[:, None] + np.linspace(-0.5, 0.5, 3)[:, None] * side[:, None]
    ids = np.arange(len(t) * 3).reshape(-1, 3)
    a, b, c, d = (ids[p, q].ravel() for p in (slice(-1), slice(1, None)) for q in (slice(-1), slice(1, None)))
    triangles = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    vertices = tuple(map(tuple, place.reshape(-1, 3).tolist()))
    return Group(network=Mesh(vertices=vertices, triangles=tuple(map(tuple, triangles.tolist()))), mass=0.0015)


def ends_pulled(group: Group) -> Array:
    """Return forces, (N, 3) N, on the corners of both ends: outwards, and apart."""
    force = np.zeros((group.size, 3))
    force[:3], force[-3:] = (0.03, 0.3, 0.0), (0.27, -0.12, 0.0)
    return force


def test_a_knot_is_tightened_for_1000_steps_without_a_crossing() -> None:
    scene = scene_of(knotted_strip(), dt=0.001)
    state = pull(scene, scene.start(0), 1000, ends_pulled(scene.groups[0]))
    assert np.linalg.norm(state.pos[0, 0] - state.pos[0, -1]) > 1.0
    assert state.count_of("impacts") > 0


def test_that_knot_passes_through_itself_without_solid_faces() -> None:
    scene = scene_of(knotted_strip(), dt=0.001, constraints=())
    with pytest.raises(AssertionError, match=r"(?s)step .*== \[\]"):
        pull(scene, scene.start(0), 500, ends_pulled(scene.groups[0]))


def test_a_jelly_dropped_on_a_jelly_touches_it_by_its_surface_only() -> None:
    """Particles inside collide with nothing; no corner or edge of either passes a face of the other."""
    lower = Group(network=Jelly(cells=(3, 3, 2), sides=(0.6, 0.6, 0.4), pinned=("bottom",)), mass=0.05)
    upper = Group(network=Jelly(cells=(2, 2, 2), origin=(0.13, 0.21, 0.45), sides=(0.3, 0.3, 0.3)), mass=0.05)
    springs = Springs(group=1, stiffness=200.0, shear=50.0, bend=1.0, ratio=0.1)
    scene = scene_of(lower, upper, dt=0.002).model_copy(update={"effects": (*EFFECTS, springs)})
    inside = np.setdiff1d(np.arange(scene.agents), faces_of(scene))
    assert len(inside) == 2 * 2 * 1 + 1
    state = pull(scene, scene.start(0), 250, np.zeros((scene.agents, 3)))
    assert 0.35 < state.pos[0, lower.size :, 2].min() < 0.45
