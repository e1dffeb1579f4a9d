"""Social forces: signs, closed forms, published values, what walls hide, and when models oscillate.

One kernel serves all quick tests of forces (`crowd`): it lists every effect, idle unless a test gives it numbers.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
from numba import njit

from flockenv import steering
from flockenv.behaviours import (
    CircularRepulsion,
    Driving,
    EllipticalRepulsion,
    Friends,
    Heuristics,
    Interest,
    ObstacleRepulsion,
    Sidestep,
    WalkingGroup,
)
from flockenv.behaviours.steer import Steer
from flockenv.core.warnings import CoarseContactWarning, UnstableStepWarning
from flockenv.geometry.shapes import Block, Polygon, Shape, Wall
from flockenv.geometry.space import Torus
from flockenv.maths.approximations import atan2, exp, round_half_even
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Contact, Course, Effect, Goal, ObstacleContact
from flockenv.physics.integrators import ExplicitEuler, SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.presets import ALIASES, PRESETS, preset
from flockenv.scene.stability import suggest_dt
from flockenv.scene.yaml_io import ConfigError, dump_scene, load_scene, schema
from flockenv.steering.vectorize import rows
from tests.catalogue import rotation

Array = Any

FAR = 1e4
"""m, the distance of obstacles that a test does not use."""

AWAY: tuple[Shape, ...] = (
    Wall(vertices=((FAR, FAR), (FAR + 1, FAR))),
    Polygon(vertices=((-FAR, -FAR), (FAR, -FAR), (FAR, FAR), (-FAR, FAR)), hollow=True),
    Block(centre=(0, 0), size=(3 * FAR, 3 * FAR), hollow=True),
)
"""A shape of each form in the kernel, too far away to act."""

LISTED: tuple[Effect, ...] = (
    Course(direction=(1, 0), group=0),
    Driving(tau=0.5),
    CircularRepulsion(strength=1, decay=0.5, radius=20, occluded=True),
    EllipticalRepulsion(acceleration=1, decay=0.5, step=1, radius=20),
    Sidestep(acceleration=1, radius=20),
    Friends(group=0, strength=1, decay=1, radius=20),
    WalkingGroup(group=0, party=2, radius=20),
    Interest(target=(0, 0), strength=1, decay=1),
    ObstacleRepulsion(strength=1, decay=0.5, occluded=True),
    Contact(stiffness=1, friction=1, radius=20),
    ObstacleContact(stiffness=1, friction=1),
)


def crowd(*acting: Effect, count: int = 2, walls: tuple[Shape, ...] = (), **fields: Any) -> Scene:
    """Return a scene of `count` pedestrians of 80 kg with an aim along x, and `count` without an aim."""
    own = {effect.kind: effect for effect in acting}
    effects = tuple(own.pop(effect.kind, effect.idle_copy()) for effect in LISTED)
    assert not own
    forms = {shape.form for shape in walls}
    body = {"mass": 80.0, "radius": 0.25, "desired_speed": 1.34, "spawn": Spawn(low=(0, 0), high=(50, 50))} | fields
    dt = body.pop("dt", 1e-3)
    groups = (Group(count=count, **body), Group(count=count, **body))
    shapes = walls + tuple(shape for shape in AWAY if shape.form not in forms)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CoarseContactWarning)
        return Scene(groups=groups, effects=effects, obstacles=shapes, dt=dt)


def placed(scene: Scene, pos: Array, vel: Array = (0.0, 0.0)) -> Any:
    """Return a state with agents at these positions and velocities; no other agent is alive."""
    state = scene.start(0)
    pos = np.atleast_2d(np.asarray(pos, float))
    state.alive[0, len(pos) :], state.vel[0] = False, 0
    state.pos[0, : len(pos)], state.vel[0, : len(pos)] = pos, vel
    return state


def pushed(scene: Scene, pos: Array, vel: Array = (0.0, 0.0)) -> Array:
    """Return the accelerations of agents at these positions and velocities, (K, 2) m/s^2."""
    before = placed(scene, pos, vel)
    after = scene.step(before)
    return ((after.vel[0] - before.vel[0]) / scene.dt)[: len(np.atleast_2d(pos))]


# --- laws -------------------------------------------------------------------------------------------------------------


def test_exp_and_atan2_have_the_documented_accuracy() -> None:
    x = np.r_[np.linspace(-700, 700, 20_001), np.linspace(-1e-3, 1e-3, 101)]
    assert np.abs(rows(exp)(x) / np.exp(x) - 1).max() < 1e-14
    assert rows(exp)(np.array([-np.inf, -1e9])).tolist() == [0.0, 0.0]
    assert np.isnan(rows(exp)(np.array([np.nan]))).all()
    y, x = np.random.default_rng(0).normal(size=(2, 20_000))
    assert np.abs(rows(atan2)(y, x) - np.arctan2(y, x)).max() < 5e-16
    corners = [(0, 0), (0, -1), (1, 0), (-1, 0), (0, 1)]
    assert np.allclose([rows(atan2)(*np.array(c, float)) for c in corners], [np.arctan2(*c) for c in corners], atol=0)


@njit(error_model="numpy", fastmath={"contract"})
def _rounded(x: Any, factor: Any, out: Any) -> None:
    for i in range(len(x)):
        out[i] = round_half_even(x[i] * factor)


@pytest.mark.parametrize(("dtype", "digits"), [(np.float32, 22), (np.float64, 51)])
def test_nearest_whole_rounds_ties_to_even(dtype: Any, digits: int) -> None:
    most = 2.0**digits
    halves = np.r_[-1000.5:1001, most - 2.5, most - 1.5, -most + 1.5]
    near = np.nextafter(halves.astype(dtype), dtype(0)), np.nextafter(halves.astype(dtype), dtype(np.inf))
    x = np.r_[halves, *near, 0.0, -0.0, np.random.default_rng(0).normal(0, most / 8, 1000)].astype(dtype)
    found = np.empty_like(x)
    _rounded(x, dtype(1), found)
    np.testing.assert_array_equal(found, np.rint(x))
    np.testing.assert_array_equal([round_half_even.py_func(number) for number in x], np.rint(x))  # also in plain Python
    _rounded(x[: len(halves) - 3], dtype(2), found)  # the compiler may fuse the product with the rounding
    np.testing.assert_array_equal(found[: len(halves) - 3], 2 * x[: len(halves) - 3])
    _rounded(np.array([np.nan, np.inf, -np.inf], dtype), dtype(1), found)
    np.testing.assert_array_equal(found[:3], [np.nan, np.inf, -np.inf])


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_elliptical_force_is_the_gradient_of_its_potential(dimension: int) -> None:
    rng = np.random.default_rng(1)
    offset, step, decay, h = rng.uniform(-3, 3, (500, dimension)), rng.uniform(-2, 2, (500, dimension)), 0.3, 1e-5
    tie = np.eye(dimension)[0]

    def potential(here: Array) -> Array:
        both = np.linalg.norm(here, axis=1) + np.linalg.norm(here + step, axis=1)
        return np.exp(-np.sqrt(both**2 - (step**2).sum(axis=1)) / 2 / decay)

    slope = [(potential(offset - h * e) - potential(offset + h * e)) / (2 * h) for e in np.eye(dimension)]
    force = rows(steering.elliptical_repulsion)(offset, step, tie, decay)
    size = np.linalg.norm(force, axis=1)
    off = np.linalg.norm(force + decay * np.stack(slope, axis=1), axis=1)
    assert (off < 1e-6 * np.maximum(size, 1e-3)).all()
    assert size.max() > 0.1


def test_elliptical_repulsion_is_circular_without_a_step_and_bounded_at_the_foci() -> None:
    law = rows(steering.elliptical_repulsion)
    offset = np.array([[0.3, 0.4], [-2.0, 1.0]])
    round_ = rows(steering.repulsion)(offset, (1.0, 0.0), 0.0, 0.7)
    assert np.allclose(law(offset, (0.0, 0.0), (1.0, 0.0), 0.7), round_, rtol=1e-14)
    there = np.array([[0.0, 0.0], [-1.0, 0.0], [-0.5, 0.0]])  # at the first focus, at the second, between both
    size = np.linalg.norm(law(there, (1.0, 0.0), (0.0, 1.0), 0.7), axis=1)
    assert size[0] == 1 and 100 < size[1] <= 500 and size[2] == pytest.approx(1)


def test_agents_ahead_weigh_more_and_all_weigh_the_same_without_a_direction() -> None:
    """lambda + (1 - lambda)(1 + cos) / 2; Menge swaps ahead and behind (peers.md 2.6)."""
    weight = rows(steering.view_weight)
    around = np.array([[2.0, 0.0], [0.0, 3.0], [-1.0, 0.0]])
    assert np.allclose(weight((1.0, 0.0), around, 0.1), [1, 0.55, 0.1])
    assert (weight((0.0, 0.0), around, 0.1) == 1).all()
    cone = rows(steering.cone_weight)  # takes the force, which points away from its source
    assert cone((1.0, 0.0), -around, math.cos(math.radians(100)), 0.5).tolist() == [1, 1, 0.5]
    assert cone((3.0, 0.0), -around, math.cos(math.radians(100)), 0.5).tolist() == [1, 1, 0.5]
    assert (cone((0.0, 0.0), -around, math.cos(math.radians(100)), 0.5) == 1).all()


def test_looking_is_along_the_aim_and_without_an_aim_along_the_heading() -> None:
    looking = rows(steering.gaze_direction)
    assert looking((0.0, 0.5), (1.0, 0.0)).tolist() == [0, 0.5]  # the length of the aim does not matter
    assert looking((0.0, 0.0), (1.0, 0.0)).tolist() == [1, 0]


def test_a_sidestep_turns_away_from_the_neighbour_s_side_and_its_angle_wraps() -> None:
    """A neighbour on the left is passed on the right at every heading (PySocialForce does not wrap: peers.md)."""
    law, rng = rows(steering.sidestep), np.random.default_rng(2)
    angle = np.r_[np.linspace(-np.pi, np.pi, 181), rng.uniform(-np.pi, np.pi, 200)]
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    left = np.stack([-way[:, 1], way[:, 0]], axis=1)
    for side in (-1, 1):
        force = law(2 * way + 0.4 * side * left, way, -way, (1.0, 0.0), 2.0, 0.35, 2.0, 3.0, 0.005)
        along, across = (force * way).sum(axis=1), (force * left).sum(axis=1)
        assert (along < 0).all() and (across * side < 0).all()
        assert np.ptp(along) < 1e-12 and np.ptp(across) < 1e-12  # no jump at +-pi
    ahead = law(2 * way, way, -way, (1.0, 0.0), 2.0, 0.35, 2.0, 3.0, 0.005)
    assert ((ahead * left).sum(axis=1) < -0.1).all()  # dead ahead: to the right
    beside = np.array([[-1.0, 1e-3], [-1.0, -1e-3]])  # just to either side of straight behind, where theta is +-pi
    both = law(beside, (0.0, 0.0), (-3.0, 0.0), (1.0, 0.0), 2.0, 0.35, 2.0, 3.0, 0.0)
    assert np.allclose(both[0], both[1] * [1, -1], rtol=1e-9)


def test_collision_distance_assumes_that_both_agents_keep_their_velocity() -> None:
    far = rows(steering.collision_distance)
    directions = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.allclose(
        far(directions, (3.0, 0.0), (-1.0, 0.0), 0.5, 1.0), [1.25, np.inf]
    )  # the gap of 2.5 m closes at 2 m/s
    assert far((1.0, 0.0), (3.0, 0.0), (1.5, 0.0), 0.5, 1.0) == np.inf  # the neighbour is faster
    assert far((1.0, 0.0), (0.3, 0.0), (0.0, 0.0), 0.5, 1.0) == 0
    assert far((-1.0, 0.0), (0.3, 0.0), (0.0, 0.0), 0.5, 1.0) == np.inf  # they part


# --- signs ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_friction_against_a_wall_never_adds_kinetic_energy() -> None:
    """-kappa d (v . t) t; JuPedSim adds it (peers.md 2.6)."""
    scene = crowd(ObstacleContact(stiffness=0, friction=2.4e5), count=40, walls=(Wall(vertices=((0, -90), (0, 90))),))
    rng = np.random.default_rng(3)
    pos = np.stack([rng.uniform(-0.25, 0.25, 40), np.linspace(-60, 60, 40)], axis=1)
    vel = rng.normal(size=(40, 2))
    power = (pushed(scene, pos, vel) * vel).sum(axis=1)
    assert (power < 0).all()
    assert power.min() < -10
    assert np.abs(pushed(scene, pos, vel)[:, 0]).max() < 1e-9  # friction is along the wall


@pytest.mark.slow
def test_friction_between_agents_opposes_slip_at_every_contact_angle() -> None:
    """kappa d (dv_ji . t) t on i; in Menge it adds to the slip in half of the cases (peers.md 2.6)."""
    scene = crowd(Contact(stiffness=0, friction=2.4e5, radius=20), count=1)
    rng = np.random.default_rng(4)
    for _ in range(40):
        angle = rng.uniform(0, 2 * np.pi)
        n = np.array([np.cos(angle), np.sin(angle)])
        vel = rng.normal(size=(2, 2))
        slip = (vel[0] - vel[1]) - n * ((vel[0] - vel[1]) @ n)
        force = pushed(scene, [[0, 0], 0.4 * n], vel)
        assert force[0] @ slip == pytest.approx(-2.4e5 * 0.1 / 80 * (slip @ slip), rel=1e-6)
        assert np.allclose(force[0], -force[1])
        assert abs(force[0] @ n) < 1e-6 * np.linalg.norm(force[0])


@pytest.mark.parametrize(
    "effect",
    [
        CircularRepulsion(acceleration=0.42, decay=1.65, bodies=False, anisotropy=0.12, radius=20, occluded=True),
        EllipticalRepulsion(acceleration=7, decay=0.3, step=2, fov=200, outside=0.5, radius=20),
        EllipticalRepulsion(acceleration=0.04, decay=3.22, step=0.5, relative=True, anisotropy=0.06, radius=20),
    ],
    ids=("circular", "1995", "elliptical_2"),
)
def test_a_neighbour_ahead_repels_more_than_one_behind(effect: Effect) -> None:
    scene = crowd(Course(direction=(1, 0), group=0), effect)
    for vel in ((0.0, 0.0), (-0.5, 0.3)):  # the aim counts, not the velocity
        ahead, behind = pushed(scene, [[0, 0], [1.2, 0]], vel)[0], pushed(scene, [[0, 0], [-1.2, 0]], vel)[0]
        assert ahead[0] < 0 < behind[0] or effect.kind == "elliptical_repulsion"
        mirrored = pushed(scene, [[0, 0], [-1.2, 0]], vel * np.array([-1, 1]))[0]
        assert np.linalg.norm(ahead) > 1.9 * np.linalg.norm(mirrored)


def test_repulsions_push_away_and_attractions_pull() -> None:
    here = [[0.0, 0.0], [0.9, 0.6]]
    to = np.array(here[1]) / np.linalg.norm(here[1])
    for effect in (LISTED[2], LISTED[3], LISTED[4]):
        assert pushed(crowd(effect, count=1), here)[0] @ to < 0
    assert pushed(crowd(Friends(group=0, strength=80, decay=1, radius=20)), here)[0] @ to > 0
    drawn = crowd(Interest(target=(3, 0), strength=80, decay=2, fades=0.1), count=1)
    assert pushed(drawn, here)[0][0] == pytest.approx(math.exp(-1.5))
    later = drawn.run(placed(drawn, here), 200)
    assert (drawn.step(later).vel[0, 0, 0] - later.vel[0, 0, 0]) / 1e-3 == pytest.approx(
        0.1353 * math.exp(-1.5), rel=0.02
    )


def test_walking_groups_have_the_published_cohesion_gaze_and_repulsion() -> None:
    """Moussaid et al. 2010: beta1 = 4, beta2 = 3, beta3 = 1. Agents 0 and 1 are a party, 2 and 3 another."""
    scene = crowd(WalkingGroup(group=0, party=2, radius=20), count=4)
    alone = pushed(scene, [[0, 0], [90, 0], [0.5, 0]])
    assert not alone.any()  # agents of another party do not act
    far = pushed(scene, [[0, 0], [0, 4]])
    assert np.allclose(far[0], [0, 3]) and np.allclose(far[1], [0, -3])
    near = pushed(scene, [[0, 0], [0, 0.5]])
    assert np.allclose(near[0], [0, -1]) and np.allclose(near[1], [0, 1])
    between = pushed(scene, [[0, 0], [0, 0.9]], [[1.0, 0.0], [1.0, 0.0]])  # abreast: no gaze force
    assert np.abs(between).max() < 1e-9
    file = pushed(scene, [[0, 0], [-0.9, 0]], [[1.0, 0.0], [1.0, 0.0]])
    assert np.allclose(
        file, [[-4 * np.pi / 2, 0], [0, 0]]
    )  # the partner is 90 degrees outside the view of the first, which brakes


@pytest.mark.slow
def test_parties_end_at_the_group_and_the_last_party_may_be_smaller() -> None:
    """Groups of 2 and 1 agents, parties of 3: the third agent joins no party unless the effect is for all groups."""
    body: dict[str, Any] = {"mass": 80.0, "radius": 0.25, "spawn": Spawn(low=(0, 0), high=(9, 9))}
    where, far = [[0.0, 0.0], [0.0, 4.0], [5.0, 0.0]], []
    for which, many in ((0, 2), (None, 3)):
        scene = Scene(
            groups=(Group(count=2, **body), Group(count=1, **body)),
            effects=(WalkingGroup(group=which, party=3, radius=20, gaze=0),),
        )
        state = scene.start(0).with_motion(np.array([where]), np.zeros((1, 3, 2)))
        far.append(np.linalg.norm(scene.acceleration(state)[0], axis=1))
        assert (far[-1] > 0.5).sum() == many
    assert far[0][2] == 0


def test_the_field_most_bounds_the_attraction_of_friends() -> None:
    here = [[0.0, 0.0], [1.0, 0.0]]
    free, bounded = (
        pushed(crowd(Friends(group=0, strength=80, decay=1, radius=20, most=most)), here)[0, 0] for most in (None, 8)
    )
    assert free == pytest.approx(math.exp(-1), rel=1e-4) and bounded == pytest.approx(0.1, rel=1e-4)


def test_forces_turn_with_the_scene() -> None:
    rng = np.random.default_rng(5)
    pos, vel = rng.uniform(-2, 2, (24, 2)), rng.normal(size=(24, 2))
    corner = np.array([[-4.0, -3.0], [3.0, -3.5], [3.5, 3.0]])
    matrix = rotation(2, 7)
    pushes = []
    for turn in (np.eye(2), matrix):
        there = tuple(map(tuple, (corner @ turn.T).tolist()))
        aim = tuple((turn @ [1.0, 0.0]).tolist())
        effects = [
            Course(direction=aim, group=0), Driving(tau=0.5),
            CircularRepulsion(strength=200, decay=0.3, anisotropy=0.2, radius=20, occluded=True),
            EllipticalRepulsion(acceleration=7, decay=0.3, step=2, fov=200, outside=0.5, radius=20),
            Sidestep(acceleration=4.5, radius=20), ObstacleRepulsion(strength=500, decay=0.4, occluded=True),
        ]  # fmt: skip
        scene = crowd(*effects, count=12, walls=(Wall(vertices=there),))
        pushes.append(pushed(scene, pos @ turn.T, vel @ turn.T))
    assert np.allclose(pushes[0] @ matrix.T, pushes[1], rtol=1e-8, atol=1e-8)
    assert np.abs(pushes[0]).max() > 1


# --- walls ------------------------------------------------------------------------------------------------------------

PUSH = ObstacleRepulsion(acceleration=1, decay=0.5, bodies=False, occluded=True, radius=5)


def off_walls(walls: tuple[Shape, ...], *points: tuple[float, float]) -> Array:
    """Return the accelerations of agents at these points by walls, 1 m/s^2 exp(-d / 0.5 m) for each side."""
    return pushed(crowd(PUSH, count=len(points), walls=walls), points)


def test_wall_repulsion_is_summed_over_all_sides() -> None:
    corridor = (Wall(vertices=((-9, 1), (9, 1))), Wall(vertices=((-9, -1), (9, -1))))
    middle, side = off_walls(corridor, (0, 0), (0, 0.5))
    assert np.allclose(middle, 0, atol=1e-12)  # not 0 if only the nearest wall acted
    assert np.allclose(side, [0, math.exp(-3) - math.exp(-1)])
    elbow = (Wall(vertices=((-9, 0), (0, 0), (0, 9))),)
    inside, outside, beside = off_walls(elbow, (-0.5, 0.7), (0.3, -0.4), (3, 3))
    assert np.allclose(inside, [-math.exp(-1), math.exp(-1.4)])
    assert np.allclose(outside, math.exp(-1) * np.array([0.6, -0.8]))  # the corner acts once
    assert np.allclose(beside, [math.exp(-6), 0])


def test_wall_repulsion_does_not_depend_on_how_the_wall_is_cut() -> None:
    points = ((1.3, 0.4), (2.0, 0.3), (4.0, -0.2), (5.2, 0.3), (-0.2, 0.1), (1.0, 1.2), (4.2, 0.4))
    whole = (Wall(vertices=((0, 0), (4, 0), (4, 3))),)
    pieces = (Wall(vertices=((0, 0), (1, 0), (2, 0), (4, 0), (4, 1), (4, 3))),)
    apart = (Wall(vertices=((2, 0), (0, 0))), Wall(vertices=((4, 0), (2, 0))), Wall(vertices=((4, 0), (4, 3))))
    expected = off_walls(whole, *points)
    assert np.allclose(off_walls(pieces, *points), expected, atol=1e-12)
    assert np.allclose(off_walls(apart, *points), expected, atol=1e-12)
    assert np.abs(expected).max() > 0.5


@pytest.mark.parametrize(
    "vertices",
    [
        ((0, 0), (2, 0), (2, 0), (4, 0), (4, 3)),
        ((0, 0), (2, 0), (2, 0), (2, 0), (4, 0), (4, 3)),
        ((0, 0), (4, 0), (4, 0), (4, 3)),
        ((0, 0), (0, 0), (4, 0), (4, 3), (4, 3)),
        ((0, 0), (2, 0), (2, 1e-9), (4, 0), (4, 3)),
    ],
    ids=["inside a side", "three times", "at a corner", "at both ends", "almost"],
)
def test_repeated_vertices_of_a_wall_add_no_force(vertices: tuple[tuple[float, float], ...]) -> None:
    points = ((2.0, 0.4), (2.05, 0.3), (3.7, 0.3), (4.2, -0.2), (-0.2, 0.1), (4.2, 3.3))
    expected = off_walls((Wall(vertices=((0, 0), (4, 0), (4, 3))),), *points)
    assert np.allclose(off_walls((Wall(vertices=vertices),), *points), expected, rtol=1e-8)
    beside = (Wall(vertices=vertices), Wall(vertices=((4, 3), (6, 3))))  # joined at a repeated vertex
    one = (Wall(vertices=((0, 0), (4, 0), (4, 3), (6, 3))),)
    assert np.allclose(off_walls(beside, *points), off_walls(one, *points), rtol=1e-8)


def test_two_coincident_walls_both_act() -> None:
    wall = Wall(vertices=((0, 0), (4, 0)))
    assert np.allclose(off_walls((wall, wall), (2.0, 0.5)), 2 * off_walls((wall,), (2.0, 0.5)))


def test_a_room_as_walls_polygon_or_block_gives_the_same_force() -> None:
    points = ((0.4, 0.6), (2.0, 1.5), (3.7, 2.9), (3.9, 0.1))
    corners = ((0, 0), (4, 0), (4, 3), (0, 3))
    as_walls = off_walls((Wall(vertices=(*corners, corners[0])),), *points)
    expected = [
        [math.exp(-2 * x) - math.exp(-2 * (4 - x)), math.exp(-2 * y) - math.exp(-2 * (3 - y))] for x, y in points
    ]
    assert np.allclose(as_walls, expected, atol=1e-12)
    hollow = (Polygon(vertices=corners, hollow=True),)
    block = (Block(centre=(2, 1.5), size=(4, 3), hollow=True),)
    assert np.allclose(off_walls(hollow, *points), as_walls, atol=1e-12)
    assert np.allclose(off_walls(block, *points), as_walls, atol=1e-12)


def test_walls_hide_agents_and_other_walls() -> None:
    wall = (Wall(vertices=((0, -2), (0, 2))),)
    repels = CircularRepulsion(strength=800, decay=0.5, radius=20, occluded=True)
    scene = crowd(repels, count=2, walls=wall)
    hidden = pushed(scene, [[-0.4, 0], [0.4, 0]])
    assert not hidden.any()
    assert np.abs(pushed(crowd(repels, count=2), [[-0.4, 0], [0.4, 0]])).min(axis=1).max() == 0
    assert np.abs(pushed(crowd(repels, count=2), [[-0.4, 0], [0.4, 0]])[:, 0]).min() > 1
    past = pushed(scene, [[-0.4, 3], [0.4, 3]])
    assert np.abs(past[:, 0]).min() > 1  # past the end of the wall they see each other
    two = (*wall, Wall(vertices=((0.3, -2), (0.3, 2))))
    assert np.allclose(off_walls(two, (-0.5, 0)), [[-math.exp(-1), 0]])  # the second wall lies behind the first
    thick = (Polygon(vertices=((0, -2), (0.3, -2), (0.3, 2), (0, 2))),)
    assert np.allclose(off_walls(thick, (-0.5, 0)), [[-math.exp(-1), 0]])  # of a solid only the visible side acts


def test_walls_are_joined_across_the_seam_of_a_torus() -> None:
    """A wall is at most half a torus long, so a corridor around it needs several."""
    halves = [Wall(vertices=((a, y), (b, y))) for y in (1, 3) for a, b in ((0, 5), (5, 10))]
    scene = Scene(
        space=Torus(size=(10, 12)), groups=(Group(count=3, spawn=Spawn(speed=(0, 0))),), effects=(PUSH,),
        obstacles=tuple(halves), dt=1e-3,
    )  # fmt: skip
    assert [row[-6:].tolist()[::3] for row in np.split(scene.parts.shape_table[0], 4)] == [[1, 1], [2, 2]] * 2


# --- when models oscillate --------------------------------------------------------------------------------------------


def approach(v0: float, tau: float, decay: float, acceleration: float) -> tuple[Array, float]:
    """Return the speeds, every 10 ms, of an agent that walks at a wall from 3 m away, and its last distance, m."""
    scene = crowd(
        Course(direction=(1, 0), group=0), Driving(tau=tau),
        ObstacleRepulsion(acceleration=acceleration, decay=decay, bodies=False, radius=20, occluded=True),
        walls=(Wall(vertices=((0, -9), (0, 9))),), desired_speed=v0, count=1,
    )  # fmt: skip
    state, speeds = placed(scene, [[-3.0, 0.0]]), []
    for _ in range(2000):
        state = scene.run(state, 10)
        speeds.append(state.vel[0, 0, 0])
    return np.array(speeds), -float(state.pos[0, 0, 0])


@pytest.mark.parametrize(
    ("v0", "tau", "decay", "acceleration"),
    [(0.8, 0.5, 0.08, 25), (1.34, 0.05, 0.5, 50), (1.0, 0.25, 1.0, 50), (1.0, 0.2, 1.0, 50), (1.0, 0.4, 1.0, 50),
     (1.34, 0.5, 0.2, 50)],
)  # fmt: skip
def test_a_walk_against_a_wall_oscillates_if_and_only_if_kretz_predicts_it(
    v0: float, tau: float, decay: float, acceleration: float
) -> None:
    """No oscillation if v0 tau / B <= 1/4 (arXiv 1507.02566); the gap is B ln(A tau / v0) (N13)."""
    speeds, gap = approach(v0, tau, decay, acceleration)
    turns = np.abs(np.diff(np.sign(speeds[np.abs(speeds) > 1e-6]))) > 0
    ratio = v0 * tau / decay
    assert (turns.sum() == 0) == (ratio <= 0.25), (ratio, turns.sum())
    assert turns.sum() >= 2 or ratio <= 1
    assert gap == pytest.approx(decay * math.log(acceleration * tau / v0), abs=1e-3)


# --- hard input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [LISTED[2], LISTED[3], LISTED[4], LISTED[6]], ids=lambda effect: effect.kind)
def test_coincident_agents_at_rest_part_in_no_preferred_direction(effect: Effect) -> None:
    scene = crowd(effect, count=30)
    given = pushed(scene, np.zeros((30, 2)))
    size = np.linalg.norm(given, axis=1)
    assert np.isfinite(given).all() and (size > 0).all()
    directions = given / size[:, None]
    assert np.linalg.norm(directions.mean(axis=0)) < 0.35  # of 30 random ones: 0.16 +- 0.09
    assert len(np.unique(directions.round(6), axis=0)) == 30
    two = pushed(crowd(effect, count=2), np.zeros((2, 2)))
    if effect.kind == "circular_repulsion":
        assert np.allclose(two.sum(axis=0), 0, atol=1e-9)


def meeting(bias: float) -> Array:
    """Return where two agents on one line are after 12 s, if the first walks towards the second, which stands."""
    scene = crowd(
        Course(direction=(1, 0), group=0), Driving(tau=0.5), Sidestep(acceleration=4.5, radius=20, bias=bias),
        count=1, dt=0.01, desired_speed=1.3,
    )  # fmt: skip
    state = placed(scene, [[0.0, 0.0], [6.0, 0.0]])
    return scene.run(state, 1200).pos[0]


def test_a_side_bias_breaks_a_head_on_deadlock_to_the_right() -> None:
    """Without a bias, both agents stay on the line for ever (P31)."""
    still = meeting(0.0)
    assert (still[:, 1] == 0).all() and still[0, 0] < still[1, 0]
    passed = meeting(0.005)
    assert passed[0, 0] > passed[1, 0] + 2
    assert passed[0, 1] < -0.01 < 0.01 < passed[1, 1]


# --- presets ----------------------------------------------------------------------------------------------------------


def test_presets_have_the_published_values() -> None:
    """Values as published: docs/social_forces.md lists them."""
    published = {
        "helbing_molnar_1995": {"acceleration": 2.1 / 0.3, "decay": 0.3, "step": 2, "fov": 200, "outside": 0.5},
        "helbing_farkas_vicsek_2000": {"strength": 2000, "decay": 0.08, "anisotropy": 1, "bodies": True},
        "johansson_2007_circular": {"acceleration": 0.42, "decay": 1.65, "anisotropy": 0.12, "bodies": False},
        "johansson_2007_elliptical_1": {"acceleration": 0.11, "decay": 1.19, "anisotropy": 0.16, "relative": False},
        "johansson_2007_elliptical_2": {"acceleration": 0.04, "decay": 3.22, "anisotropy": 0.06, "relative": True},
        "moussaid_2009": {"acceleration": 4.5, "gamma": 0.35, "angular": 2, "forward": 3, "importance": 2},
        "moussaid_2010_groups": {"acceleration": 4.5, "gamma": 0.35, "angular": 2, "forward": 3, "importance": 2},
        "moussaid_2011": {"tau": 0.5, "radius": 10, "view": 75},
    }
    assert published.keys() == PRESETS.keys()
    for name, values in published.items():
        effects = preset(name)
        which = 0 if name == "moussaid_2011" else 1
        assert {key: getattr(effects[which], key) for key in values} == pytest.approx(values)
        assert PRESETS[name].source and PRESETS[name].symbols
        assert Group(count=5, **PRESETS[name].people).size == 5
    taus = {name: preset(name)[0].tau for name in PRESETS}
    assert {name for name, tau in taus.items() if tau != 0.5} == {"moussaid_2009", "moussaid_2010_groups"}
    solid = {
        e.kind: (e.stiffness, e.friction) for e in preset("helbing_2000") if isinstance(e, (Contact, ObstacleContact))
    }
    assert solid == {"contact": (1.2e5, 2.4e5), "obstacle_contact": (1.2e5, 2.4e5)}
    walls = {name: next((e for e in preset(name) if isinstance(e, ObstacleRepulsion)), None) for name in PRESETS}
    assert walls["helbing_molnar_1995"].acceleration * walls["helbing_molnar_1995"].decay == pytest.approx(10)  # U0
    assert (walls["moussaid_2009"].acceleration, walls["moussaid_2009"].decay) == (3, 0.1)
    group = preset("moussaid_2010", group=0)[0].behaviours[-1]
    assert (group.gaze, group.cohesion, group.repulsion) == (4, 3, 1)
    assert ALIASES.keys().isdisjoint(PRESETS)


TWO_GROUPS = """
dt: 0.001
groups:
  - {count: 9, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [0, 0], high: [9, 9]}}
  - {count: 9, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [0, 0], high: [9, 9]}}
