"""Shapes that move, and hollow shapes: their positions, their velocities, and the forces of laws on bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Separation
from flockenv.geometry.shapes import (
    FORMS,
    Block,
    Capsule,
    Circle,
    DistanceField,
    HalfSpace,
    Polygon,
    Shape,
    Sway,
    Wall,
    pack_shapes,
)
from flockenv.geometry.shapes.dispatch import hit_shape, nearest_shape
from flockenv.geometry.shapes.row_header import body_of, bound_of, shift_of, velocity_of
from flockenv.geometry.space import Torus
from flockenv.jit.section import entry
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import ObstacleContact
from flockenv.scene import Group, Scene
from flockenv.studies.measures import measure
from flockenv.studies.trajectory import Trajectory

U = np.array([-0.7, 0.4])
SWAY = Sway(amplitude=(0.3, -0.5), period=2.5, phase=0.4)
ROOM = Polygon(vertices=((0, 0), (4, 0), (4, 1), (3, 1), (3, 4), (0, 4)), hollow=True)


def moving(shape: Shape, **motion: Any) -> Any:
    return shape.model_copy(update=motion)


# --- moving frames of reference ---------------------------------------------------------------------------------------


AWAY: tuple[Any, ...] = (
    moving(Circle(centre=(900, 0), radius=1), velocity=(0, 1)), Block(centre=(900, 9), size=(1, 1)),
    HalfSpace(point=(900, 0), direction=(-1, 0)), Circle(centre=(0, 0), radius=900, hollow=True),
)  # fmt: skip
"""One shape of each form, far from all bodies, so that all these scenes share one kernel."""


def bodies(*shapes: Shape, radius: float = 0.3, stiffness: float = 50, damping: float = 0, **spawn: Any) -> Scene:
    return Scene(
        groups=(Group(count=30, mass=2, radius=radius, spawn=Spawn(**spawn)),), obstacles=(*shapes, *AWAY), dt=0.005,
        effects=(ObstacleContact(stiffness=stiffness, damping=damping),),
    )  # fmt: skip


@pytest.mark.slow
def test_contacts_with_moving_shapes_are_galilean_invariant() -> None:
    """A shape at velocity u and bodies at v; or a shape at rest and bodies at v - u, in a frame that moves with -u."""
    shapes = (
        Polygon(vertices=((1, 0), (2, 0), (1.5, 1))), Capsule(start=(0.2, 0.1), end=(0.2, 0.1), radius=1),
        Block(centre=(0, -2), size=(1, 2), turn=20), HalfSpace(point=(-2, 0), direction=(1, 0)), ROOM,
    )  # fmt: skip
    for shape in shapes:
        still = bodies(shape, damping=3, low=(-3, -3), high=(3, 3), speed=(0, 1))
        gliding = bodies(moving(shape, velocity=tuple(U)), damping=3, low=(-3, -3), high=(3, 3), speed=(0, 1))
        first = still.start(0, worlds=2)
        begin, end = (
            still.start(0, worlds=2).with_motion(np.array(first.pos), first.vel - U),
            gliding.start(0, worlds=2),
        )
        np.testing.assert_array_equal(begin.pos, end.pos)
        begin, end = still.run(begin, 600), gliding.run(end, 600)
        np.testing.assert_allclose(end.pos, begin.pos + 3 * U, atol=1e-12)
        np.testing.assert_allclose(end.vel, begin.vel + U, atol=1e-12)
        assert np.abs(end.vel - first.vel).max() > 0.1, "no body touched the shape"


def test_a_swaying_circle_acts_like_one_at_rest_while_its_displacement_is_zero() -> None:
    """The circle at rest is part of the state, the other is a shape; without damping its velocity does not matter."""
    circle = Circle(centre=(0, 0), radius=1)
    swaying = moving(circle, sway=Sway(amplitude=(2, 0), period=4))
    scenes = [bodies(shape, low=(-2, -2), high=(2, 2)) for shape in (circle, swaying)]
    states = [scene.start(0) for scene in scenes]
    assert [state.obstacle_radius.shape[1] for state in states] == [1, 0]
    for state in states:
        state.pos[...] *= 0.5
    at_rest, at_middle = (scene.step(state) for scene, state in zip(scenes, states, strict=True))
    assert np.abs(at_rest.vel).max() > 0.05
    np.testing.assert_allclose(at_middle.vel, at_rest.vel, atol=1e-12)


# --- positions and velocities -----------------------------------------------------------------------------------------

SHAPES: tuple[Any, ...] = (
    moving(Circle(centre=(9, 8), radius=0.8), velocity=(1.5, 0.25)),
    moving(Polygon(vertices=((2, 2), (4, 2.5), (3, 4))), sway=SWAY),
    moving(Wall(vertices=((6, 1), (7, 2), (8, 1)), radius=0.1), velocity=(-3, 2), sway=SWAY),
    moving(Block(centre=(5, 6), size=(1, 2), turn=30), velocity=(0.5, -0.5), sway=SWAY),
    Capsule(start=(1, 7), end=(2, 8), radius=0.3),
)
TIMES = (0.0, 1.7, 40.2)


@pytest.mark.slow
def test_contact_forces_use_position_and_velocity_of_shapes_at_the_time_of_a_world() -> None:
    """k d - c (v - u).n for each shape, displaced by v t + a sin(2 pi t / T + phase); the nearest image on a torus."""
    scene = Scene(
        space=Torus(size=(12, 12)), groups=(Group(count=94, radius=0.25, spawn=Spawn(speed=(0.5, 1))),),
        obstacles=SHAPES, effects=(ObstacleContact(stiffness=40, damping=6),),
    )  # fmt: skip
    state = scene.start(3, worlds=3)
    state.pos[...] = np.random.default_rng(0).uniform(0, 12, state.pos.shape)
    found, _ = scene.rates(state, times=TIMES)
    expected, touched = np.zeros_like(found), np.zeros(len(SHAPES), int)
    for b, time in enumerate(TIMES):
        for s, shape in enumerate(SHAPES):
            place = np.array(shape.anchor) + shape.shift(time)
            near = np.array(shape.anchor) + scene.space.displacement(place, state.pos[b])
            speed = (shape.shift(time + 1e-6) - shape.shift(time - 1e-6)) / 2e-6
            gap, normal = shape.gap(near), shape.normal(near)
            force = 40 * (0.25 - gap) - 6 * ((state.vel[b] - speed) * normal).sum(axis=1)
            hits = (gap < 0.25) & (force > 0)
            touched[s] += hits.sum()
            expected[b] += np.where(hits, force, 0)[:, None] * normal
    np.testing.assert_allclose(found, expected, atol=1e-7)
    assert (touched > 1).all()
    assert state.count_of("obstacle_tests") == 3 * 94 * len(SHAPES), "obstacles out of reach are counted also"


@pytest.mark.slow
def test_a_moving_wall_hides_agents_from_each_other_while_it_is_between_them() -> None:
    """A wall moves past at 1 m/s and is between the agents from 1.5 to 2.5 s."""
    wall = Block(centre=(-2, 0), size=(1, 0.2), velocity=(1, 0))
    place = Spawn(low=(0, -1), high=(0, 1))
    scene = Scene(
        groups=(Group(count=2, max_force=5, spawn=place),), obstacles=(wall,),
        effects=(Separation(weight=1, radius=4, occluded=True),),
    )  # fmt: skip
    state = scene.start(0, worlds=5)
    state.pos[:, 0], state.pos[:, 1] = (0, -1), (0, 1)
    found, _ = scene.rates(state, times=(0, 1.49, 1.51, 2.49, 2.51))
    assert (np.abs(found).max(axis=(1, 2)) > 0).tolist() == [True, True, False, False, True]


# --- hollow shapes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("room", [ROOM, Circle(centre=(2, 2), radius=1.9, hollow=True)], ids=["polygon", "circle"])
def test_bodies_in_a_hollow_shape_start_inside_and_stay_inside(room: Any) -> None:
    scene = bodies(room, radius=0.1, stiffness=800, low=(0, 0), high=(4, 4), speed=(1, 2))
    state = scene.start(1, worlds=2)
    assert (room.gap(state.pos) >= 0.1).all()
    energy = (state.vel**2).sum()
    state = scene.run(state, 2000)
    assert (room.gap(state.pos) > 0.1 - 2 / np.sqrt(400)).all()
    now = (state.vel**2).sum() + 400 * (np.maximum(0.1 - room.gap(state.pos), 0) ** 2).sum()
    assert now == pytest.approx(energy, rel=0.02), "walls conserve energy"
    touching = measure(scene, state)["contacts"]
    assert touching >= (room.gap(state.pos[0]) < 0.1).sum()


def test_a_ray_in_a_hollow_shape_ends_where_the_body_touches_the_wall() -> None:
    """The gap exceeds the radius up to the hit and equals it there; a distance field gives nearly the same hit."""
    rng = np.random.default_rng(7)
    field = DistanceField(low=(-1, -1), high=(5, 5), spacing=0.05, shapes=(moving(ROOM, hollow=False),), hollow=True)
    x, turn = rng.uniform(0, 4, (400, 2)), rng.uniform(0, 2 * np.pi, 400)
    direction = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    exact, near = ROOM.hit(x, direction, 0.2), field.hit(x, direction, 0.2)
    inside = ROOM.gap(x) > 0.25
    assert inside.sum() > 50
    assert np.quantile(np.abs(exact - near)[inside], 0.9) < 0.1
    for share in np.linspace(0, 0.999, 50):
        assert (ROOM.gap(x + share * exact[:, None] * direction)[inside] > 0.2 - 1e-9).all()
    np.testing.assert_allclose(ROOM.gap(x + exact[:, None] * direction)[inside], 0.2, atol=1e-9)


# --- shapes whose form is known only at run time ----------------------------------------------------------------------


def test_packed_rows_give_the_gap_hit_bound_shift_and_velocity_of_their_shape() -> None:
    """For shapes of all forms in one table."""
    field = DistanceField(low=(-1, -1), high=(1, 1), spacing=0.5, shapes=(Circle(centre=(0, 0), radius=0.6),))
    hollows = (moving(field, hollow=True), ROOM, Block(centre=(0, 0), size=(5, 4), hollow=True))
    every = (*SHAPES, HalfSpace(point=(0, 1), direction=(1, 2), velocity=(0, 1)), field, *hollows)
    table, where = pack_shapes(every, 2, first=3)
    assert set(where) == set(FORMS)
    at, rows, order = 0, [], sorted(range(len(every)), key=lambda k: list(FORMS).index(every[k].form))
    for k in order:
        rows.append(at)
        assert table[at + 1] == 3 + k
        at += int(table[at])
    assert at == len(table)
    found = np.empty((len(every), 11))
    x, direction = np.array([0.4, 0.3]), np.array([0.6, 0.8])
    entry(read_rows)(table, np.array(rows), 1.3, x, direction, found)
    for k, (gap, *normal, hit, bx, by, radius, dx, dy, vx, vy) in zip(order, found.tolist(), strict=True):
        shape, place = every[k], np.array(every[k].anchor) + x
        np.testing.assert_allclose((gap, *normal), (shape.gap(place), *shape.normal(place)), atol=1e-12)
        np.testing.assert_allclose(hit, shape.hit(place, direction, 0.1), atol=1e-12)
        np.testing.assert_allclose((bx, by), shape.bound.centre - shape.anchor, atol=1e-12)
        np.testing.assert_allclose(radius, shape.bound.radius, rtol=2e-6)
        np.testing.assert_allclose((dx, dy), shape.shift(1.3), atol=1e-12)
        slope = (shape.shift(1.3 + 1e-5) - shape.shift(1.3 - 1e-5)) / 2e-5
        np.testing.assert_allclose((vx, vy), slope, atol=1e-8)
    assert body_of.py_func(0, (0.0, 0.0)) == 16


def read_rows(table: Any, rows: Any, time: float, x: Any, direction: Any, found: Any) -> None:
    """Write the results of the functions that read forms at run time, for each row."""
    y, d = (x[0], x[1]), (direction[0], direction[1])
    for k in range(len(rows)):
        at = rows[k]
        gap, normal = nearest_shape(table, at, y)
        centre, radius = bound_of(table, at, y)
        shift, speed = shift_of(table, at, time, y), velocity_of(table, at, time, y)
        found[k, 0], found[k, 3], found[k, 6] = gap, hit_shape(table, at, y, d, 0.1), radius
        for j in range(2):
            found[k, 1 + j], found[k, 4 + j] = normal[j], centre[j]
            found[k, 7 + j], found[k, 9 + j] = shift[j], speed[j]


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_pictures_show_moving_shapes_in_place_and_only_the_walls_of_hollow_ones() -> None:
    scene = Scene(
        space=Torus(size=(12, 12)), groups=(Group(count=1),), dt=0.1,
        obstacles=(*SHAPES[:2], moving(Circle(centre=(6, 6), radius=3), hollow=True)),
    )  # fmt: skip
    state, times = scene.start(0), np.array([0, 40, 80])
    where = np.repeat(np.asarray(state.pos), 3, axis=0)
    film = list(Trajectory(scene, 0, times, where, where, np.ones((3, 1), bool), state, state, 0.0, "").snapshots())
    later = state.with_motion(state.pos, state.vel)
    later.tick[:] = 40
    np.testing.assert_array_equal(scene.snapshot(later).outlines[0], film[1].outlines[0])
    for shot in film:
        rolling, _, room = shot.outlines
        place = scene.space.wrap(np.array([9, 8]) + shot.time * np.array([1.5, 0.25]))
        np.testing.assert_allclose((rolling.min(axis=0) + rolling.max(axis=0)) / 2, place, atol=1e-9)
        x, y = room.T
        area = 0.5 * abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
        assert area == pytest.approx(2 * np.pi * 3 * 0.004 * 12, rel=0.02)
        assert np.linalg.norm(room - 6, axis=1).min() == pytest.approx(3, rel=0.01)
    assert [shot.time for shot in film] == [0, 4, 8]
