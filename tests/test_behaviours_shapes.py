"""Steering around shapes, along walls, within regions and by floor fields, each alone in a small scene."""

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
from flockenv.geometry.eikonal import floor_field_table
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace, Polygon, Shape, Wall
from flockenv.geometry.targets import Target
from flockenv.maths.grid import sample_points
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
"""Effects that share one kernel: those that a test does not choose are idle."""

# one shape of every kind, far away: kinds are compiled in, positions are not
FAR = (Circle(centre=(500, 0), radius=1), Capsule(start=(500, 5), end=(501, 5)), Block(centre=(500, 9), size=(1, 1)),
       HalfSpace(point=(700, 0), direction=(-1, 0)))  # fmt: skip


def scene(
    *chosen: Any, obstacles: tuple[Shape, ...], at: Any = (0.0, 0.0), v: Any = (2.0, 0.0), **fields: Any
) -> Scene:
    """Return a scene of one agent under the chosen effects of UNDER, among obstacles."""
    kinds = {type(effect): effect for effect in chosen}
    effects = tuple(kinds.get(type(effect), effect.idle_copy()) for effect in UNDER)
    speed = math.hypot(*v)
    spawn = Spawn(low=at, high=at, speed=(speed, speed), heading=v if speed else None)
    group = Group(count=1, radius=0.2, max_speed=2, max_force=30, spawn=spawn)
    return Scene(groups=(group,), effects=effects, obstacles=(*obstacles, *FAR), **{"dt": 0.02} | fields)


def steer(*chosen: Any, **fields: Any) -> Any:
    """Return the force on an agent of 1 kg in its first step, N; no other kernel is compiled for it."""
    made = scene(*chosen, **fields)
    free = made.model_copy(
        update={"groups": (made.groups[0].model_copy(update={"max_speed": None, "max_force": None}),)}
    )
    start = free.start(0)
    return (free.step(start).vel - start.vel)[0, 0] / made.dt


def path(made: Scene, seconds: float) -> tuple[Any, Any]:
    """Return positions (T, 2) and velocities of the only agent, every five steps."""
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


# --- obstacle avoidance -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SOLIDS)
def test_an_agent_passes_a_shape_on_its_path_without_braking(kind: str) -> None:
    x, v = path(scene(AVOID, obstacles=(SOLIDS[kind],)), 6)
    assert SOLIDS[kind].gap(x).min() > 0.2  # the agent's radius
    assert x[-1, 0] > 6
    assert np.linalg.norm(v, axis=1).min() > 1.9


@pytest.mark.parametrize(
    "shape", [WALL, Block(centre=(0, -1.6), size=(90, 2)), Capsule(start=(-50, -0.8), end=(50, -0.8), radius=0.2)]
)
def test_along_a_wall_avoidance_is_exactly_zero_and_the_force_field_is_not(shape: Shape) -> None:
    """The wall is 0.4 m beside the body."""
    np.testing.assert_array_equal(steer(AVOID, obstacles=(shape,)), 0)
    push = steer(FIELD, obstacles=(shape,))
    np.testing.assert_allclose(push, [0, 2 / 0.4**2], atol=1e-9)


def test_head_on_the_force_field_stalls_and_avoidance_passes() -> None:
    """The path leads through the centre of a circle; in front of it the forces of Seek and of the field balance."""
    ahead = Circle(centre=(5, 0), radius=1)
    x, v = path(scene(FIELD, SEEK, obstacles=(ahead,)), 30)
    assert np.linalg.norm(v[-1]) < 1e-3
    assert x[-1, 0] < 4
    assert x[-1, 1] == 0
    # at rest, F = w / d^2 of the field equals w V of Seek
    assert 4 - 0.2 - x[-1, 0] == pytest.approx(math.sqrt(2 / (4 * 2)), rel=1e-3)
    x, v = path(scene(AVOID.model_copy(update={"weight": 25}), SEEK, obstacles=(ahead,)), 10)
    assert ahead.gap(x).min() > 0.2
    assert np.abs(x[:, 0] - 12).min() < 0.5


def test_avoidance_of_a_circle_is_the_rule_of_reynolds() -> None:
    """F = -w unit(lateral offset), also for a polygon of 720 corners."""
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = np.stack([5 + np.cos(turn), 0.3 + np.sin(turn)], axis=1)
    expected = [0, -8]
    np.testing.assert_allclose(steer(AVOID, obstacles=(SOLIDS["circle"],)), expected, atol=1e-12)
    round_one = Polygon(vertices=tuple(map(tuple, ring.tolist())))
    np.testing.assert_allclose(steer(AVOID, obstacles=(round_one,)), expected, atol=1e-12)


