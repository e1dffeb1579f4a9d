"""Steering around shapes, along walls, within them, and by the way around them: each alone in a small scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import (
    AvoidObstacles,
    Cohesion,
    Contain,
    FollowWall,
    FollowWay,
    ForceField,
    MatchVelocity,
    Seek,
    Whiskers,
)
from flockenv.behaviours.steer import Steer
from flockenv.geometry.eikonal import way_table
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace, Polygon, Shape, Wall
from flockenv.geometry.targets import Target
from flockenv.maths.grid import sampled
from flockenv.model.spawn import Spawn
from flockenv.physics import floor_fields as way_module
from flockenv.physics.constraints import Collisions
from flockenv.scene import Group, Scene

UNDER = (
    AvoidObstacles(weight=8, horizon=2, margin=0.1),
    Whiskers(weight=20, horizon=1.5),
    ForceField(weight=2, range=2),
    FollowWall(weight=8, distance=0.8, time=0.25, range=4, speed=2),
    Seek(weight=4, target=(12, 0), speed=2),
)
"""One kernel serves for all of these: who is not chosen is idle."""

# every form of shape, far away: which forms there are is compiled in, where they are is not
FAR = (Circle(centre=(500, 0), radius=1), Capsule(start=(500, 5), end=(501, 5)), Block(centre=(500, 9), size=(1, 1)),
       HalfSpace(point=(700, 0), direction=(-1, 0)))  # fmt: skip


def scene(
    *chosen: Any, obstacles: tuple[Shape, ...], at: Any = (0.0, 0.0), v: Any = (2.0, 0.0), **fields: Any
) -> Scene:
    """One agent under some of UNDER, among obstacles."""
    kinds = {type(effect): effect for effect in chosen}
    effects = tuple(kinds.get(type(effect), effect.idle()) for effect in UNDER)
    speed = math.hypot(*v)
    spawn = Spawn(low=at, high=at, speed=(speed, speed), heading=v if speed else None)
    group = Group(count=1, radius=0.2, max_speed=2, max_force=30, spawn=spawn)
    return Scene(groups=(group,), effects=effects, obstacles=(*obstacles, *FAR), **{"dt": 0.02} | fields)


def wish(*chosen: Any, **fields: Any) -> Any:
    """The force of one agent of 1 kg in its first step, by the kernel that moves it: nothing else is compiled."""
    made = scene(*chosen, **fields)
    free = made.model_copy(
        update={"groups": (made.groups[0].model_copy(update={"max_speed": None, "max_force": None}),)}
    )
    start = free.start(0)
    return (free.step(start).vel - start.vel)[0, 0] / made.dt


def path(made: Scene, seconds: float) -> tuple[Any, Any]:
    """Positions (T, 2) and velocities of the only agent, every five steps."""
    state, steps = made.start(0), round(seconds / made.dt / 5)
    x, v = [], []
    for _ in range(steps):
        state = made.run(state, 5)
        x.append(state.pos[0, 0].copy())
        v.append(state.vel[0, 0].copy())
    return np.array(x), np.array(v)


AVOID, WHISKERS, FIELD, FOLLOW, SEEK = UNDER
WALL = HalfSpace(point=(0, -0.6), direction=(0, 1))
L = Polygon(vertices=((0, 0), (6, 0), (6, 5), (3, 5), (3, 3), (0, 3)))
SOLIDS = {
    "circle": Circle(centre=(5, 0.3), radius=1),
    "capsule": Capsule(start=(4, 1), end=(5, -1), radius=0.3),
    "wall": Wall(vertices=((5, -1), (4, 0.5), (5, 1)), radius=0.1),
    "convex": Polygon(vertices=((4, -1), (5.5, 0), (4.2, 1.2))),
    "block": Block(centre=(5, 0.2), size=(1, 2), turn=20),
}


# --- to avoid ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SOLIDS)
def test_it_passes_whatever_shape_is_in_the_way(kind: str) -> None:
    x, v = path(scene(AVOID, obstacles=(SOLIDS[kind],)), 6)
    assert SOLIDS[kind].gap(x).min() > 0.2  # its radius
    assert x[-1, 0] > 6
    assert np.linalg.norm(v, axis=1).min() > 1.9  # it steers and does not brake


@pytest.mark.parametrize(
    "shape", [WALL, Block(centre=(0, -1.6), size=(90, 2)), Capsule(start=(-50, -0.8), end=(50, -0.8), radius=0.2)]
)
def test_along_a_wall_to_avoid_is_exactly_zero_and_the_force_field_is_not(shape: Shape) -> None:
    """The second of two hard cases. The wall is 0.4 m beside the body."""
    np.testing.assert_array_equal(wish(AVOID, obstacles=(shape,)), 0)
    push = wish(FIELD, obstacles=(shape,))
    np.testing.assert_allclose(push, [0, 2 / 0.4**2], atol=1e-9)


def test_head_on_the_force_field_stalls_and_to_avoid_passes() -> None:
    """The first: an exact line through the centre. The seeker's force and the field's balance in front of it."""
    ahead = Circle(centre=(5, 0), radius=1)
    x, v = path(scene(FIELD, SEEK, obstacles=(ahead,)), 30)
    assert np.linalg.norm(v[-1]) < 1e-3
    assert x[-1, 0] < 4
    assert x[-1, 1] == 0
    # where it stands F = w / d^2 of the field is w V of the seeker
    assert 4 - 0.2 - x[-1, 0] == pytest.approx(math.sqrt(2 / (4 * 2)), rel=1e-3)
    x, v = path(scene(AVOID.model_copy(update={"weight": 25}), SEEK, obstacles=(ahead,)), 10)
    assert ahead.gap(x).min() > 0.2
    assert np.abs(x[:, 0] - 12).min() < 0.5


def test_of_a_circle_it_is_reynolds_own_rule() -> None:
    """-unit(lateral offset) w; and the same around a polygon with so many corners that it is round."""
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = np.stack([5 + np.cos(turn), 0.3 + np.sin(turn)], axis=1)
    expected = [0, -8]
    np.testing.assert_allclose(wish(AVOID, obstacles=(SOLIDS["circle"],)), expected, atol=1e-12)
    round_one = Polygon(vertices=tuple(map(tuple, ring.tolist())))
    np.testing.assert_allclose(wish(AVOID, obstacles=(round_one,)), expected, atol=1e-12)


@pytest.mark.parametrize("effect", [AVOID, WHISKERS])
def test_the_horizon_and_the_body_count(effect: Any) -> None:
    """It reacts from where its body comes within the horizon; both radii count (OpenSteer: twice its own)."""
    near = effect.horizon * 2 + 0.2 + getattr(effect, "margin", 0)
    for offset, reacts in ((-0.01, True), (0.01, False)):
        wall = Block(centre=(near + 1 + offset, 0), size=(2, 8))
        assert wish(effect, obstacles=(wall,)).any() == reacts
    margin = getattr(effect, "margin", 0)
    for offset, reacts in ((-0.01, True), (0.01, False)):
        if effect is AVOID:
            stone = Circle(centre=(2, 0.2 + 0.7 + margin + offset), radius=0.7)
            assert wish(effect, obstacles=(stone,)).any() == reacts


def test_whoever_is_inside_is_led_straight_out() -> None:
    for shape in (Block(centre=(0, 0.4), size=(4, 1)), Polygon(vertices=((-2, -0.1), (2, -0.1), (2, 3), (-2, 3)))):
        np.testing.assert_allclose(wish(AVOID, obstacles=(shape,)), [0, -8], atol=1e-9)
        assert wish(FIELD, obstacles=(shape,))[1] < 0


@pytest.mark.slow
@pytest.mark.parametrize("effect", UNDER[:4])
def test_it_is_finite_in_the_middle_at_rest_and_head_on(effect: Any) -> None:
    for shape in (*SOLIDS.values(), WALL, L):
        for at in (shape.anchor, (0.0, 0.0), tuple(map(float, shape.nearest((0.0, 0.0))))):
            for v in ((0.0, 0.0), (2.0, 0.0)):
                assert np.isfinite(wish(effect, obstacles=(shape,), at=at, v=v)).all()


def test_two_in_one_place_avoid_alike() -> None:
    made = scene(AVOID, obstacles=(SOLIDS["block"],))
    twins = made.model_copy(update={"groups": (made.groups[0].model_copy(update={"count": 2}),)})
    both = twins.step(twins.start(0)).vel[0]
    np.testing.assert_array_equal(both[0], both[1])


# --- whiskers ---------------------------------------------------------------------------------------------------------


def test_a_whisker_pushes_along_the_normal_by_how_deep_it_is() -> None:
    """A wall at a slant: a whisker, 3 m long, enters after t m; F = w (1 - t / 3) (n + unit(lateral n))."""
    n = np.array([-math.cos(0.5), math.sin(0.5)])
    slant = HalfSpace(point=(2, 0), direction=tuple(n))
    # a whisker that points more at the wall enters earlier: the deepest counts
    turn = math.radians(35)
    ways = [np.array([math.cos(a), math.sin(a)]) for a in (0, turn, -turn)]
    first = min((2 * -n[0] - 0.2) / (-way @ n) for way in ways if way @ n < 0)
    np.testing.assert_allclose(wish(WHISKERS, obstacles=(slant,)), 20 * (1 - first / 3) * np.add(n, [0, 1]), rtol=1e-9)


def test_whiskers_head_on_do_not_only_brake() -> None:
    x, _ = path(scene(WHISKERS, obstacles=(Circle(centre=(5, 0), radius=1),)), 6)
    assert Circle(centre=(5, 0), radius=1).gap(x).min() > 0.2
    assert np.abs(x[:, 1]).max() > 0.5


@pytest.mark.slow
def test_in_space_whiskers_feel_above_and_below_too() -> None:
    """A level flight 0.5 m below a ceiling, or above a floor: the middle and the side whiskers touch nothing."""
    ahead = Spawn(low=(0, 0, 0), high=(0, 0, 0), speed=(2, 2), heading=(1, 0, 0))
    group = Group(count=1, radius=0.2, spawn=ahead)
    for up in (1, -1):
        ceiling = Block(centre=(0, 0, 1.5 * up), size=(90, 90, 2))
        made = Scene(dimension=3, groups=(group,), effects=(WHISKERS,), obstacles=(ceiling,))
        # it enters 0.3 m further up, after 0.3 / sin 35 of its 3 m; the normal is across, so is its lateral part
        share = 1 - 0.3 / math.sin(math.radians(35)) / 3
        np.testing.assert_allclose(
            made.acceleration(made.start(0))[0, 0], [0, 0, -2 * up * 20 * share], rtol=1e-9, atol=1e-9
        )


# --- a force field ----------------------------------------------------------------------------------------------------


def test_in_a_corridor_the_force_field_of_both_walls_leads_to_the_middle_without_chatter() -> None:
    """The nearest wall alone pushes to and fro."""
    walls = (HalfSpace(point=(0, -0.9), direction=(0, 1)), HalfSpace(point=(0, 0.9), direction=(0, -1)))
    np.testing.assert_allclose(wish(FIELD, obstacles=walls), 0, atol=1e-12)
    x, v = path(scene(FIELD, SEEK, obstacles=walls, at=(0.0, 0.3)), 6)
    late = slice(3 * len(x) // 4, None)
    assert np.abs(x[late, 1]).max() < 1e-3
    assert np.abs(v[late, 1]).max() < 1e-3


# --- wall following ---------------------------------------------------------------------------------------------------


def along(made: Scene, shape: Shape, seconds: float, settled: float) -> tuple[Any, Any]:
    x, v = path(made, seconds)
    keep = np.arange(len(x)) * 5 * made.dt > settled
    return shape.gap(x[keep]), np.linalg.norm(v[keep], axis=1)


def test_it_holds_its_distance_to_a_straight_wall() -> None:
    gap, speed = along(scene(FOLLOW, obstacles=(WALL,), at=(0, 1)), WALL, 12, 4)
    np.testing.assert_allclose(gap, 0.8, rtol=1e-3)
    np.testing.assert_allclose(speed, 2, rtol=1e-3)


def test_it_holds_its_distance_around_convex_corners_within_five_percent() -> None:
    block = Block(centre=(3, 3), size=(6, 4))
    gap, speed = along(scene(FOLLOW, obstacles=(block,), at=(3, 0.2)), block, 40, 3)
    assert np.abs(gap / 0.8 - 1).max() < 0.05
    assert speed.min() > 1.8


def test_it_turns_in_a_concave_corner_without_touching_and_goes_on_around() -> None:
    made = scene(FOLLOW, obstacles=(L,), at=(0, -0.8))
    x, _ = path(made, 40)
    assert L.gap(x).min() > 0.5
    on = np.abs(L.gap(x) / 0.8 - 1) < 0.05
    assert on.mean() > 0.85  # but for the way through the corner
    for corner in ((6, 5), (3, 5), (0, 3), (0, 0), (6, 0)):
        assert np.linalg.norm(x - corner, axis=1).min() < 1


def test_it_sets_out_from_rest_with_the_wall_on_its_right_and_sees_no_wall_that_is_far() -> None:
    resting = {"at": (0.0, 0.2), "v": (0.0, 0.0)}
    _, v = path(scene(FOLLOW, obstacles=(WALL,), **resting), 3)
    assert v[-1] == pytest.approx([2, 0], abs=1e-3)  # the wall, below, is on the right of who goes to +x
    far = HalfSpace(point=(0, -9), direction=(0, 1))
    np.testing.assert_array_equal(wish(FOLLOW, obstacles=(far,)), 0)


# --- containment ------------------------------------------------------------------------------------------------------

ROOM = Polygon(vertices=((0, 0), (8, 0), (8, 8), (4, 6), (0, 8)))


def contained(within: Shape, at: Any, v: Any, count: int = 1) -> Scene:
    speed = math.hypot(*v)
    low, high = (at, at) if count == 1 else ((2.5, 2.5), (5.5, 5.5))
    spawn = Spawn(low=low, high=high, speed=(speed, speed), heading=v if speed and count == 1 else None)
    group = Group(count=count, radius=0.2, max_speed=2, max_force=12, spawn=spawn)
    return Scene(groups=(group,), effects=(Contain(weight=6, within=within, time=1.0),), dt=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("within", [ROOM, Block(centre=(4, 4), size=(8, 8))])
def test_it_asks_for_nothing_while_the_place_ahead_is_inside(within: Shape) -> None:
    still_inside, leaving = contained(within, (4, 3), (1.7, 0)), contained(within, (6, 3), (1.9, 0))
    np.testing.assert_array_equal(still_inside.acceleration(still_inside.start(0)), 0)
    assert leaving.acceleration(leaving.start(0)).any()


def test_head_on_it_brakes_and_keeps_right() -> None:
    made = contained(ROOM, (6.5, 3), (1.9, 0))
    force = made.acceleration(made.start(0))[0, 0]
    assert force[0] < 0
    assert force[1] < 0
    np.testing.assert_allclose(force / np.linalg.norm(force), np.array([-1.9, -2]) / math.hypot(1.9, 2), atol=1e-9)


@pytest.mark.parametrize(
    "within",
    [
        ROOM,
        pytest.param(Circle(centre=(4, 4), radius=3.5), marks=pytest.mark.slow),
        pytest.param(Block(centre=(4, 4), size=(7, 6), turn=30), marks=pytest.mark.slow),
    ],
)
def test_nobody_leaves(within: Shape) -> None:
    made = contained(within, (4, 3), (2, 0), count=60)
    state, worst = made.start(3), -np.inf
    for _ in range(200):
        state = made.run(state, 5)
        worst = max(worst, float(within.gap(state.pos[0]).max()))
    assert worst < 0, "a centre came through the wall"


def stand_out(dt: float, seconds: float, walls: bool = False) -> float:
    """Return how far 40 bodies of radius 0.2 m stand out of ROOM at most, m."""
    made = contained(ROOM, (4, 3), (2, 0), count=40).model_copy(update={"dt": dt})
    if walls:
        room = ROOM.model_copy(update={"hollow": True})
        fields = {"groups": made.groups, "effects": made.effects, "dt": dt}
        made = Scene(**fields, obstacles=(room,), constraints=(Collisions(restitution=0),))
    state, worst = made.start(0), -np.inf
    for _ in range(round(seconds / dt)):
        state = made.step(state)
        worst = max(worst, float(ROOM.gap(state.pos[0]).max()) + 0.2)
    return worst


@pytest.mark.slow
def test_bodies_stand_out_by_less_the_shorter_the_step() -> None:
    coarse, fine = stand_out(0.04, 20), stand_out(0.005, 20)
    assert 0 < coarse < 2 * 0.04 * 0.6  # max_speed dt / 2, and a little
    assert fine < coarse / 4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")  # in the jam they run to
def test_no_body_stands_out_of_a_hollow_obstacle_with_collisions() -> None:
    assert stand_out(0.02, 20, walls=True) < 1e-6


def test_from_outside_it_comes_straight_back() -> None:
    made = contained(ROOM, (10, 3), (0, 0))
    np.testing.assert_allclose(made.acceleration(made.start(0))[0, 0], [-12, 0], atol=1e-9)


@pytest.mark.parametrize("at", [(4.0, 3.0), (8.0, 3.0), (8.0, 8.0), (50.0, 50.0)])
def test_containment_is_finite_everywhere(at: Any) -> None:
    for v in ((0.0, 0.0), (2.0, 0.0)):
        made = contained(ROOM, at, v)
        assert np.isfinite(made.acceleration(made.start(0))).all()


def test_what_has_no_inside_contains_nobody() -> None:
    with pytest.raises(ValueError, match=r"within.kind = half_space: must be one of circle, block, polygon"):
        Contain(weight=1, within=WALL)


# --- the way around everything ----------------------------------------------------------------------------------------


def test_the_way_around_a_circle_is_tangents_and_an_arc() -> None:
    """Closed form; errors are of first order in the spacing."""
    goal, errors = np.array([3.0, 0.0]), []
    x = np.random.default_rng(0).uniform(-5, 5, (400, 2))
    x = x[np.linalg.norm(x, axis=1) > 1.25]
    d = np.linalg.norm(x, axis=1)
    arc = np.arccos(np.clip(x @ goal / (d * 3), -1, 1)) - np.arccos(1 / d) - math.acos(1 / 3)
    exact = np.where(arc <= 0, np.linalg.norm(x - goal, axis=1), np.sqrt(d**2 - 1) + math.sqrt(8) + arc)
    for spacing in (0.2, 0.1, 0.05):
        table = way_table([Circle(centre=(0, 0), radius=1.0)], [Target(at=goal)], (-5, -5), (5, 5), spacing, 0.0)
        errors.append(np.abs(sampled(table, x)[:, 0] - exact).mean())
    assert errors[2] < 0.05
    assert errors[0] > 1.4 * errors[1] > 1.4 * 1.4 * errors[2]


def test_in_free_space_the_way_is_straight() -> None:
    goal = np.array([1.0, 2.0, 0.5])
    table = way_table([], [Target(at=goal)], (-2, -2, -2), (3, 4, 3), 0.25, 0.0)
    x = np.random.default_rng(1).uniform(-1.5, 2.5, (200, 3))
    found = sampled(table, x)
    straight = goal - x
    distance = np.linalg.norm(straight, axis=1)
    np.testing.assert_allclose(found[:, 0], distance, rtol=0.08)
    cosine = (found[:, 1:] * straight).sum(axis=1) / distance / np.linalg.norm(found[:, 1:], axis=1)
    assert np.quantile(cosine[distance > 0.5], 0.02) > 0.97


TRAP = Wall(vertices=((4, -2), (8, -2), (8, 2), (4, 2)), radius=0.2)


def trapped(*effects: Any) -> Scene:
    spawn = Spawn(low=(1, -0.8), high=(2, 0.8))
    group = Group(count=8, radius=0.2, max_speed=2, max_force=12, spawn=spawn)
    return Scene(groups=(group,), effects=(Steer(behaviours=effects),), obstacles=(TRAP,), dt=0.02)


def arrived(made: Scene, seconds: float) -> tuple[float, float]:
    state, clear = made.start(0), np.inf
    for _ in range(round(seconds / 0.1)):
        state = made.run(state, 5)
        clear = min(clear, float(TRAP.gap(state.pos[0]).min()))
    return float((np.linalg.norm(state.pos[0] - (12, 0), axis=1) < 0.5).mean()), clear


@pytest.mark.slow
def test_in_a_u_local_steering_is_caught_and_the_global_way_leads_around() -> None:
    local = AvoidObstacles(weight=12, horizon=1, margin=0.1)
    there, _ = arrived(trapped(local, Seek(weight=4, target=(12, 0))), 30)
    assert there == 0
    there, clear = arrived(trapped(local, FollowWay(weight=4, target=(12, 0), clearance=0.4)), 30)
    assert there == 1
    assert clear > 0.2


@pytest.mark.slow
def test_it_stops_at_its_target_and_beyond_the_grid_goes_straight() -> None:
    way = FollowWay(weight=4, target=(3, 0), margin=1)
    group = Group(count=1, radius=0.1, max_speed=2, spawn=Spawn(low=(0, 0), high=(0, 0)))
    made = Scene(groups=(group,), effects=(way,), dt=0.02)
    end = made.run(made.start(0), 600)
    np.testing.assert_allclose(end.pos[0, 0], (3, 0), atol=0.01)
    assert np.linalg.norm(end.vel) < 0.01
    far = made.start(0)
    far.pos[0, 0] = (3, 500)
    np.testing.assert_allclose(made.acceleration(far)[0, 0], (0, -8), atol=1e-9)


def test_a_way_is_found_once_for_a_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refusing what cannot be, building the scene, drawing it: all of them ask for the same grid."""
    solved: list[Any] = []
    monkeypatch.setattr(way_module, "way_table", lambda *given: solved.append(given) or way_table(*given))
    made = trapped(FollowWay(weight=4, target=(12, 0), clearance=0.4))
    assert made.parts.tables
    assert len(solved) == 1
    made.with_effects(FollowWay(weight=4, target=(12, 0), clearance=0.3))  # another way is another grid
    assert len(solved) == 2


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"target": (5, 2)},
            r"effects\[0\]\.behaviours\[0\]\.target = \(5.0, 2.0\): is -0.2 m from an obstacle, must be at least 0.3 m",
        ),
        ({"spacing": 1e-5}, "points, at most"),
        ({"target": (1, 2, 3)}, "dimension = 2"),
    ],
)
def test_a_way_that_cannot_be_is_refused(change: Any, text: str) -> None:
    fields = {"weight": 1, "target": (12, 0), **change}
    with pytest.raises(ValueError, match=text):
        trapped(FollowWay(**fields))