effects:
"""


@pytest.mark.parametrize("name", [*PRESETS, *ALIASES])
def test_a_preset_in_yaml_stands_for_its_effects(name: str) -> None:
    scene = load_scene(
        f"{TWO_GROUPS}  - {{preset: {name}, group: 0}}\n  - {{preset: {name}, group: 1, occluded: true}}"
    )
    first, second = preset(name, group=0), preset(name, group=1, contacts=False, occluded=True)
    assert scene.effects == (*first, *second)  # contacts are listed once
    assert load_scene(dump_scene(scene)) == scene
    assert [effect.group for effect in scene.effects if isinstance(effect, Steer)] == [0, 1]


@pytest.mark.parametrize(
    ("items", "message"),
    [
        (["{preset: helbing_200}"], "text:7: effects[0].preset = 'helbing_200': unknown, did you mean `helbing_2000`?"),
        (["{kind: driving}", "{preset: moussaid_2009, grop: 1}"], "text:8: effects[1].grop = 1: unknown key, did you"),
        (
            ["{preset: helbing_2000}", "{kind: course, direction: [1, x]}"],
            "text:8: effects[1].direction[1] = 'x': must",
        ),
        (["{preset: helbing_2000, group: 2}"], "text:7: effects[0].group = 2: there are 2 groups, counted from 0"),
        (
            ["{preset: helbing_2000}", "{preset: moussaid_2011}"],
            "text:8: effects[1].preset = moussaid_2011: its contacts",
        ),
        (["{kind: circular_repulsion, decay: 1, radius: 2}"], "text:7: effects[0]: strength: missing"),
    ],
)
def test_a_wrong_preset_raises_an_error_of_one_line(items: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scene(TWO_GROUPS + "".join(f"  - {item}\n" for item in items))
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


def test_the_schema_lists_presets() -> None:
    listed = schema()["properties"]["effects"]["items"]["anyOf"]
    assert {"$ref": "#/$defs/Preset"} in listed


# --- steps ------------------------------------------------------------------------------------------------------------


def panic(count: int, group: int | None = None, **fields: Any) -> Scene:
    """Return pedestrians before a wall, under the preset of 2000."""
    return Scene(
        groups=(Group(count=count, mass=80, radius=0.3, desired_speed=1, spawn=Spawn(low=(0, 0), high=(9, 9))),),
        effects=(Course(direction=(1, 0)), *preset("helbing_2000", group=group)),
        obstacles=(Wall(vertices=((9, 0), (9, 9))),), **fields,
    )  # fmt: skip


def test_explicit_euler_at_10_ms_warns_with_its_stability_limit_and_rebound_speed() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        panic(1, dt=0.01, integrator=ExplicitEuler())
    kinds = {w.category: str(w.message) for w in caught}
    assert set(kinds) == {UnstableStepWarning, CoarseContactWarning}
    w2, sinks = 1.2e5 / 80, 2000 / 0.08 / 80
    assert suggest_dt_of(1) == pytest.approx(2 / (w2 + sinks), rel=0.01)  # (1 / tau) / w^2, with the repulsion in w^2
    coarse = kinds[CoarseContactWarning]
    assert f"do not come to rest above {2 / w2:.3g} s" in coarse  # 1.33 ms: the contact alone
    y = 0.01 * math.sqrt(w2)
    back = (1 + y * y) ** (math.pi / (2 * y))
    assert f"at this dt {back:.3g} times as fast as they went in" in coarse
    assert suggest_dt_of(5) == pytest.approx(2 / (3 * w2 + 3 * sinks), rel=0.01)  # a neighbour, and the wall


def suggest_dt_of(count: int) -> float:
    """Return the largest stable step of explicit Euler, s."""
    return suggest_dt(panic(count, dt=1e-5, integrator=ExplicitEuler())).dt


@pytest.mark.parametrize("group", [None, 0])
def test_obstacle_forces_do_not_bound_the_step_without_obstacles(group: int | None) -> None:
    """The limit of two agents is that of contact and repulsion, each twice as stiff between two."""
    w2, sinks = 1.2e5 / 80, 2000 / 0.08 / 80
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = panic(2, group=group, dt=1e-5, integrator=ExplicitEuler()).model_copy(update={"obstacles": ()})
    assert suggest_dt(scene).dt == pytest.approx(2 / (2 * w2 + 2 * sinks), rel=0.01)


@pytest.mark.slow
def test_contact_and_repulsion_act_on_agents_wider_than_the_preset_s_radius() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = Scene(
            groups=(Group(count=2, mass=80, radius=0.9, desired_speed=1, spawn=Spawn(low=(0, 0), high=(9, 9))),),
            effects=preset("helbing_2000"), dt=1e-4,
        )  # fmt: skip
        given = scene.acceleration(scene.start(0).with_motion(np.array([[[0.0, 0], [1.5, 0]]]), np.zeros((1, 2, 2))))
    assert -given[0, 0, 0] == pytest.approx((2000 * math.exp(0.3 / 0.08) + 1.2e5 * 0.3) / 80, rel=1e-3)


def test_semi_implicit_euler_at_10_ms_is_stable_with_and_without_a_group() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", CoarseContactWarning)  # a contact lasts for 6 steps: the rebound is inexact
        ungrouped = panic(9, dt=0.01, integrator=SemiImplicitEuler())
        steered = panic(9, group=0, dt=0.01, integrator=SemiImplicitEuler())
    assert suggest_dt(steered).dt == pytest.approx(suggest_dt(ungrouped).dt)
    assert 0.025 < suggest_dt(ungrouped).dt < 0.035


# --- slow: kernels of their own ---------------------------------------------------------------------------------------


def by_the_paper(k: int, pos: Array, vel: Array, aim: Array, v0: float, walls: Array, p: Heuristics) -> Array | None:
    """Return the acceleration of agent k by the definitions of the 2011 paper, or None if two directions tie."""
    radius, heading = 0.25, vel[k] / np.linalg.norm(vel[k])
    angles = np.radians(np.linspace(-p.view, p.view, 31))
    directions = [
        np.array([c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]])
        for c, s in zip(np.cos(angles), np.sin(angles), strict=True)
    ]
    directions = ([aim] if heading @ aim >= math.cos(math.radians(p.view)) else []) + directions
    times = np.linspace(0, p.radius, 4001)

    def first(direction: Array, others: Array) -> float:
        """Return the distance to the first contact with an agent or a wall, m, found in small steps."""
        path = pos[k] + times[:, None] * direction
        touched = np.zeros(len(times), bool)
        for j in range(len(pos)):
            if j != k:
                gap = np.linalg.norm(path - pos[j] - times[:, None] / v0 * others[j], axis=1)
                touched |= gap < 2 * radius
        for a, b in walls:
            share = np.clip(((path - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
            touched |= np.linalg.norm(path - a - share[:, None] * (b - a), axis=1) < radius
        return float(times[np.argmax(touched)]) if touched.any() else p.radius

    costs = []
    for direction in directions:
        f = first(direction, vel)
        costs.append(p.radius**2 + f**2 - 2 * p.radius * f * (aim @ direction))
    if np.sort(costs)[1] < min(costs) + 0.05:  # a difference below the error of the small steps
        return None
    best = directions[int(np.argmin(costs))]
    ahead = first(best, 0 * vel)
    return (min(v0, ahead / p.tau) * best - vel[k]) / p.tau


@pytest.mark.slow
def test_heuristics_minimise_the_cost_of_the_paper() -> None:
    corners = np.array([[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]])
    law = Heuristics(radius=6)
    room = Polygon(vertices=tuple(map(tuple, corners.tolist())), hollow=True)
    scene = Scene(
        groups=(Group(count=9, mass=80, radius=0.25, desired_speed=1.3, spawn=Spawn(low=(-3, -3), high=(3, 3))),),
        effects=(Course(direction=(1, 0)), law), obstacles=(room,), dt=1e-3,
    )  # fmt: skip
    walls = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    rng, checked = np.random.default_rng(6), 0
    for _ in range(6):
        state = scene.start(int(rng.integers(1000)))
        state.vel[0] = rng.normal((0.7, 0), 1, (9, 2))
        gaps = np.linalg.norm(state.pos[0][:, None] - state.pos[0][None], axis=2) + 9 * np.eye(9)
        after = scene.step(state)
        for k in range(9):
            if gaps[k].min() > 0.55:
                expected = by_the_paper(k, state.pos[0], state.vel[0], np.array([1.0, 0.0]), 1.3, walls, law)
                if expected is None:
                    continue
                given = (after.vel[0, k] - state.vel[0, k]) / scene.dt
                assert np.allclose(given, expected, atol=0.02), (k, given, expected)
                checked += 1
    assert checked > 20


@pytest.mark.slow
def test_heuristics_go_straight_in_free_space_and_pass_an_obstacle_on_the_right() -> None:
    pillar = Wall(vertices=((0, -0.2), (0, 0.2)))
    scene = Scene(
        groups=(Group(count=2, mass=80, radius=0.25, desired_speed=1.3, spawn=Spawn(low=(-9, -9), high=(9, 9))),),
        effects=(Goal(target=(8, 0)), Heuristics()), obstacles=(pillar,), dt=0.02,
    )  # fmt: skip
    free = scene.run(placed(scene, [[1.0, 3.0], [60.0, 60.0]]), 200)
    to = np.array([8.0, 0.0]) - free.pos[0, 0]
    assert np.linalg.norm(free.vel[0, 0]) == pytest.approx(1.3, rel=1e-3)
    assert free.vel[0, 0] @ to == pytest.approx(np.linalg.norm(free.vel[0, 0]) * np.linalg.norm(to), rel=1e-6)
    state, path = placed(scene, [[-4.0, 0.0], [60.0, 60.0]], [[1.3, 0.0], [0.0, 0.0]]), []
    for _ in range(500):
        state = scene.step(state)
        path.append(state.pos[0, 0].copy())
    past = np.array(path)
    assert past[-1, 0] > 7 and past[:, 1].min() < -0.4 and past[:, 1].max() < 0.2  # it overshoots the goal
    assert pillar.gap(past).min() > 0.2