@pytest.mark.parametrize("effect", [AVOID, WHISKERS])
def test_an_agent_reacts_once_its_body_is_within_the_horizon(effect: Any) -> None:
    """The radii of agent and obstacle both count (OpenSteer: twice the agent's own)."""
    near = effect.horizon * 2 + 0.2 + getattr(effect, "margin", 0)
    for offset, reacts in ((-0.01, True), (0.01, False)):
        wall = Block(centre=(near + 1 + offset, 0), size=(2, 8))
        assert steer(effect, obstacles=(wall,)).any() == reacts
    margin = getattr(effect, "margin", 0)
    for offset, reacts in ((-0.01, True), (0.01, False)):
        if effect is AVOID:
            stone = Circle(centre=(2, 0.2 + 0.7 + margin + offset), radius=0.7)
            assert steer(effect, obstacles=(stone,)).any() == reacts


def test_an_agent_inside_a_shape_is_steered_straight_out() -> None:
    for shape in (Block(centre=(0, 0.4), size=(4, 1)), Polygon(vertices=((-2, -0.1), (2, -0.1), (2, 3), (-2, 3)))):
        np.testing.assert_allclose(steer(AVOID, obstacles=(shape,)), [0, -8], atol=1e-9)
        assert steer(FIELD, obstacles=(shape,))[1] < 0


@pytest.mark.slow
@pytest.mark.parametrize("effect", UNDER[:4])
def test_steering_is_finite_inside_and_on_shapes_at_rest_and_in_motion(effect: Any) -> None:
    for shape in (*SOLIDS.values(), WALL, L):
        for at in (shape.anchor, (0.0, 0.0), tuple(map(float, shape.nearest((0.0, 0.0))))):
            for v in ((0.0, 0.0), (2.0, 0.0)):
                assert np.isfinite(steer(effect, obstacles=(shape,), at=at, v=v)).all()


def test_two_agents_in_one_place_avoid_obstacles_equally() -> None:
    made = scene(AVOID, obstacles=(SOLIDS["block"],))
    twins = made.model_copy(update={"groups": (made.groups[0].model_copy(update={"count": 2}),)})
    both = twins.step(twins.start(0)).vel[0]
    np.testing.assert_array_equal(both[0], both[1])


# --- whiskers ---------------------------------------------------------------------------------------------------------


def test_a_whisker_pushes_along_the_normal_by_its_depth() -> None:
    """A whisker of 3 m enters a slanting wall after t m: F = w (1 - t / 3) (n + unit(lateral n))."""
    n = np.array([-math.cos(0.5), math.sin(0.5)])
    slant = HalfSpace(point=(2, 0), direction=tuple(n))
    # the deepest whisker counts, the one that enters the wall first
    turn = math.radians(35)
    ways = [np.array([math.cos(a), math.sin(a)]) for a in (0, turn, -turn)]
    first = min((2 * -n[0] - 0.2) / (-way @ n) for way in ways if way @ n < 0)
    np.testing.assert_allclose(steer(WHISKERS, obstacles=(slant,)), 20 * (1 - first / 3) * np.add(n, [0, 1]), rtol=1e-9)


def test_head_on_whiskers_steer_aside() -> None:
    x, _ = path(scene(WHISKERS, obstacles=(Circle(centre=(5, 0), radius=1),)), 6)
    assert Circle(centre=(5, 0), radius=1).gap(x).min() > 0.2
    assert np.abs(x[:, 1]).max() > 0.5


@pytest.mark.slow
def test_in_3d_whiskers_detect_a_ceiling_and_a_floor() -> None:
    """In level flight 0.5 m below a ceiling, or above a floor, the middle and the side whiskers touch nothing."""
    ahead = Spawn(low=(0, 0, 0), high=(0, 0, 0), speed=(2, 2), heading=(1, 0, 0))
    group = Group(count=1, radius=0.2, spawn=ahead)
    for up in (1, -1):
        ceiling = Block(centre=(0, 0, 1.5 * up), size=(90, 90, 2))
        made = Scene(dimension=3, groups=(group,), effects=(WHISKERS,), obstacles=(ceiling,))
        # the whisker enters 0.3 m further up, after 0.3 / sin 35 of its 3 m; n is its own lateral part
        share = 1 - 0.3 / math.sin(math.radians(35)) / 3
        np.testing.assert_allclose(
            made.acceleration(made.start(0))[0, 0], [0, 0, -2 * up * 20 * share], rtol=1e-9, atol=1e-9
        )


# --- force field ------------------------------------------------------------------------------------------------------


