"""Births and deaths: exact numbers, independent of dt, order, batch and number of threads."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Separation
from flockenv.engine import step_of
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace, Polygon, Shape, Wall
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.jit.thread_pool import use_threads
from flockenv.model.appearance import Appearance
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import ImplicitEuler, SemiImplicitEuler
from flockenv.physics.population import (
    Ageing,
    BoxPlace,
    Burst,
    Clearing,
    Crowding,
    Decay,
    Disc,
    Drain,
    Emitter,
    Leaving,
    Point,
    Segment,
    Surface,
    make_settler,
)
from flockenv.render import draw, write_replay
from flockenv.render.replay import Group as ReplayGroup
from flockenv.render.replay import Panel
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from flockenv.studies.trajectory import record

DTS = (0.1, 0.05, 0.02, 1 / 60, 0.0137)
ORIGIN = Point(at=(0.0, 0.0))
G = 9.81


def scene(*members: Any, count: int = 400, g: float = 0.0, **fields: Any) -> Scene:
    """Return a scene of particles under gravity g; one kernel serves most of these tests."""
    fields = {"groups": (Group(count=count, **fields.pop("group", {})),), "dt": 0.02, **fields}
    return Scene(effects=(Gravity(acceleration=(0.0, -g)),), population=members, **fields)


def living(state: State, world: int = 0) -> dict[int, tuple[float, ...]]:
    """Return the living agents: identity -> (born, pos, vel)."""
    here = np.flatnonzero(state.alive[world])
    return {
        int(state.identity[world, i]): (state.born[world, i], *state.pos[world, i], *state.vel[world, i]) for i in here
    }


def same(one: State, other: State) -> None:
    """Assert that two states are equal to the last bit."""
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


# --- times of birth --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("rate", [0.7, 10.0, 60.0, 234.5])
def test_the_number_of_births_is_rate_times_duration_for_every_dt(dt: float, rate: float) -> None:
    start, end = 0.25, 2.0
    fountain = scene(
        Emitter(place=ORIGIN, rate=rate), Emitter(place=ORIGIN, rate=rate, start=start, end=end), count=8000, dt=dt
    )
    state = fountain.start(0)
    for _ in range(7):
        state = fountain.run(state, 31)
        t = float(state.time[0])
        expected = math.floor(rate * t + 1e-9)
        expected += math.floor(rate * max(0.0, min(t, end) - start) + 1e-9)
        assert state.count_of("births") == expected == state.alive.sum()


def test_births_do_not_depend_on_dt() -> None:
    """No birth waits for the end of a step: without forces, positions follow from the times of birth."""
    emitters = (
        Emitter(
            place=Disc(centre=(1.0, 2.0), radius=0.5), rate=97.3, speed=(1.0, 3.0), direction=(1.0, 1.0), spread=40
        ),
        Emitter(place=Segment(start=(0, 0), end=(1, 0)), speed=(2.0, 2.0), bursts=(Burst(time=0.33, count=7),)),
    )
    end, seen = 2.0, []
    for dt in (0.1, 0.02, 0.004):
        sprinkler = scene(*emitters, dt=dt)
        state = sprinkler.run(sprinkler.start(5), round(end / dt))
        seen.append(living(state))
        for born, *motion in seen[-1].values():
            assert 0 <= born <= end
            assert len(motion) == 4
    assert seen[0].keys() == seen[1].keys() == seen[2].keys()
    for identity, numbers in seen[0].items():
        np.testing.assert_allclose(numbers, seen[1][identity], rtol=0, atol=1e-11)
        np.testing.assert_allclose(numbers, seen[2][identity], rtol=0, atol=1e-11)
    k = [identity for identity, numbers in seen[0].items() if numbers[0] != 0.33]
    times = sorted(seen[0][identity][0] for identity in k)
    np.testing.assert_allclose(times, (1 + np.arange(len(times))) / 97.3, rtol=1e-12)


def test_bursts_are_born_in_the_step_that_reaches_their_time() -> None:
    fireworks = scene(
        Emitter(place=BoxPlace(low=(0, 0), high=(9, 9)), together=True, bursts=tuple(
            Burst(time=t, count=n) for t, n in ((0.0, 5), (0.05, 3), (0.11, 4))
        ))
    )  # fmt: skip
    state = fireworks.start(0)
    counts = [int(state.alive.sum())]
    for _ in range(7):
        state = fireworks.run(state, 1)
        counts.append(int(state.alive.sum()))
    assert counts == [5, 5, 5, 8, 8, 8, 12, 12]
    places = np.unique(state.pos[0][state.alive[0]].round(12), axis=0)
    assert len(places) == 3  # one place for each burst


# --- slots and identities --------------------------------------------------------------------------------------------


def test_slots_are_reused_under_new_identities() -> None:
    fountain = scene(Emitter(place=ORIGIN, rate=300.0, lifetime=(0.2, 0.4), speed=(1, 1)), count=100)
    state, first_seen = fountain.start(0), dict[int, tuple[int, float]]()
    assert not state.alive.any()
    for _ in range(150):
        state = fountain.run(state, 1)
        for slot in np.flatnonzero(state.alive[0]):
            identity = int(state.identity[0, slot])
            here = (int(slot), float(state.born[0, slot]))
            assert first_seen.setdefault(identity, here) == here  # an identity keeps its slot and never returns
        assert len(set(state.identity[0][state.alive[0]])) == state.alive.sum()
        assert (state.age[0][state.alive[0]] <= 0.4).all()
        assert not state.vel[0][~state.alive[0]].any()
    births, deaths = state.count_of("births"), state.count_of("deaths")
    assert births == 900
    assert births - deaths == state.alive.sum()
    assert len({slot for slot, _ in first_seen.values()}) <= 100 < len(first_seen) == births
    assert state.count_of("births_refused") == 0


def test_births_without_a_free_slot_are_refused_and_counted() -> None:
    full = scene(Emitter(place=ORIGIN, rate=100.0), count=30)
    state = full.run(full.start(0), 100)
    assert (state.count_of("births"), state.count_of("births_refused"), state.alive.sum()) == (30, 170, 30)


def test_a_group_may_start_with_some_agents_alive() -> None:
    begun = scene(Emitter(place=ORIGIN, rate=1.0), group={"alive": 3, "spawn": Spawn(low=(4, 4), high=(5, 5))}, count=9)
    state = begun.start(0)
    assert state.alive[0].tolist() == [True] * 3 + [False] * 6
    assert state.identity[0].tolist() == [0, 1, 2] + [-1] * 6
    assert (state.pos[0, :3] >= 4).all()
    assert not state.pos[0, 3:].any()


# --- laws with a closed form -----------------------------------------------------------------------------------------


def test_the_number_alive_is_the_number_of_births_within_one_lifetime() -> None:
    for rate, life in ((200.0, 1.37), (4000.0, 0.005)):  # the second lifetime is shorter than a step
        fountain = scene(Emitter(place=ORIGIN, rate=rate, lifetime=(life, life)))
        state = fountain.start(0)
        for _ in range(12):
            state = fountain.run(state, 17)
            t = float(state.time[0])
            assert abs(state.alive.sum() - (math.floor(rate * t) - math.floor(rate * max(0.0, t - life)))) <= 1
            assert state.count_of("births") - state.count_of("deaths") == state.alive.sum()
    rate = 200.0
    drawn = scene(Emitter(place=ORIGIN, rate=rate, lifetime=(0.5, 1.5)))
    state = drawn.run(drawn.start(0), 300)
    assert abs(state.alive.sum() - rate) < 4 * math.sqrt(rate / 6)  # 200 births a second, 1 s of life on average


def test_the_mean_height_of_a_fountain_is_that_of_ballistics() -> None:
    """Forces act on newborn agents from the next step on; this method corrects for it on average (see the docs)."""
    rate, life, speed = 4000.0, 1.5, 9.0
    for dt in (0.02, 0.01):
        jet = scene(
            Emitter(place=ORIGIN, rate=rate, lifetime=(life, life), speed=(speed, speed), direction=(0, 1)),
            g=G, count=7000, dt=dt,
        )  # fmt: skip
        state = jet.run(jet.start(0), round(2.0 / dt))
        height = state.pos[0, :, 1][state.alive[0]].mean()
        assert abs(height - (speed * life / 2 - G * life**2 / 6)) < speed / rate


@pytest.mark.parametrize("dt", [0.1, 0.02])
def test_half_of_the_agents_are_alive_after_each_half_life(dt: float) -> None:
    half, n = 1.0, 4000
    sample = scene(Decay(rate=math.log(2) / half), count=n, group={"spawn": Spawn(low=(0, 0), high=(1, 1))}, dt=dt)
    state = sample.start(3)
    for left in (0.5, 0.25):
        state = sample.run(state, round(half / dt))
        assert abs(state.alive.sum() - left * n) < 4 * math.sqrt(n * left * (1 - left))
    assert state.count_of("deaths") == n - state.alive.sum()


def test_decay_acts_on_an_agent_from_its_birth_within_a_step() -> None:
    """dt is the mean lifetime. Agents born in the last step are not counted: they have not decayed yet."""
    rate, decay, dt = 4000.0, 1.0, 1.0
    fountain = scene(Emitter(place=ORIGIN, rate=rate), Decay(rate=decay), count=12_000, dt=dt)
    state = fountain.run(fountain.start(1), 3)
    old = state.alive[0] & (state.age[0] >= dt)
    expected = rate / decay * (math.exp(-decay * dt) - math.exp(-3 * decay * dt))
    assert abs(old.sum() - expected) < 4 * math.sqrt(expected)


# --- places and directions -------------------------------------------------------------------------------------------


def newborn(place: Any, count: int = 4000, dimension: int = 2, space: Space | None = None, **how: Any) -> State:
    """Return a state with `count` agents born before the first step, which needs no kernel of a scene."""
    emitter = Emitter(place=place, bursts=(Burst(time=0.0, count=count),), **how)
    born = Scene(dimension=dimension, groups=(Group(count=count),), population=(emitter,), space=space or Plane())
    state = born.start(2)
    assert state.alive.all()
    return state


SURFACES: list[Shape] = [
    Circle(centre=(1.0, 2.0), radius=0.7), Circle(centre=(1.0, 2.0, 3.0), radius=0.7),
    Capsule(start=(0.0, 0.0), end=(2.0, 1.0), radius=0.5), Capsule(start=(0, 0, 0), end=(2.0, 1.0, 1.0), radius=0.5),
    Wall(vertices=((0, 0), (2, 0), (2, 1)), radius=0.2), Wall(vertices=((0, 0, 0), (2, 0, 0), (2, 1, 1)), radius=0.2),
    Polygon(vertices=((0, 0), (0, 2), (1, 1), (3, 2), (3, 0))), Block(centre=(1, 1), size=(3, 1), turn=30),
    Block(centre=(1, 1, 0), size=(3, 1, 2), turn=30, axis=(1, 1, 0)),
]  # fmt: skip


@pytest.mark.parametrize("shape", SURFACES, ids=lambda shape: f"{shape.kind}{shape.dimension}")
def test_births_on_a_surface_are_uniform_and_move_along_its_normal(shape: Shape) -> None:
    state = newborn(Surface(shape=shape), dimension=shape.dimension, speed=(1, 1))
    pos, vel = state.pos[0], state.vel[0]
    np.testing.assert_allclose(shape.gap(pos), 0, atol=1e-12)
    assert shape.gap(pos[:0]).shape == (0,)  # as in a world without agents
    np.testing.assert_allclose(vel, shape.normal(pos + 1e-6 * vel), atol=1e-5)
    # balls around different places hold about as many agents, as far as the surface there is flat
    square = ((pos[:, None] - pos[None, :50]) ** 2).sum(axis=2)
    near = (square < 0.15**2).sum(axis=0)
    assert np.median(near) > 0.6 * near.max() - 12
    assert np.median(near) < 1.7 * near.min() + 12


def test_births_are_uniform_in_discs_balls_segments_and_boxes() -> None:
    disc = newborn(Disc(centre=(1.0, 2.0), radius=2.0)).pos[0] - (1.0, 2.0)
    ball = newborn(Disc(centre=(1.0, 2.0, 3.0), radius=2.0), dimension=3).pos[0] - (1.0, 2.0, 3.0)
    for offset, d in ((disc, 2), (ball, 3)):
        distance = np.linalg.norm(offset, axis=1)
        assert distance.max() <= 2
        assert abs((distance < 1).mean() - 0.5**d) < 0.03
        assert np.abs(offset.mean(axis=0)).max() < 0.1
    flat = newborn(Disc(centre=(0.0, 0.0, 1.0), radius=2.0, axis=(0, 3, 4)), dimension=3).pos[0] - (0, 0, 1)
    np.testing.assert_allclose(flat @ (0, 0.6, 0.8), 0, atol=1e-12)
    assert abs((np.linalg.norm(flat, axis=1) < 1).mean() - 0.25) < 0.03
    line = newborn(Segment(start=(1, 1), end=(3, 2))).pos[0]
    np.testing.assert_allclose((line - (1, 1)) @ (-1, 2), 0, atol=1e-12)
    assert abs(line[:, 0].mean() - 2) < 0.05
    box = newborn(BoxPlace(low=(1, 2, 3), high=(2, 4, 6)), dimension=3).pos[0]
    assert (np.histogram((box - (1, 2, 3)) / (1, 2, 3), bins=4, range=(0, 1))[0] > 2700).all()
    assert abs(np.corrcoef(box.T)[0, 1]) < 0.06


@pytest.mark.parametrize("dimension", [2, 3])
def test_directions_of_birth_are_uniform_in_a_cone(dimension: int) -> None:
    aim = np.array([1.0, 2.0, -2.0][:dimension])
    place = Point(at=(0.0,) * dimension)
    state = newborn(place, dimension=dimension, speed=(2, 4), direction=tuple(aim), spread=60)
    speed = np.linalg.norm(state.vel[0], axis=1)
    along = state.vel[0] @ aim / np.linalg.norm(aim) / speed
    assert 2 <= speed.min() < 2.02 < 3.98 < speed.max() <= 4
    assert along.min() >= 0.5 - 1e-12
    inner = math.cos(math.pi / 6) if dimension == 2 else 0.75
    assert abs((along > inner).mean() - 0.5) < 0.03  # half of the angle in 2D, half of the cap's area in 3D
    every = newborn(place, dimension=dimension, speed=(1, 1)).vel[0]
    assert np.abs(every.mean(axis=0)).max() < 0.05


def test_births_stay_in_the_space() -> None:
    walls = newborn(Point(at=(0.0, 5.0)), space=Box(size=(5, 5)), speed=(1, 1))
    assert (walls.pos[0] == (0.1, 4.9)).all()
    around = newborn(Point(at=(6.0, -1e-20)), space=Torus(size=(5, 5)))
    assert (around.pos[0] == (1.0, 0.0)).all()


@pytest.mark.slow
def test_births_in_a_clearing_avoid_living_agents() -> None:
    """Half of the region is crowded: a clearing has hardly any births there, a box about half of them."""
    low, high = (0.0, 0.0), (2.0, 1.0)
    for place, share in (
        (Clearing(low=low, high=high, radius=0.3), (0.0, 0.02)),
        (BoxPlace(low=low, high=high), (0.4, 0.6)),
    ):
        crowd = Group(count=300, spawn=Spawn(low=(0, 0), high=(1, 1)))
        meadow = Scene(
            groups=(crowd, Group(count=400)), dt=0.02,
            population=(Emitter(group=1, place=place, bursts=(Burst(time=0.0, count=100),)),),
        )  # fmt: skip
        pos = meadow.start(0).pos[0, 300:400]
        assert share[0] <= (pos[:, 0] < 1).mean() <= share[1]


def test_newborn_agents_face_along_their_velocity() -> None:
    emitter = Emitter(place=ORIGIN, bursts=(Burst(time=0.0, count=3),), speed=(2, 2), direction=(3, 4))
    oriented = Scene(groups=(Group(count=5, oriented=True),), population=(emitter,))
    np.testing.assert_allclose(oriented.start(0).heading[0, :3], [(0.6, 0.8)] * 3, rtol=1e-12)


# --- sinks -----------------------------------------------------------------------------------------------------------


def test_no_agent_passes_through_a_thin_drain() -> None:
    """The agents move 3 m per step and meet a wall without thickness at many phases and angles."""
    wall = Drain(shape=Wall(vertices=((0, -50), (0, 50))))
    gun = scene(wall, count=64, group={"spawn": Spawn(low=(-5, -1), high=(-2, 1), speed=(150, 150), heading=(1, 0))})
    start = gun.start(0)
    angle = np.linspace(-1.2, 1.2, 64)
    start = start.with_motion(start.pos, 150 * np.stack([np.cos(angle), np.sin(angle)], axis=1)[None])
    state = start
    for _ in range(8):
        state = gun.run(state, 1)
        assert not (state.alive[0] & (state.pos[0, :, 0] > 0)).any()
    assert not state.alive.any()
    assert state.count_of("deaths") == 64


def test_a_drain_removes_agents_in_its_path_and_a_hollow_one_agents_outside() -> None:
    """The disc moves 0.4 m a step along a resting row; a hollow shape is solid all around its inside."""
    row = np.stack([np.linspace(-4, 4, 17), np.zeros(17)], axis=1)[None]
    group = {"spawn": Spawn(low=(0, 0), high=(1, 1))}
    for shape, left, steps in (
        (
            Circle(centre=(-3.9, 0.0), radius=0.05, velocity=(20.0, 0.0)),
            (row[0, :, 0] < -3.95) | (row[0, :, 0] > 2.2),
            15,
        ),
        (Circle(centre=(0.0, 0.0), radius=1.7, hollow=True), np.abs(row[0, :, 0]) < 1.7, 1),
        (Block(centre=(0.0, 0.0), size=(3.0, 3.0), hollow=True), np.abs(row[0, :, 0]) < 1.5, 1),
    ):
        taken = scene(Drain(shape=shape), count=17, group=group)
        end = taken.run(taken.start(0).with_motion(row, 0 * row), steps)
        np.testing.assert_array_equal(end.alive[0], left)


def test_drain_leaving_and_ageing_remove_agents_by_place_and_age() -> None:
    group = {"spawn": Spawn(low=(-2, -2), high=(2, 2))}
    inside = scene(Drain(shape=Block(centre=(0, 0), size=(2, 2)), margin=0.25), count=500, group=group)
    before = inside.start(0)
    after = inside.run(before, 1)
    gap = Block(centre=(0, 0), size=(2, 2)).gap(before.pos[0])
    np.testing.assert_array_equal(after.alive[0], gap > 0.25)
    outside = scene(Leaving(low=(-1, -2), high=(2, 1)), count=500, group=group)
    after = outside.run(before, 1)
    kept = (before.pos[0] >= (-1, -2)).all(axis=1) & (before.pos[0] <= (2, 1)).all(axis=1)
    np.testing.assert_array_equal(after.alive[0], kept)
    old = scene(Ageing(lifetime=0.1), count=9, group=group)
    assert [int(old.run(old.start(0), k).alive.sum()) for k in (4, 5)] == [9, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("space", "dtype"),
    [
        (Plane(), "float64"), (Torus(size=(4.0, 4.0)), "float64"), (Torus(size=(1.0, 4.0)), "float64"),
        (Plane(), "float32"),
    ],
    ids=["plane", "torus", "thin", "single"],
)  # fmt: skip
def test_crowding_removes_the_youngest_agents(space: Space, dtype: str) -> None:
    radius, most, n = 0.45, 6, 400
    group = {"spawn": Spawn(low=(0, 0), high=(1.0, 3.9))}
    crowd = scene(Crowding(radius=radius, most=most), count=n, space=space, group=group, dtype=dtype)
    before = crowd.start(0)
    after = before.copy()
    make_settler(crowd)(before.x, before.v, after, 0, 1)  # the end of a step without motion
    offset = np.asarray(space.displacement(before.pos[0][:, None], before.pos[0][None]))
    near = (offset**2).sum(axis=2) <= radius**2
    elders = np.tril(near, -1).sum(axis=1)  # of equal age: those with smaller indices
    np.testing.assert_array_equal(after.alive[0], elders <= most)
    assert 0 < after.alive.sum() < n


def test_crowding_removes_agents_at_its_rate() -> None:
    thinning = scene(
        Crowding(radius=9.0, most=0, rate=math.log(2)), count=2000, group={"spawn": Spawn(low=(0, 0), high=(1, 1))}
    )
    state = thinning.run(thinning.start(0), 50)
    assert abs(state.alive.sum() - 1000) < 4 * math.sqrt(500)
    assert state.alive[0, 0]  # the eldest


# --- independence of batch, threads, calls ---------------------------------------------------------------------------


EVERYTHING = (
    Emitter(place=Disc(centre=(0.0, 0.0), radius=0.3), rate=700.0, speed=(2, 6), direction=(0, 1), spread=30,
            lifetime=(0.5, 2)),
    Emitter(place=Surface(shape=Circle(centre=(2.0, 2.0), radius=0.4)), rate=150.0, bursts=(Burst(time=0.3, count=90),),
            speed=(1, 2)),
    Drain(shape=Block(centre=(0, -1), size=(9, 1))), Crowding(radius=0.05, most=3, rate=5.0), Decay(rate=0.2),
    Leaving(low=(-5, -5), high=(5, 5)),
)  # fmt: skip


def test_a_world_of_a_batch_equals_the_world_alone() -> None:
    everything = scene(*EVERYTHING, g=G, count=1500)
    batch = everything.run(everything.start(7, worlds=3), 60)
    for k in range(3):
        same(batch.worlds([k]), everything.run(everything.start(7 + k), 60))
    assert batch.count_of("births") > 3 * 900
    assert len({int(n) for n in batch.alive.sum(axis=1)}) > 1


def test_results_do_not_depend_on_threads_or_on_how_steps_are_split_into_calls() -> None:
    everything = scene(*EVERYTHING, g=G, count=3000)
    whole = everything.run(everything.start(7, worlds=3), 40)
    try:
        use_threads(2)
        shared = everything.start(7, worlds=3)
        for steps in (1, 19, 20):
            everything.step(shared, out=shared, steps=steps)
        large = scene(*EVERYTHING, g=G, count=6000)
        two = large.run(large.start(1), 10)
        use_threads(1)
        same(two, large.run(large.start(1), 10))
    finally:
        use_threads(1)
    same(whole, shared)


@pytest.mark.slow
def test_a_diverged_world_keeps_its_state_and_the_others_are_stepped() -> None:
    jet = scene(Emitter(place=ORIGIN, rate=100.0, speed=(1, 1)), g=G)
    good = jet.run(jet.start(0, worlds=2), 20)
    bad = good.copy()
    bad.vel[1, 0] = 1e308
    expected = jet.run(good, 5)
    with pytest.raises(SimulationDiverged) as caught:
        jet.run(bad, 5)
    left = caught.value.state
    assert left is not None
    same(left.worlds([0]), expected.worlds([0]))
    same(left.worlds([1]), bad.worlds([1]))


@pytest.mark.slow
def test_single_precision_has_the_same_births() -> None:
    emitter = Emitter(place=Disc(centre=(0.0, 0.0), radius=0.3), rate=700.0, speed=(2, 6), lifetime=(0.5, 2))
    one, other = (scene(emitter, dtype=dtype) for dtype in ("float64", "float32"))
    double, single = (s.run(s.start(0), 50) for s in (one, other))
    np.testing.assert_array_equal(double.identity, single.identity)
    np.testing.assert_array_equal(double.born, single.born)
    np.testing.assert_allclose(double.pos, single.pos, atol=1e-4)


@pytest.mark.slow
def test_scenes_without_living_agents_can_be_stepped() -> None:
    """A pair law and an implicit method are tried, first without agents, then with the first births."""
    emitter = Emitter(place=Disc(centre=(5.0, 5.0), radius=1.0), rate=20.0, start=0.2, speed=(1, 1))
    for count, effects, method in (
        (300, (Separation(weight=1.0, radius=1.0),), SemiImplicitEuler()),
        (12, (Gravity(),), ImplicitEuler()),
    ):
        empty = Scene(
            groups=(Group(count=count),), effects=effects, population=(emitter,), dt=0.05, integrator=method
        )  # fmt: skip
        state = empty.run(empty.start(0, worlds=2), 3)
        assert not state.alive.any()
        state = empty.run(state, 7)
        assert state.alive.sum() == state.count_of("births") == 2 * 6
        assert np.isfinite(state.pos).all()


# --- no population, files, errors ------------------------------------------------------------------------------------


def test_a_scene_without_a_population_keeps_no_identities() -> None:
    fountain = scene(Emitter(place=ORIGIN, rate=1.0), count=5, group={"spawn": Spawn(low=(0, 0), high=(1, 1))})
    plain = fountain.model_copy(update={"population": ()})
    state = plain.start(0)
    assert state.identity.size == state.born.size == state.dies.size == 0
    assert plain.bytes_per_world() < fountain.bytes_per_world()
    assert step_of(plain.parts) is step_of(fountain.parts)
    for one, other in ((plain, fountain), (fountain, plain)):
        with pytest.raises(ValueError, match="identities"):
            one.step(other.start(0))


def test_a_population_survives_yaml_and_pickle() -> None:
    everything = scene(*EVERYTHING, Emitter(place=Clearing(low=(0, 0), high=(1, 1), radius=0.1), rate=1.0), g=G)
    assert load_scene(dump_scene(everything)) == everything
    assert pickle.loads(pickle.dumps(everything)) == everything
    assert hash(everything) == hash(load_scene(dump_scene(everything)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fountain", "fireworks", "fire", "smoke", "waterfall"])
def test_example_scenes_load_and_refuse_no_births(name: str) -> None:
    loaded = load_scene(Path(__file__).parent.parent / "configs" / "scenes" / f"{name}.yaml")
    assert load_scene(dump_scene(loaded)) == loaded
    state = loaded.run(loaded.start(0), round(4 / loaded.dt))
    assert state.count_of("births") > 300
    assert state.count_of("births_refused") == 0  # there are enough slots


PLANE = {"kind": "half_space", "point": [0, 0], "direction": [0, 1]}
ONE = {"kind": "emitter", "place": {"kind": "point", "at": [0, 0]}, "rate": 1.0}


@pytest.mark.parametrize(
    ("member", "message"),
    [
        ({**ONE, "rate": -1.0}, r"population\[0\].rate = -1.0: must be a number >= 0"),
        ({**ONE, "rate": "many"}, r"population\[0\].rate = 'many': must be a number"),
        ({**ONE, "rate": 1e12}, "<= 1000000000.0"),
        ({**ONE, "rate": 0}, "rate = 0: give a rate or bursts"),
        ({**ONE, "group": 2}, r"population\[0\].group = 2: the scene has 2, counted from 0; did you mean 1\?"),
        ({**ONE, "group": -1}, "group = -1: must be an integer >= 0"),
        ({**ONE, "place": {"kind": "pint", "at": [0, 0]}}, "unknown, did you mean `point`"),
        ({**ONE, "place": {"kind": "point", "at": [0, 0, 0]}}, "at = .*has 3 numbers, but dimension = 2"),
        (
            {**ONE, "place": {"kind": "surface", "shape": {"kind": "circl", "centre": [0, 0], "radius": 1}}},
            "did you mean `circle`",
        ),
        (
            {**ONE, "place": {"kind": "surface", "shape": PLANE}},
            "has no end",
        ),
        ({**ONE, "place": {"kind": "surface", "shape": {"centre": [0, 0], "radius": 1, "hollow": True}}}, "is hollow"),
        (
            {**ONE, "place": {"kind": "surface", "shape": {"centre": [0, 0], "radius": 1, "velocity": [1, 0]}}},
            "place.shape.kind = circle: moves",
        ),
        ({**ONE, "place": {"kind": "box", "low": [1, 0], "high": [0, 1]}}, "lower corner comes first"),
        ({**ONE, "lifetime": [0, 0]}, "must be more than 0 s"),
        ({**ONE, "lifetime": [2, 1]}, "lower number must come first"),
        ({**ONE, "speed": [2, 9]}, "max_speed = 5 m/s"),
        ({**ONE, "spread": 10}, "needs a direction"),
        ({**ONE, "direction": [0, 0]}, "not all 0"),
        ({**ONE, "start": 2, "end": 1}, "must be after start"),
        ({**ONE, "bursts": [{"time": -1, "count": 3}]}, r"bursts\[0\].time = -1"),
        ({**ONE, "bursts": [{"time": 1, "count": 0}]}, r"bursts\[0\].count = 0"),
        ({**ONE, "lifetme": [1, 2]}, "did you mean `lifetime`"),
        ({"kind": "decay", "rate": 0}, "must be a number > 0"),
        ({"kind": "decya", "rate": 1}, "did you mean `decay`"),
        ({"kind": "ageing", "lifetime": 0}, "must be a number > 0"),
        ({"kind": "drain", "shape": {"centre": [0, 0, 0], "radius": 1}}, "lies in 3 dimensions"),
        ({"kind": "leaving", "low": [0, 0], "high": [-1, 1]}, "lower corner comes first"),
        ({"kind": "crowding", "radius": 1, "most": -1}, "most = -1"),
        ({"kind": "decay", "rate": 1, "group": 7}, "did you mean 1"),
    ],
)  # fmt: skip
def test_bad_members_of_a_population_raise_errors_of_one_line(member: dict[str, Any], message: str) -> None:
    data = {"groups": [{"count": 3, "max_speed": 5, "alive": 0}, {"count": 2, "alive": 0}], "population": [member]}
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(repr(data).replace("'", '"') + "\n")
    assert len(str(caught.value).splitlines()) == 1


def test_records_raise_the_same_errors_as_files() -> None:
    for bad in (math.nan, math.inf, -1.0, True):
        with pytest.raises(ValueError, match="rate"):
            Emitter(place=ORIGIN, rate=bad)
    with pytest.raises(ValueError, match=r"alive = 4: at most its count, 3"):
        Group(count=3, alive=4)
    with pytest.raises(ValueError, match=r"groups\[0\].spawn.low: missing"):
        scene(Decay(rate=1.0))
    with pytest.raises(ValueError, match=r"population\[0\].place: its farthest coordinate"):
        scene(Emitter(place=Point(at=(2e4, 0)), rate=1.0), dtype="float32")
    with pytest.raises(ValueError, match=r"population\[0\].place: reaches from"):
        scene(Emitter(place=Point(at=(6, 0)), rate=1.0), space=Box(size=(5, 5)))
    with pytest.raises(ValueError, match="half_space"):
        scene(
            Drain(shape=HalfSpace(point=(0, 0), direction=(0, 1))), space=Torus(size=(5, 5)),
        )  # fmt: skip


# --- pictures --------------------------------------------------------------------------------------------------------


def looked_at(**look: Any) -> Scene:
    group = Group(count=40, radius=0.1, appearance=Appearance(**look))
    emitter = Emitter(place=ORIGIN, rate=60.0, speed=(6, 6), direction=(1, 0), lifetime=(0.5, 0.5))
    return Scene(effects=(Gravity(acceleration=(0.0, 0.0)),), groups=(group,), population=(emitter,), dt=0.02)


def test_colours_follow_age_in_pictures_replays_and_files(tmp_path: Path) -> None:
    jet = looked_at(by="age", over=(0.0, 0.5), colours=("#ff0000", "#0000ff"), size=(0.2, 0.1), trail=0.2)
    film = record(jet, 0, 100, 2)
    shots = list(film.snapshots())
    now = shots[-1]
    assert now.identity is not None
    assert (now.shade[now.alive] < 1.0 + 1e-9).all()
    np.testing.assert_allclose(now.shade[now.alive], np.asarray(now.age)[now.alive] / 0.5, atol=1e-12)
    picture = draw(now, 400)
    red, blue = (np.nonzero((picture[..., k] > 200) & (picture[..., 2 - k] < 60))[1] for k in (0, 2))
    assert red.max() < blue.min()  # young agents are red and near the emitter
    page = tmp_path / "replay.html"
    write_replay(page, [ReplayGroup("jet", [Panel("", shots, None, "")])], "jet")
    text = page.read_text()
    assert '"fresh":' in text
    assert '"looks":[{"form":"point"' in text
    film.save(tmp_path / "jet.npz")
    with np.load(tmp_path / "jet.npz") as kept:
        np.testing.assert_array_equal(kept["identity"], film.identity)
        np.testing.assert_array_equal(kept["born"], film.born)


def test_a_trail_does_not_join_two_agents_of_one_slot() -> None:
    """No line leads from the death of one agent to the birth of the next in its slot."""
    emitter = Emitter(place=ORIGIN, rate=10.0, speed=(6, 6), direction=(1, 0), lifetime=(0.1, 0.1))
    jet = looked_at(trail=0.5, colours=("#ff0000",)).model_copy(update={"population": (emitter,), "dt": 0.01})
    film = record(jet, 0, 21, 1)
    shots = list(film.snapshots())
    before, last, now = shots[17], shots[19], shots[21]
    assert not np.array_equal(last.identity, now.identity)
    pictures = [draw(shots[19], 400, trails=[before], all_trails=False), draw(shots[19], 400)]
    assert (pictures[0] != pictures[1]).any()
    np.testing.assert_array_equal(draw(now, 400, trails=[last], all_trails=False), draw(now, 400))
    nameless = [replace(shot, identity=None) for shot in (last, now)]
    assert (draw(nameless[1], 400, trails=nameless[:1], all_trails=False) != draw(now, 400)).any()


def test_forms_look_different_and_bad_appearances_are_refused() -> None:
    pictures = []
    for form in ("point", "disc", "polygon", "metaball", "billboard"):
        jet = looked_at(form=form, opacity=(1.0, 1.0))
        pictures.append(draw(jet.snapshot(jet.run(jet.start(0), 20)), 300))
    assert (pictures[1] != pictures[2]).any() and all((pictures[1] != pictures[k]).any() for k in (3, 4))
    for wrong, message in (
        ({"colours": ("red",)}, "colours"), ({"colours": ("#ff0000", "#00ff00")}, "by: missing"),
        ({"over": (1.0, 1.0)}, "over"), ({"form": "star"}, "form"), ({"opacity": (1.0, 2.0)}, "opacity"),
        ({"trail": -1.0}, "trail"), ({"vertices": ((0.0, 0.0), (1.0, 0.0))}, "vertices"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Appearance(**wrong)
