"""Solid faces: nothing passes through cloth, by an exact check of every step; momentum, energy, bits and refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.box_tree import build_tree, overlapping_pairs
from flockenv.geometry.mesh_checks import first_piercing
from flockenv.geometry.shapes import Block, Capsule, Circle, DistanceField, HalfSpace, Sway, TriangleMesh, Wall
from flockenv.geometry.space import Torus
from flockenv.model.networks import Blocks, Cloth, Jelly, Mesh, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.model.surface import faces_of
from flockenv.physics.constraints import Collisions, FaceCollisions, RigidBodies, Rods
from flockenv.physics.constraints.face_obstacles import solids_of
from flockenv.physics.effects import Drag, Gravity, Springs
from flockenv.scene import Group, Scene
from tests.exact_crossings import crossings

EFFECTS = (
    Gravity(acceleration=(0, 0, -9.81)), Springs(stiffness=200.0, shear=50.0, bend=1.0, ratio=0.1), Drag(rate=0.002),
)  # fmt: skip
SOLID = FaceCollisions(friction=0.3)


def sheet(cells: int, side: float, at: tuple[float, float, float], **more: Any) -> Group:
    """Return a square sheet, horizontal, of 1 kg/m^2."""
    cloth = Cloth(cells=(cells, cells), origin=at, sides=(side, side), **more)
    return Group(network=cloth, mass=side**2 / cloth.size, radius=0.02)


def ball(radius: float, place: tuple[float, float, float], mass: float = 0.1) -> Group:
    return Group(count=1, mass=mass, radius=radius, spawn=Spawn(low=place, high=place))


def scene_of(*groups: Group, constraints: Any = (SOLID,), dt: float = 0.004, **more: Any) -> Scene:
    """Return a scene in gravity; all of them share one kernel per set of obstacles."""
    return Scene(dimension=3, groups=groups, effects=EFFECTS, constraints=constraints, dt=dt, **more)


def run(scene: Scene, seconds: float, check: bool = True) -> State:
    """Return the state after some time; check each step with the exact predicates."""
    state, faces = scene.start(0), faces_of(scene)
    for _ in range(round(seconds / scene.dt)):
        before = np.array(state.pos[0])
        state = scene.step(state, out=state)
        if check:
            assert crossings(before, np.array(state.pos[0]), faces) == []
    return state


def random_motion(scene: Scene, speed: float, worlds: int = 1) -> State:
    """Return a state with independent random velocities of all particles."""
    start = scene.start(0, worlds=worlds)
    vel = np.random.default_rng(3).normal(0, speed, start.vel.shape)
    return start.with_motion(start.pos, vel)


def energy(state: State, scene: Scene) -> float:
    """Return the kinetic energy of free particles, J."""
    mass = np.where(np.isfinite(scene.body.mass), scene.body.mass, 0)
    return float((0.5 * mass[:, None] * state.vel[0] ** 2).sum())


# --- P9: what passed through ----------------------------------------------------------------------------------------


WITH_PARTICLES = pytest.param((Collisions(agents=False), SOLID), id="with_collisions", marks=pytest.mark.slow)


@pytest.mark.parametrize("constraints", [(SOLID,), WITH_PARTICLES])
def test_a_ball_dropped_on_a_pinned_sheet_stays_above_it(constraints: Any) -> None:
    """Without solid faces it falls through the cell that it hits."""
    groups = sheet(4, 2.0, (0, 0, 0), pinned=("border",)), ball(0.05, (0.9, 1.13, 0.2))
    assert run(scene_of(*groups, constraints=constraints[:-1]), 1.0, check=False).pos[0, -1, 2] < -2
    scene = scene_of(*groups, constraints=constraints)
    state, lowest = scene.start(0), 1.0
    for _ in range(250):
        state = scene.step(state, out=state)
        place = np.array(state.pos[0])
        assert crossings(place, place, faces_of(scene), points=np.arange(scene.agents)) == []
        lowest = min(lowest, float(place[-1, 2]))
    assert -0.6 < lowest < 0.05


def test_of_two_sheets_none_passes_the_other() -> None:
    """The upper one is shifted by half a cell; without solid faces all its particles fall through."""
    groups = sheet(8, 1.6, (0, 0, 0), pinned=("border",)), sheet(7, 1.4, (0.1, 0.1, 0.05))
    without = run(scene_of(*groups, constraints=()), 0.6, check=False)
    assert without.pos[0, 81:, 2].max() < -0.5
    state = run(scene_of(*groups), 0.6)
    assert state.pos[0, 81:, 2].min() > -0.5
    assert state.count_of("unsolved") == state.count_of("stopped") == 0


POLES = (
    Circle(centre=(0.6, 0.6, -0.1), radius=0.04), Capsule(start=(0.6, -1, -0.1), end=(0.6, 2, -0.1), radius=0.04),
    Block(centre=(0.6, 0.62, -0.1), size=(0.08, 0.08, 0.08), turn=45, axis=(1, 1, 0)),
)  # fmt: skip


@pytest.mark.parametrize("pole", POLES)
def test_a_pole_thinner_than_a_cell_holds_a_sheet(pole: Any) -> None:
    """Not tested against obstacles, faces let the pole through the middle of a cell, and the sheet falls."""
    group = sheet(5, 1.25, (0, 0, 0))
    without = run(scene_of(group, constraints=(FaceCollisions(obstacles=False),), obstacles=(pole,)), 0.5, check=False)
    assert without.pos[0, :, 2].max() < -0.5
    state = run(scene_of(group, obstacles=(pole,)), 0.5)
    assert state.pos[0, :, 2].max() > -0.3


@pytest.mark.parametrize("share", [0.97, 1.03, 1.5])
def test_a_sheet_rests_on_an_incline_up_to_the_angle_of_friction(share: float) -> None:
    """On a pinned sheet of slope share mu it rests, or slides with g (sin - mu cos)."""
    angle = math.atan(share * 0.3)
    slope = Gravity(acceleration=(9.81 * math.sin(angle), 0, -9.81 * math.cos(angle)))
    groups = sheet(2, 0.4, (0.05, 0.03, 0.011)), sheet(2, 2.0, (-0.5, -0.5, 0), pinned=tuple(range(9)))
    scene = scene_of(*groups, constraints=(FaceCollisions(friction=0.3, thickness=0.01),))
    scene = scene.model_copy(update={"effects": (slope, *EFFECTS[1:2], Drag(rate=0.0))})
    early = scene.step(scene.start(0), steps=50)
    late = scene.step(early, steps=50)
    gained = np.subtract(late.vel[0, :9], early.vel[0, :9])
    assert np.abs(late.pos[0, :9, 2] - 0.01).max() < 1e-6
    if share < 1:
        assert np.abs(late.pos[0, :9] - early.pos[0, :9]).max() < 1e-9 and np.abs(late.vel[0, :9]).max() < 1e-9
    else:
        drive, friction = 9.81 * math.sin(angle) * 50 * scene.dt, 0.3 * 9.81 * math.cos(angle) * 50 * scene.dt
        np.testing.assert_allclose(gained, np.tile([drive - friction, 0, 0], (9, 1)), rtol=0, atol=0.02 * friction)


RISING = (
    Circle(centre=(0.6, 0.62, -0.3), radius=0.04, velocity=(0, 0, 2)),
    Capsule(start=(0.6, -1, -0.3), end=(0.6, 2, -0.3), radius=0.04, velocity=(0, 0, 2)),
    Block(
        centre=(0.6, 0.62, -0.3), size=(0.08, 0.08, 0.08), turn=45, axis=(1, 1, 0), velocity=(0, 0, 2),
        sway=Sway(amplitude=(0.02, 0, 0), period=0.1),
    ),
    TriangleMesh(
        vertices=((0.6, 0.62, -0.3), (0.62, 0.62, -0.36), (0.58, 0.65, -0.36), (0.58, 0.6, -0.36)), velocity=(0, 0, 2),
        triangles=((0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)), spacing=0.005, margin=0.03,
    ),
)  # fmt: skip


@pytest.mark.parametrize("pole", RISING, ids=[pole.kind for pole in RISING])
def test_a_sheet_is_lifted_by_an_obstacle_that_rises(pole: Any) -> None:
    """Rising at 2 m/s it meets the falling sheet, and is smaller than a cell. Nothing of it passes a face."""
    scene = scene_of(sheet(5, 1.25, (0, 0, 0)), obstacles=(pole,))
    state, solids, n = scene.start(0), solids_of(scene.obstacles), scene.agents
    faces = np.concatenate([faces_of(scene), solids.faces + n])
    points = np.arange(n + len(solids.place))

    def places(state: State) -> Any:
        return np.concatenate([state.pos[0], solids.place + pole.shift(float(state.time[0]))])

    for _ in range(150):
        before = places(state)
        state = scene.step(state, out=state)
        assert crossings(before, places(state), faces, points) == []
    assert state.pos[0, :, 2].max() > pole.anchor[2] + pole.shift(0.6)[2]
    assert state.count_of("unsolved") == 0


def test_a_sheet_between_two_obstacles_that_close_is_reported() -> None:
    """No motion of the sheet avoids both, so particles cannot be kept out of them."""
    jaws = [Block(centre=(0.6, 0.6, z), size=(0.5, 0.5, 0.2), velocity=(0, 0, -4 * z)) for z in (-0.25, 0.25)]
    scene = scene_of(sheet(5, 1.25, (0, 0, 0)), obstacles=tuple(jaws))
    with pytest.warns(UnsolvedContactsWarning, match="touched from its start"):
        run(scene, 0.2, check=False)


def test_a_torn_face_is_no_longer_solid() -> None:
    """A ball falls on the middle of a sheet in two worlds of a batch; in the second the springs there are broken."""
    group = sheet(4, 2.0, (0, 0, 0), pinned=("border",))
    springs = Springs(stiffness=200.0, break_strain=9.0)
    scene = Scene(
        dimension=3, groups=(group, ball(0.05, (0.9, 1.13, 0.2))), effects=(springs,), constraints=(SOLID,), dt=0.004
    )
    state = scene.start(0, worlds=2)
    middle = scene.edge_springs[(scene.edges == 12).any(axis=1)]
    state.bonds[1, middle] = np.inf
    assert (scene.view.snapshot(state, 1).whole_faces != 12).all()
    settle, x0, v0 = SOLID.settler(scene), state.x.copy(), state.v.copy()
    state.x[2, :, -1], state.v[2, :, -1] = -0.2, -80.0
    assert settle(x0, v0, state, 0, 2) == (-1, -1)
    assert state.x[2, 0, -1] > -0.1  # it pushes the sheet down
    assert state.x[2, 1, -1] == -0.2 and state.v[2, 1, -1] == -80


# --- what holds in every step ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("passes", [1, 20])
def test_nothing_crosses_and_momentum_is_kept_by_impulses_and_zones(passes: int) -> None:
    """Two sheets, 2 cm apart, whose particles move at random with 10 m/s: 4 cm a step. Energy only decreases."""
    groups = sheet(5, 1.0, (0, 0, 0)), sheet(5, 1.0, (0.1, 0.1, 0.02))
    effects: Any = (Gravity(acceleration=(0, 0, 0.0)), *EFFECTS[1:2], Drag(rate=0.0))
    scene = scene_of(*groups, constraints=(FaceCollisions(friction=0.3, passes=passes),)).model_copy(
        update={"effects": effects}
    )
    state, mass = random_motion(scene, 10.0), np.asarray(scene.body.mass)
    total = mass @ state.vel[0]
    for _ in range(20):
        before = np.array(state.pos[0])
        state = scene.step(state, out=state)
        assert crossings(before, np.array(state.pos[0]), faces_of(scene)) == []
        assert np.abs(mass @ state.vel[0] - total).max() < 1e-12 * mass.sum() * 10
    assert state.count_of("impacts") > 0
    assert (state.count_of("impact_zones") > 0) == (state.count_of("largest_zone") > 1)
    if passes == 1:
        assert state.count_of("impact_zones") > 0
    assert state.count_of("face_passes") > 20  # with passes = 1 those over zones


def test_impulses_never_add_kinetic_energy() -> None:
    scene = scene_of(sheet(5, 1.0, (0, 0, 0)), sheet(5, 1.0, (0.1, 0.1, 0.02)), constraints=(SOLID,))
    free = scene.model_copy(update={"constraints": ()})
    state = random_motion(scene, 5.0)
    for _ in range(20):
        loose, state = free.step(state), scene.step(state)
        assert energy(state, scene) <= energy(loose, scene) * (1 + 1e-12)


def test_the_check_finds_what_passes_through() -> None:
    """The check itself: it sees a crossing if faces are not solid."""
    scene = scene_of(sheet(2, 1.0, (0, 0, 0)), sheet(2, 1.0, (0.1, 0.13, 0.02)), constraints=())
    state = random_motion(scene, 10.0)
    after = scene.step(state)
    assert crossings(np.array(state.pos[0]), np.array(after.pos[0]), faces_of(scene))


def test_a_row_of_a_batch_has_the_bits_of_that_world_alone() -> None:
    scene = scene_of(sheet(3, 1.0, (0, 0, 0)), sheet(3, 1.0, (0.1, 0.1, 0.02)))
    start = random_motion(scene, 5.0, worlds=3)
    batch = scene.step(start, steps=20)
    assert batch.count_of("impacts") > 0
    for row in range(3):
        alone = scene.step(start.worlds([row]), steps=20)
        assert alone.digest == batch.worlds([row]).digest
        assert (alone.work == batch.work[row]).all()


def test_a_scene_without_contacts_keeps_its_bits() -> None:
    scene = scene_of(sheet(3, 1.0, (0, 0, 0)))
    with_faces, without = (
        scene.step(scene.start(0), steps=10),
        scene.model_copy(update={"constraints": ()}).step(scene.start(0), steps=10),
    )
    assert with_faces.digest == without.digest
    assert with_faces.count_of("face_passes") == 10 and with_faces.count_of("impacts") == 0  # one look per step


# --- meshes and refusals --------------------------------------------------------------------------------------------


def test_the_surface_of_a_jelly_is_its_faces() -> None:
    """Two triangles on each square of the sides of the box: 2 (2 + 3 + 2 + 6 + 3 + 6)... of 1 x 2 x 3 cells: 44."""
    group = Group(network=Jelly(cells=(1, 2, 3), sides=(1, 2, 3)))
    faces = faces_of(scene_of(group))
    assert len(faces) == 2 * 2 * (1 * 2 + 2 * 3 + 1 * 3)


def test_the_tree_finds_the_boxes_that_overlap() -> None:
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 1, (37, 3))
    boxes = np.concatenate([low, low + 0.2], axis=1)
    tree = build_tree(low)
    leaves = len(tree.order)
    tree.box[leaves - 1 + tree.leaf] = boxes
    for k in range(leaves - 2, -1, -1):
        below = tree.box[2 * k + 1 : 2 * k + 3]
        tree.box[k] = np.concatenate([below[:, :3].min(axis=0), below[:, 3:].max(axis=0)])
    found = set(zip(*(a.tolist() for a in overlapping_pairs(tree, boxes)), strict=True))
    meet = (boxes[:, None, :3] <= boxes[None, :, 3:]).all(axis=2)
    assert found == set(map(tuple, np.argwhere(meet & meet.T).tolist()))


CROSSED = Mesh(
    vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0.2, 0.2, -0.5), (0.2, 0.2, 0.5), (2, 2, 0.5)),
    triangles=((0, 1, 2), (3, 4, 5)),
)
FLOOR = HalfSpace(point=(0, 0, -1), direction=(0, 0, 1))
FIELD = DistanceField(low=(-1, -1, -1), high=(1, 1, 1), spacing=0.5, shapes=(POLES[0],))
HUGE = Block(centre=(0.5, 0.05, 0), size=(9, 9, 9))
SMALL = Circle(centre=(0.1, 0.2, 0.015), radius=0.02)
"""It is between the particles of a face, and above it, but for 5 mm."""
BESIDE = Circle(centre=(0.5, 0.5, 0.21), radius=0.2)
LEVEL = Capsule(start=(0.2, 0.7, 0.04), end=(0.3, 0.7, 0.04), radius=0.05)
POLE = Capsule(start=(0.6, 0.7, -1), end=(0.6, 0.7, 1), radius=0.01)
FLAT = Mesh(
    vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0.1, 0.1, 0), (2, 0.1, 0), (0.1, 2, 0)),
    triangles=((0, 1, 2), (3, 4, 5)),
)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"dimension": 2, "groups": (Group(network=Cloth(cells=(2, 2), sides=(1, 1))),)}, "in 3 dimensions only"),
        ({"groups": (Group(network=Rope(links=3, length=1.0)),)}, "no group has a network with faces"),
        ({"groups": (ball(0.1, (0, 0, 0)),)}, "no group has a network with faces"),
        ({"space": Torus(size=(9, 9, 9))}, "do not wrap around a torus"),
        ({"dtype": "float32"}, "float32"),
        ({"constraints": (SOLID, FaceCollisions())}, "at most one"),
        ({"constraints": (SOLID, Rods(group=0))}, "it must be the last"),
        ({"constraints": (FaceCollisions(thickness=0.2),)}, "at most 0.11.* a third of the smallest height"),
        ({"groups": (Group(network=CROSSED),)}, "edge between particles 1 and 2 passes through the face of 3, 4 and 5"),
        ({"groups": (Group(network=FLAT),)}, "meshes must not intersect"),
        ({"obstacles": (FLOOR,)}, r"obstacles\[0\] = half_space: only particles.* by collisions, which must be listed"),
        ({"obstacles": (FLOOR,), "constraints": (Collisions(obstacles=False), SOLID)}, "by collisions"),
        ({"obstacles": (Circle(centre=(0, 0, 0), radius=3, hollow=True),)}, r"obstacles\[0\] = hollow circle: only"),
        ({"obstacles": (POLES[0], FIELD)}, r"obstacles\[1\] = distance_field: faces would go through it; allowed"),
        ({"obstacles": (POLES[1], HUGE)}, r"particle 0 is inside obstacles\[1\]"),
        ({"obstacles": (Block(centre=(0.5, 0.05, 0), size=(0.2, 0.2, 9)),)}, r"edge .* passes through obstacles\[0\]"),
        ({"obstacles": (POLE,)}, r"obstacles\[0\] passes through the face of"),
        ({"obstacles": (Circle(centre=(0.5, 0.5, -0.1), radius=0.3),)}, r"0.2 m inside obstacles\[0\] = circle; faces"),
        ({"obstacles": (BESIDE, SMALL)}, r"face of 0, . and . is 0.005 m inside obstacles\[1\] = circle"),
        ({"obstacles": (SMALL.model_copy(update={"velocity": (0, 0, 1)}),)}, r"0.005 m inside obstacles\[0\] = circle"),
        ({"obstacles": (LEVEL,)}, r"0.01 m inside obstacles\[0\] = capsule"),
        ({"obstacles": (Wall(vertices=((-1, 0.6, 0.1), (2, 0.6, 0.1)), radius=0.15),)}, r"0.05 m inside .* = wall"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(change: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"dimension": 3, "groups": (sheet(2, 1.0, (0, 0, 0)),), "constraints": (SOLID,)}
    with pytest.raises(ValueError, match=text):
        Scene(**(given | change))


def test_an_edge_beside_a_triangle_in_one_plane_but_for_rounding_does_not_pierce_it() -> None:
    """From a sheet that falls: 5 cm apart, and 4e-13 m off the plane. Moved over to the triangle, it pierces it."""
    points = np.array(
        [
            (0.14999999999999997, 0.09509295750257127, 0.7102394375214358),
            (0.14999999999999988, 0.10329827812728622, 0.7786171093940516),
            (0.07411217318258559, 0.08701783469578381, 0.642946747465564),
            (0.15000000000000013, 0.08699362160722789, 0.6427449717274907),
            (0.0744675198494101, 0.09509409695942635, 0.7102489329952321),
        ]
    )
    edges, triangles = np.array([(0, 1)]), np.array([(2, 3, 4)])
    assert first_piercing(points, edges, triangles) is None
    points[:2] = points[2:].mean(axis=0) + np.array([(0, 0.01, 0), (0, -0.01, 0)])
    assert first_piercing(points, edges, triangles) == (0, 0)


@pytest.mark.parametrize("constraints", [(SOLID, RigidBodies()), (RigidBodies(), SOLID)])
def test_rigid_bodies_beside_faces_are_refused_in_either_order(constraints: Any) -> None:
    dice = Group(network=Blocks(sides=(0.1, 0.1, 0.1), centres=((0.5, 0.5, 1),)))
    with pytest.raises(ValueError, match="the blocks of rigid_bodies do not collide with faces; leave one of the two"):
        scene_of(sheet(2, 1.0, (0, 0, 0)), dice, constraints=constraints)


@pytest.mark.parametrize("obstacle", [FLOOR, Circle(centre=(0, 0, 0), radius=3, hollow=True)])
def test_what_leaves_a_convex_region_free_needs_collisions_of_particles(obstacle: Any) -> None:
    scene_of(sheet(2, 1.0, (0, 0, 0)), constraints=(Collisions(agents=False), SOLID), obstacles=(obstacle,))


def test_without_obstacles_any_are_allowed() -> None:
    scene_of(sheet(2, 1.0, (0, 0, 0)), constraints=(FaceCollisions(obstacles=False),), obstacles=(FLOOR, FIELD, HUGE))