# --- who is hidden ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["circle", "block", "wall"])
def test_nobody_is_drawn_to_whom_an_obstacle_hides(kind: str) -> None:
    """Forces are not applied if there are obstacles in the way."""
    spots = ((0.0, 0.0), (2.0, 0.0), (0.0, 2.0))
    groups = tuple(Group(count=1, radius=0.05, spawn=Spawn(low=spot, high=spot)) for spot in spots)
    effects = (Cohesion(weight=1, radius=5, occluded=True),)

    def force(obstacle: Shape) -> Any:
        made = Scene(groups=groups, effects=effects, obstacles=(obstacle, *FAR))
        return made.acceleration(made.start(0))[0, 0]

    hiding, aside, beyond, behind = SCREENS[kind]
    np.testing.assert_allclose(force(hiding), [0, 2], atol=1e-12)
    for harmless in (aside, beyond, behind):
        np.testing.assert_allclose(force(harmless), [1, 1], atol=1e-12)


SCREENS: dict[str, tuple[Shape, ...]] = {
    "circle": tuple(Circle(centre=at, radius=0.5) for at in ((1, 0.2), (1, -0.6), (3, 0), (-1, 0))),
    "block": tuple(Block(centre=at, size=(0.2, 2)) for at in ((1, 0), (1, -1.2), (3, 0), (-1, 0))),
    "wall": tuple(Wall(vertices=((x, -1), (x, high))) for x, high in ((1, 0.1), (1, -0.1), (3, 1), (-1, 1))),
}
"""What stands between me and whom is at (2, 0), beside the way to him, beyond him, and behind me."""


@pytest.mark.slow
def test_who_is_hidden_is_not_the_nearest() -> None:
    """A behaviour about the nearest one is about the nearest that it sees: who is hidden takes nobody's place."""
    group = Group(count=3, radius=0.05, spawn=Spawn(low=(0, 0), high=(0, 0)))
    screen = Circle(centre=(1, 0), radius=0.5)

    def force(occluded: bool) -> Any:
        effect = MatchVelocity(weight=2, radius=9, occluded=occluded)
        made = Scene(groups=(group,), effects=(effect,), obstacles=(screen,))
        state = made.start(0)
        state.pos[0], state.vel[0] = [(0, 0), (2, 0), (0, 3)], [(0, 0), (1, 0), (0, 1)]
        return made.acceleration(state)[0, 0]

    np.testing.assert_allclose(force(occluded=True), [0, 2], atol=1e-12)
    np.testing.assert_allclose(force(occluded=False), [2, 0], atol=1e-12)