def test_the_force_field_of_two_walls_leads_to_the_middle_without_oscillation() -> None:
    """The nearest wall alone would push the agent to and fro."""
    walls = (HalfSpace(point=(0, -0.9), direction=(0, 1)), HalfSpace(point=(0, 0.9), direction=(0, -1)))
    np.testing.assert_allclose(steer(FIELD, obstacles=walls), 0, atol=1e-12)
    x, v = path(scene(FIELD, SEEK, obstacles=walls, at=(0.0, 0.3)), 6)
    late = slice(3 * len(x) // 4, None)
    assert np.abs(x[late, 1]).max() < 1e-3
    assert np.abs(v[late, 1]).max() < 1e-3


# --- wall following ---------------------------------------------------------------------------------------------------


def along(made: Scene, shape: Shape, seconds: float, settled: float) -> tuple[Any, Any]:
    x, v = path(made, seconds)
    keep = np.arange(len(x)) * 5 * made.dt > settled
    return shape.gap(x[keep]), np.linalg.norm(v[keep], axis=1)


def test_follow_wall_keeps_its_distance_to_a_straight_wall() -> None:
    gap, speed = along(scene(FOLLOW, obstacles=(WALL,), at=(0, 1)), WALL, 12, 4)
    np.testing.assert_allclose(gap, 0.8, rtol=1e-3)
    np.testing.assert_allclose(speed, 2, rtol=1e-3)


def test_follow_wall_keeps_its_distance_within_5_percent_around_convex_corners() -> None:
    block = Block(centre=(3, 3), size=(6, 4))
    gap, speed = along(scene(FOLLOW, obstacles=(block,), at=(3, 0.2)), block, 40, 3)
    assert np.abs(gap / 0.8 - 1).max() < 0.05
    assert speed.min() > 1.8


def test_follow_wall_turns_in_a_concave_corner_without_contact() -> None:
    made = scene(FOLLOW, obstacles=(L,), at=(0, -0.8))
    x, _ = path(made, 40)
    assert L.gap(x).min() > 0.5
    on = np.abs(L.gap(x) / 0.8 - 1) < 0.05
    assert on.mean() > 0.85  # except in the concave corner
    for corner in ((6, 5), (3, 5), (0, 3), (0, 0), (6, 0)):
        assert np.linalg.norm(x - corner, axis=1).min() < 1


def test_follow_wall_starts_with_the_wall_on_its_right_and_ignores_far_walls() -> None:
    resting = {"at": (0.0, 0.2), "v": (0.0, 0.0)}
    _, v = path(scene(FOLLOW, obstacles=(WALL,), **resting), 3)
    assert v[-1] == pytest.approx([2, 0], abs=1e-3)  # the wall, below, is on the right of a motion along +x
    far = HalfSpace(point=(0, -9), direction=(0, 1))
    np.testing.assert_array_equal(steer(FOLLOW, obstacles=(far,)), 0)


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
def test_containment_is_zero_while_the_predicted_position_is_inside(within: Shape) -> None:
    still_inside, leaving = contained(within, (4, 3), (1.7, 0)), contained(within, (6, 3), (1.9, 0))
    np.testing.assert_array_equal(still_inside.acceleration(still_inside.start(0)), 0)
    assert leaving.acceleration(leaving.start(0)).any()


def test_head_on_containment_brakes_and_steers_right() -> None:
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
def test_no_agent_leaves_its_container(within: Shape) -> None:
    made = contained(within, (4, 3), (2, 0), count=60)
    state, worst = made.start(3), -np.inf
    for _ in range(200):
        state = made.run(state, 5)
        worst = max(worst, float(within.gap(state.pos[0]).max()))
    assert worst < 0, "a centre is outside"


def stand_out(dt: float, seconds: float, walls: bool = False) -> float:
    """Return the farthest that one of 40 bodies of radius 0.2 m stands out of ROOM, m."""
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
def test_bodies_stand_out_less_if_dt_is_smaller() -> None:
    coarse, fine = stand_out(0.04, 20), stand_out(0.005, 20)
    assert 0 < coarse < 2 * 0.04 * 0.6  # max_speed dt / 2, and 20 % more
    assert fine < coarse / 4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")  # a jam forms
def test_no_body_stands_out_of_a_hollow_obstacle_with_collisions() -> None:
    assert stand_out(0.02, 20, walls=True) < 1e-6


def test_an_agent_outside_its_container_is_steered_straight_back() -> None:
    made = contained(ROOM, (10, 3), (0, 0))
    np.testing.assert_allclose(made.acceleration(made.start(0))[0, 0], [-12, 0], atol=1e-9)


@pytest.mark.parametrize("at", [(4.0, 3.0), (8.0, 3.0), (8.0, 8.0), (50.0, 50.0)])
def test_containment_is_finite_everywhere(at: Any) -> None:
    for v in ((0.0, 0.0), (2.0, 0.0)):
        made = contained(ROOM, at, v)
        assert np.isfinite(made.acceleration(made.start(0))).all()


def test_a_shape_without_an_inside_is_refused_as_a_container() -> None:
    with pytest.raises(ValueError, match=r"within.kind = half_space: must be one of circle, block, polygon"):
        Contain(weight=1, within=WALL)


# --- floor fields -----------------------------------------------------------------------------------------------------


def test_the_shortest_path_around_a_circle_is_two_tangents_and_an_arc() -> None:
    """Closed form; errors are of first order in the spacing."""
    goal, errors = np.array([3.0, 0.0]), []
    x = np.random.default_rng(0).uniform(-5, 5, (400, 2))
    x = x[np.linalg.norm(x, axis=1) > 1.25]
    d = np.linalg.norm(x, axis=1)
    arc = np.arccos(np.clip(x @ goal / (d * 3), -1, 1)) - np.arccos(1 / d) - math.acos(1 / 3)
    exact = np.where(arc <= 0, np.linalg.norm(x - goal, axis=1), np.sqrt(d**2 - 1) + math.sqrt(8) + arc)
    for spacing in (0.2, 0.1, 0.05):
        table = floor_field_table(
            [Circle(centre=(0, 0), radius=1.0)], [Target(at=goal)], (-5, -5), (5, 5), spacing, 0.0
        )
        errors.append(np.abs(sample_points(table, x)[:, 0] - exact).mean())
    assert errors[2] < 0.05
    assert errors[0] > 1.4 * errors[1] > 1.4 * 1.4 * errors[2]


def test_the_shortest_path_in_free_space_is_straight() -> None:
    goal = np.array([1.0, 2.0, 0.5])
    table = floor_field_table([], [Target(at=goal)], (-2, -2, -2), (3, 4, 3), 0.25, 0.0)
    x = np.random.default_rng(1).uniform(-1.5, 2.5, (200, 3))
    found = sample_points(table, x)
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
def test_a_u_shaped_wall_traps_local_steering_and_a_floor_field_leads_around_it() -> None:
    local = AvoidObstacles(weight=12, horizon=1, margin=0.1)
    there, _ = arrived(trapped(local, Seek(weight=4, target=(12, 0))), 30)
    assert there == 0
    there, clear = arrived(trapped(local, FollowWay(weight=4, target=(12, 0), clearance=0.4)), 30)
    assert there == 1
    assert clear > 0.2


@pytest.mark.slow
def test_follow_way_stops_at_its_target_and_heads_straight_outside_its_grid() -> None:
    way = FollowWay(weight=4, target=(3, 0), margin=1)
    group = Group(count=1, radius=0.1, max_speed=2, spawn=Spawn(low=(0, 0), high=(0, 0)))
    made = Scene(groups=(group,), effects=(way,), dt=0.02)
    end = made.run(made.start(0), 600)
    np.testing.assert_allclose(end.pos[0, 0], (3, 0), atol=0.01)
    assert np.linalg.norm(end.vel) < 0.01
    far = made.start(0)
    far.pos[0, 0] = (3, 500)
    np.testing.assert_allclose(made.acceleration(far)[0, 0], (0, -8), atol=1e-9)


def test_a_floor_field_is_solved_once_per_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Validation of the scene and its tables use the same grid."""
    solved: list[Any] = []
    monkeypatch.setattr(
        way_module, "floor_field_table", lambda *given: solved.append(given) or floor_field_table(*given)
    )
    made = trapped(FollowWay(weight=4, target=(12, 0), clearance=0.4))
    assert made.parts.tables
    assert len(solved) == 1
    made.with_effects(FollowWay(weight=4, target=(12, 0), clearance=0.3))  # another clearance needs another grid
    assert len(solved) == 2


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"target": (5, 2)},
            r"effects\[0\]\.behaviours\[0\]\.target = \(5.0, 2.0\): is -0.2 m from an obstacle, must be at least 0.3 m",
        ),
        ({"spacing": 1e-5}, "points; at most"),
        ({"target": (1, 2, 3)}, "dimension = 2"),
    ],
)
def test_an_impossible_floor_field_is_refused(change: Any, text: str) -> None:
    fields = {"weight": 1, "target": (12, 0), **change}
    with pytest.raises(ValueError, match=text):
        trapped(FollowWay(**fields))


# --- occlusion --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["circle", "block", "wall"])
def test_cohesion_ignores_a_neighbour_hidden_by_an_obstacle(kind: str) -> None:
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
"""Obstacles between the agents at (0, 0) and (2, 0), beside that line, beyond (2, 0), and behind (0, 0)."""


@pytest.mark.slow
def test_a_hidden_neighbour_does_not_count_as_the_nearest() -> None:
    """A behaviour towards the nearest neighbour uses the nearest one in sight."""
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
