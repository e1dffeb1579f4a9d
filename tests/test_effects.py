"""Effects: symmetries and limits that every effect of the catalogue obeys, in 2-D and 3-D, and closed forms."""

from __future__ import annotations

import copy
import json
import pickle
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flockenv
from flockenv.behaviours import Separation
from flockenv.geometry.shapes import Circle
from flockenv.geometry.space import Plane
from flockenv.geometry.targets import Target
from flockenv.jit.cache_folder import cache_folder
from flockenv.model.networks import Mesh
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics import effects as effects_module
from flockenv.physics.effects import Door, Drag, Springs, Stage
from flockenv.physics.integrators import RK4
from flockenv.scene import Group, Scene
from flockenv.steering.arbitration import ARBITRATIONS
from tests.catalogue import (
    AMONG_ALL,
    DRAG,
    EDGE,
    EFFECTS,
    FIRST,
    SOLID,
    Array,
    EffectRow,
    everything,
    mirror,
    rotation,
    scene_of,
    scene_under,
    turned,
    users_module,
)
from tests.kernels import functions_of, modules_of

BASES = tuple({type(row.effect).__mro__[1]: row for row in reversed(EFFECTS)}.values())
"""One row for each base class, for properties that an effect inherits from it."""
EVERY_BASE = pytest.mark.parametrize("row", BASES, ids=lambda row: row.name)


ELSEWHERE = {
    f"flockenv.physics.effects.{name}" for name in (
        "fields", "tether", "attraction", "motivation", "aims", "floor_field", "waypoints", "exit_choice", "vicsek",
    )
}  # fmt: skip
"""Modules of effects whose quick tests are in separate files: test_fields.py, test_inner.py, ..."""


def among(rows: Iterable[EffectRow]) -> pytest.MarkDecorator:
    """Parametrize over rows; most behaviours and fields are marked slow, as separate files hold their quick tests."""
    given = [pytest.param(row, marks=pytest.mark.slow) if _slow(row) else row for row in rows]
    return pytest.mark.parametrize("row", given, ids=lambda row: row.name)


def _slow(row: EffectRow) -> bool:
    elsewhere = row.effect.steering or type(row.effect).__module__ in ELSEWHERE
    return elsewhere and row.effect.kind not in {*AMONG_ALL, "steer"}


SLOW = pytest.mark.slow
ROWS = among(EFFECTS)


def obeying(symmetry: str) -> pytest.MarkDecorator:
    """Parametrize over the rows that declare a symmetry."""
    return among(row for row in EFFECTS if symmetry in row.obeys)


DIMENSIONS = pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
"""Each effect is compiled once per dimension from the same laws, so quick tests run only the plane."""

STEPS = 12


def moved(state: State, matrix: Array, shift: Array) -> State:
    """Return the state, obstacles included, rotated about the middle of the agents' region and shifted."""
    new, middle = state.copy(), EDGE / 2
    for points in (new.pos, new.obstacles.centre):
        points[...] = (points - middle) @ matrix.T + middle + shift
    new.vel[...] = new.vel @ matrix.T
    return new


def assert_moves_alike(scene: Scene, matrix: Array, shift: Array) -> None:
    """Assert that a transformed scene ends in the transformed end state; matrix and shift also apply to the effects.

    Tolerance in single precision: 40 roundings of the largest coordinate, five times the measured error. Each step
    rounds a few times, and so does the transformation of the start.
    """
    start = scene.start(3, worlds=2)
    end = scene.run(start, STEPS)
    assert not np.allclose(end.vel, start.vel)
    idle = [effect == effect.idle_copy() for effect in scene.effects]  # their regions may be invalid after a rotation
    other = scene.with_effects(
        *(effect if rests else turned(effect, matrix, shift) for effect, rests in zip(scene.effects, idle, strict=True))
    )
    expected, found = moved(end, matrix, shift), other.run(moved(start, matrix, shift), STEPS)
    single = end.pos.dtype == np.float32
    tolerance = 40 * np.finfo(np.float32).eps * float(np.abs(expected.pos).max()) if single else 1e-9
    np.testing.assert_allclose(scene.space.displacement(found.pos, expected.pos), 0, atol=tolerance)
    np.testing.assert_allclose(found.vel, expected.vel, atol=tolerance)


def relabelled(scene: Scene, start: State) -> tuple[State, list[int]]:
    """Return the state with the agents of each group shuffled, and the order."""
    rng, order, first = np.random.default_rng(0), [], 0
    for group in scene.groups:
        order += list(first + rng.permutation(group.count))
        first += group.count
    other = start.copy()
    other.x[...], other.v[...] = start.x[:, :, order], start.v[:, :, order]
    return other, order


# --- symmetries -------------------------------------------------------------------------------------------------------


@DIMENSIONS
@obeying("rotation")
def test_effect_is_equivariant_under_rotation(row: EffectRow, dimension: int) -> None:
    assert_moves_alike(scene_under(row, dimension), rotation(dimension, 7), np.zeros(dimension))


@DIMENSIONS
@obeying("mirror")
def test_effect_is_equivariant_under_reflection(row: EffectRow, dimension: int) -> None:
    assert_moves_alike(scene_under(row, dimension), mirror(dimension), np.zeros(dimension))


@DIMENSIONS
@obeying("translation")
def test_effect_is_equivariant_under_translation(row: EffectRow, dimension: int) -> None:
    assert_moves_alike(scene_under(row, dimension), np.eye(dimension), np.arange(1, dimension + 1) * 37.25)


@DIMENSIONS
def test_all_effects_are_equivariant_under_translation_on_a_torus(dimension: int) -> None:
    """The shift moves agents and obstacles across every edge."""
    shift = np.random.default_rng(2).uniform(5, 50, dimension)
    assert_moves_alike(everything(dimension), np.eye(dimension), shift)


@DIMENSIONS
@obeying("relabelling")
def test_effect_does_not_depend_on_the_order_of_agents(row: EffectRow, dimension: int) -> None:
    """Detects a body that is read with the index of another agent."""
    scene = scene_under(row, dimension)
    start = scene.start(3)
    other, order = relabelled(scene, start)
    end, found = scene.run(start, 40), scene.run(other, 40)
    np.testing.assert_allclose(found.x, end.x[:, :, order], atol=1e-9)
    np.testing.assert_allclose(found.v, end.v[:, :, order], atol=1e-9)


@DIMENSIONS
@ROWS
def test_world_of_a_batch_equals_the_same_world_alone(row: EffectRow, dimension: int) -> None:
    scene = scene_under(row, dimension)
    batch = scene.run(scene.start(20, worlds=5), 30)
    for k in range(5):
        alone = scene.run(scene.start(20 + k), 30)
        np.testing.assert_array_equal(batch.x[:, k], alone.x[:, 0])
        np.testing.assert_array_equal(batch.v[:, k], alone.v[:, 0])
        np.testing.assert_array_equal(batch.work[k], alone.work[0])


@DIMENSIONS
@ROWS
def test_momentum_is_conserved_exactly_by_effects_that_declare_it(row: EffectRow, dimension: int) -> None:
    """To 1e-12 of the sum of magnitudes of what the agents gained."""
    scene = scene_under(row, dimension)
    start = scene.start(3, worlds=8)  # in some of them agents are in the way of others
    end = scene.run(start, 50)
    gained = (end.vel - start.vel) * scene.body.mass[None, :, None]
    total, magnitudes = np.abs(gained.sum(axis=1)).max(), np.abs(gained).sum(axis=1).max()
    assert (total <= 1e-12 * magnitudes) == row.effect.conserves_momentum


@DIMENSIONS
@ROWS
def test_agent_out_of_reach_changes_nothing(row: EffectRow, dimension: int) -> None:
    scene = scene_under(row, dimension)
    start = scene.start(3)
    last = scene.groups[-1]
    more = scene.model_copy(update={"groups": (scene.groups[0], last.model_copy(update={"count": last.count + 1}))})
    other = more.start(3)
    other.pos[0, -1] = 1000.0
    end, found = scene.run(start, 20), more.run(other, 20)
    assert np.array_equal(end.pos, found.pos[:, :-1]) == (row.effect.far_law is None)  # a far law has unlimited reach
    np.testing.assert_allclose(end.pos, found.pos[:, :-1], atol=1e-5)


@DIMENSIONS
@ROWS
def test_dead_agents_exert_no_force_and_stay_in_place(row: EffectRow, dimension: int) -> None:
    scene = scene_under(row, dimension)
    start = scene.start(3)
    start.alive[:, 18:] = False
    groups = (scene.groups[0], scene.groups[1].model_copy(update={"count": 4}))
    few = scene_of(*row.company(dimension), dimension=dimension, groups=groups)
    living = few.start(3)
    living.x[...], living.v[...] = start.x[:, :, :18], start.v[:, :, :18]
    end, expected = scene.run(start, 20), few.run(living, 20)
    np.testing.assert_array_equal(end.x[:, :, :18], expected.x)
    np.testing.assert_array_equal(end.x[:, :, 18:], start.x[:, :, 18:])
    np.testing.assert_array_equal(end.v[:, :, 18:], 0)


# --- the same in single precision -------------------------------------------------------------------------------------


def singly(rows: Iterable[EffectRow], changes: tuple[str, ...] = ("",)) -> pytest.MarkDecorator:
    """Parametrize over rows, dimensions and declared symmetries for single precision.

    Only rows that share a kernel run in 3-D or without the slow mark. float32 can break by a constant that promotes to
    float64 or by a threshold; both are the same in 2-D and 3-D.
    """
    given = [
        pytest.param(row, d, *filter(None, [change]), marks=() if d == 2 and row.effect.kind in AMONG_ALL else SLOW)
        for row in rows
        for d in (2, 3)
        for change in changes
        if (d == 2 or row.effect.kind in AMONG_ALL) and (not change or change in row.obeys)
    ]
    names = ("row", "dimension", "change") if any(changes) else ("row", "dimension")
    return pytest.mark.parametrize(names, given, ids=lambda value: getattr(value, "name", value))


KINDS = singly(FIRST)


def single(row: EffectRow, dimension: int) -> Scene:
    """Return a float32 scene of one effect; the others are idle, so that most rows share one kernel."""
    if row.effect.kind not in AMONG_ALL:
        return scene_of(*row.company(dimension), dimension=dimension, dtype="float32")
    return everything(dimension, *row.at(dimension), space=Plane(), dtype="float32")


@singly(FIRST, ("rotation", "mirror", "translation"))
def test_effect_obeys_its_symmetries_in_single_precision(row: EffectRow, dimension: int, change: str) -> None:
    matrix = {"rotation": rotation(dimension, 7), "mirror": mirror(dimension)}.get(change, np.eye(dimension))
    shift = np.arange(1, dimension + 1) * (37.25 if change == "translation" else 0.0)
    assert_moves_alike(single(row, dimension), matrix, shift)


@singly(row for row in FIRST if "relabelling" in row.obeys)
def test_effect_does_not_depend_on_the_order_of_agents_in_single_precision(row: EffectRow, dimension: int) -> None:
    scene = single(row, dimension)
    start = scene.start(3)
    other, order = relabelled(scene, start)
    end, found = scene.run(start, STEPS), scene.run(other, STEPS)
    tolerance = 40 * np.finfo(np.float32).eps * float(np.abs(end.x).max())
    np.testing.assert_allclose(found.x, end.x[:, :, order], atol=tolerance)
    np.testing.assert_allclose(found.v, end.v[:, :, order], atol=tolerance)


@KINDS
def test_momentum_is_conserved_in_single_precision_by_effects_that_declare_it(row: EffectRow, dimension: int) -> None:
    """Tolerance: in each of 50 steps every velocity is rounded once."""
    scene = single(row, dimension)
    start = scene.start(3)
    end = scene.run(start, 50)
    mass = scene.body.mass[None, :, None].astype(float)
    gained = np.abs(((end.vel.astype(float) - start.vel) * mass).sum(axis=1)).max()
    carried = (np.abs(end.vel) * mass).sum(axis=1).max()
    assert (gained < 50 * np.finfo(np.float32).eps * carried) == row.effect.conserves_momentum


# --- degenerate input -------------------------------------------------------------------------------------------------


@DIMENSIONS
@ROWS
@pytest.mark.parametrize("count", [1, 50])
def test_effect_is_finite_if_all_agents_rest_in_one_place(row: EffectRow, dimension: int, count: int) -> None:
    """If the scene has obstacles, that place is the centre of one, where no direction is defined."""
    spawn = Spawn(low=(0,) * dimension, high=(1,) * dimension)
    solid = row.effect.kind in SOLID  # it needs an element at least; random ones are flat and stiff
    group = Group(count=max(count, dimension + 1) if solid else count, desired_speed=1.2, spawn=spawn)
    groups = (group, group) if row.family == "urges" else (group,)  # fish, and food or hunters
    dt = 0.001 if solid else 0.05
    scene = scene_of(*row.company(dimension), dimension=dimension, groups=groups, dt=dt)
    state = scene.start(0)
    state.pos[...] = scene.obstacles[0].centre if scene.obstacles else 2.5
    state.vel[...] = 0
    end = scene.run(state, 50)
    assert np.isfinite(end.pos).all()
    assert np.isfinite(end.vel).all()
    if row.effect.conserves_momentum:
        np.testing.assert_allclose(end.vel.sum(axis=1), 0, atol=1e-11 * count)


@DIMENSIONS
def test_separation_from_one_place_has_distinct_directions(dimension: int) -> None:
    """Stress case P28. Momentum is conserved, and agents are apart after 1 s."""
    scene = scene_of(Separation(weight=1, radius=2), dimension=dimension, groups=(
        Group(count=50, max_speed=3, spawn=Spawn(low=(0,) * dimension, high=(1,) * dimension)),))  # fmt: skip
    state = scene.start(0)
    state.pos[...], state.vel[...] = 0.0, 0.0
    first, end = scene.run(state, 1), scene.run(state, 20)
    assert np.abs(first.vel.sum(axis=1)).max() < 1e-12
    directions = first.vel[0] / np.linalg.norm(first.vel[0], axis=1, keepdims=True)
    assert len(np.unique(directions.round(6), axis=0)) == 50
    gaps = np.linalg.norm(end.pos[0, :, None] - end.pos[0, None], axis=2)[~np.eye(50, dtype=bool)]
    assert gaps.min() > 0.01
    np.testing.assert_array_equal(end.pos, scene.run(state, 20).pos)


@DIMENSIONS
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_pairs_in_one_place_separate_in_opposite_directions_unique_to_each_pair(dimension: int, dtype: str) -> None:
    """30 pairs far apart: momentum is conserved bit for bit, and no direction is preferred."""
    given = {
        "dimension": dimension,
        "groups": (Group(count=60, desired_speed=1.2, spawn=Spawn(low=(0,) * dimension, high=(1,) * dimension)),),
    }
    separation = Separation(weight=1, radius=2.5)
    if dtype == "float32":
        given.pop("dimension")
        scene = everything(dimension, separation, space=Plane(), dtype=dtype, obstacles=(), **given)
    else:
        scene = scene_of(separation, **given)
    state = scene.start(0)
    state.pos[...], state.vel[...] = 0.0, 0.0
    state.pos[0, :, 0] = np.arange(60) % 30 * 16.0
    found = scene.step(state).vel[0].astype(float)
    np.testing.assert_array_equal(found[:30], -found[30:])
    directions = found[:30] / np.linalg.norm(found[:30], axis=1, keepdims=True)
    lines = np.abs(directions @ directions.T)[~np.eye(30, dtype=bool)]
    assert lines.max() < 1 - 1e-6
    assert np.linalg.norm(directions.mean(axis=0)) < 0.5


SOLIDS = [row for row in EFFECTS if row.family == "liquid" or (row.effect.bond_law and row.effect.kind != "springs")]


@pytest.mark.parametrize("row", SOLIDS, ids=lambda row: row.name)
def test_a_scene_without_a_law_of_solids_or_liquids_has_no_line_byte_or_query_of_it(row: EffectRow) -> None:
    """It has springs on the same network, whose lasting kinds tests/test_yielding_springs.py compares."""
    scene = scene_under(row, row.dimensions[0])
    plain = scene.with_effects(DRAG, *(Springs(stiffness=3),) * bool(row.effect.bond_law))
    laws = (row.effect.bond_law, row.effect.pair_law, row.effect.finish_law)
    own = {law.py_func.__name__ for law in laws if law}
    assert own <= functions_of(scene) and not own & functions_of(plain)
    module = type(row.effect).__module__
    assert module in modules_of(scene) and module not in modules_of(plain)
    assert scene.parts.sweeps == (row.family == "liquid") and not plain.parts.sweeps
    start = plain.start(0)
    assert start.bonds.size == start.inner.size == 0


WELL = """
from __future__ import annotations

from typing import Any, ClassVar, Literal

from flockenv.physics.effects import Effect, Me
from flockenv.jit.decorators import Vec, law
from flockenv.maths.vectors import dot, scale


@law
def well(p: Any, me: Me) -> Vec:
    return scale(me.pos, -p.strength / dot(me.pos, me.pos))


class Well(Effect):
    \"\"\"A pull of strength / r towards the origin, where it is infinite.\"\"\"

    kind: Literal["well"] = "well"
    strength: float = 1.0
    own_law: ClassVar[Law | None] = well
"""


@pytest.mark.slow
def test_law_may_be_infinite_at_dead_agents_and_unused_lanes(tmp_path: Path) -> None:
    """Unused lanes and a dead agent are at the origin, where the law divides by zero; no NaN spreads."""
    with users_module(tmp_path, WELL, "wells") as laws:
        groups = (Group(count=5, spawn=Spawn(low=(1, 1), high=(2, 2))),)
        scene = scene_of(laws.Well(), groups=groups)
        start = scene.start(0, worlds=2)
        start.alive[1, 3], start.pos[1, 3] = False, 0.0
        end = scene.step(start)
        force = -start.pos / (start.pos**2).sum(axis=2, keepdims=True).clip(1e-300)
        changed = (end.vel - start.vel) / scene.dt
        np.testing.assert_allclose(changed[start.alive], force[start.alive], rtol=1e-9)
        np.testing.assert_array_equal(end.pos[1, 3], 0)
        assert np.isfinite(scene.run(end, 50).pos).all()
        start.alive[1, 3] = True
        with pytest.raises(FloatingPointError, match="world 1, agent 3"):
            scene.step(start)


REPULSION = """
from __future__ import annotations

from typing import Any, ClassVar, Literal

import soft
from flockenv.physics.effects import Effect, Me, Other, Sight
from flockenv.jit.decorators import Vec, law
from flockenv.maths.vectors import scale


@law
def pushed(p: Any, me: Me, other: Other) -> Vec:
    return soft.push(me, other)


@law
def repulsion(p: Any, me: Me, sums: Vec) -> Vec:
    return scale(sums, p.weight)


class Repulsion(Effect):
    kind: Literal["repulsion"] = "repulsion"
    weight: float = 1.0
    pair_law: ClassVar[Law | None] = pushed
    finish_law: ClassVar[Law | None] = repulsion

    @property
    def sight(self) -> Sight:
        return Sight(5.0)

    def sums(self, dimension: int) -> int:
        return dimension
"""

SOFT = """
from typing import Any

from flockenv.jit.decorators import Vec, law
from flockenv.maths.vectors import scale


@law
def push(me: Any, other: Any) -> Vec:
    return scale(other.offset, -me.mass * (me.radius + other.radius))
"""


@pytest.mark.slow
def test_pair_law_may_call_a_function_of_another_user_module_that_reads_bodies(tmp_path: Path) -> None:
    """Only the attributes that a law reads are sorted; they are collected from every function that the law calls."""
    with users_module(tmp_path, SOFT, "soft"), users_module(tmp_path, REPULSION, "repulsions") as laws:
        scene = scene_of(laws.Repulsion(weight=0.5))
        start = scene.start(3)
        found = (scene.step(start).vel - start.vel)[0] / scene.dt  # the mass in the force cancels
        offset = start.pos[0][None] - start.pos[0][:, None]
        radius = scene.body.radius
        near = ((offset**2).sum(axis=2) < 25) & ~np.eye(scene.agents, dtype=bool)
        terms = -offset * (radius[:, None] + radius)[..., None] * near[..., None]
        np.testing.assert_allclose(found, 0.5 * terms.sum(axis=1), atol=1e-9)


# --- nothing is computed that no effect needs -------------------------------------------------------------------------


@DIMENSIONS
@ROWS
def test_idle_effect_changes_nothing(row: EffectRow, dimension: int) -> None:
    idle = scene_of(*row.company(dimension, idle=True), dimension=dimension)
    absent = scene_of(*row.at(dimension)[1:], dimension=dimension, groups=idle.groups)
    start = idle.start(3)  # clear of obstacles; a start with inner state or bonds fits only its own scene
    own = row.effect.keeps or row.effect.bond_keep_law
    ends = [scene.run(scene.start(3) if own else start, 20) for scene in (idle, absent)]
    np.testing.assert_array_equal(ends[0].x, ends[1].x)
    np.testing.assert_array_equal(ends[0].v, ends[1].v)


@DIMENSIONS
@ROWS
def test_effect_computes_only_what_it_declares(row: EffectRow, dimension: int) -> None:
    scene = scene_under(row, dimension)
    end = scene.run(scene.start(3, worlds=2), 10)
    agents, needs = scene.agents, {what for effect in scene.effects for what in effect.calls_for()}
    assert end.count_of("evaluations") == 2 * 10
    assert end.count_of("neighbour_queries") == (2 * 10 if "neighbour query" in needs else 0)
    assert end.count_of("pairs") == (2 * 10 * agents * agents if {"neighbour query", "all others"} & {*needs} else 0)
    assert end.count_of("obstacle_tests") == (2 * 10 * agents * 2 if "obstacles" in needs else 0)


def test_scene_without_effects_computes_nothing() -> None:
    scene = scene_of(obstacles=({"centre": (1, 1), "radius": 0.5},))
    end = scene.run(scene.start(3, worlds=2), 10)
    assert [end.count_of(what) for what in ("neighbour_queries", "pairs", "obstacle_tests")] == [0, 0, 0]


def test_several_pair_effects_share_one_query() -> None:
    scene = everything(2)
    assert sum(effect.pair_law is not None for effect in scene.effects) > 1
    end = scene.run(scene.start(3, worlds=2), 10)
    assert end.count_of("neighbour_queries") == end.count_of("evaluations") == 2 * 10
    assert end.count_of("pairs") == 2 * 10 * scene.agents**2


# --- an effect is a value ---------------------------------------------------------------------------------------------


def names_of_effects() -> dict[str, Any]:
    """Return the names that the repr of an effect or scene uses: effects, behaviours, arbitrations."""
    kinds = (*effects_module.EFFECTS.values(), *ARBITRATIONS.values())
    return {kind.__name__: kind for kind in kinds} | {"Circle": Circle, "Target": Target, "Stage": Stage, "Door": Door}


@EVERY_BASE
def test_repr_of_an_effect_is_its_constructor(row: EffectRow) -> None:
    assert eval(repr(row.effect), names_of_effects()) == row.effect  # noqa: S307  # as documented
    assert str(row.effect) == repr(row.effect)


@EVERY_BASE
def test_effect_is_a_value(row: EffectRow) -> None:
    again = pickle.loads(pickle.dumps(row.effect))
    assert again == row.effect == copy.deepcopy(row.effect)
    assert hash(again) == hash(row.effect)
    assert type(row.effect).model_validate(row.effect.model_dump()) == row.effect
    assert type(row.effect).model_validate_json(row.effect.model_dump_json()) == row.effect
    for name in row.effect.parameters().keys() & type(row.effect).model_fields.keys():
        assert getattr(row.effect, name) == row.effect.parameters()[name]
        with pytest.raises(ValueError, match="frozen"):
            setattr(row.effect, name, 1.0)


@DIMENSIONS
@among(BASES)
def test_scene_with_the_effect_is_a_value(row: EffectRow, dimension: int) -> None:
    scene = scene_under(row, dimension)
    end = scene.run(scene.start(3), 5)
    again = pickle.loads(pickle.dumps(scene))
    assert again == scene
    assert Scene.model_validate(scene.model_dump()) == scene
    names = names_of_effects() | {"Scene": Scene, "Group": Group, "Spawn": Spawn, "Plane": Plane, "Mesh": Mesh}
    names |= {type(o).__name__: type(o) for o in (*scene.obstacles, scene.integrator)}
    assert eval(repr(scene), names) == scene  # noqa: S307
    np.testing.assert_array_equal(again.run(again.start(3), 5).x, end.x)


def test_invalid_parameters_raise_one_line_messages() -> None:
    for row in EFFECTS:
        good = row.effect.model_dump()
        for name, field in type(row.effect).model_fields.items():
            if name == "kind":
                continue
            # None is valid for optional fields: all neighbours, a steady field
            some = (None,) if field.default is not None else (0, 33, 2.5, True) if name == "nearest" else ()
            negative = () if name in row.signed else (-1.0,)
            for value in (*negative, float("nan"), float("inf"), "much", *some):
                with pytest.raises(ValueError, match=name) as caught:
                    type(row.effect)(**{**good, name: value})
                assert "\n" not in str(caught.value)


# --- a second process -------------------------------------------------------------------------------------------------

SECOND = """
import json, sys
from tests.catalogue import EFFECTS, scene_under
found = {}
for row in EFFECTS:
    for dimension in row.dimensions:
        scene = scene_under(row, dimension)
        end = scene.run(scene.start(3), 5)
        found[f"{row.name} {dimension}"] = end.x.tobytes().hex()
        assert sum(scene.stepper.move.stats.cache_misses.values()) == 0, f"{row.name} was compiled again"
json.dump(found, sys.stdout)
"""


@pytest.mark.slow  # the first process compiles all effects
def test_second_process_compiles_nothing_and_gets_equal_results() -> None:
    here = {}
    for row in EFFECTS:
        for dimension in row.dimensions:
            scene = scene_under(row, dimension)
            here[f"{row.name} {dimension}"] = scene.run(scene.start(3), 5).x.tobytes().hex()
    done = subprocess.run(
        [sys.executable, "-c", SECOND],
        cwd=Path(__file__).resolve().parent.parent,
        env={"FLOCKENV_CACHE": str(cache_folder()), "PYTHONPATH": str(Path(flockenv.__file__).parent.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == here


# --- closed forms and limits ------------------------------------------------------------------------------------------


def test_velocity_decays_exponentially_under_drag() -> None:
    """v = v0 exp(-c t / m), x = x0 + v0 (1 - exp(-c t / m)) m / c, with the mass m of each body."""
    scene = scene_of(Drag(rate=0.4), integrator=RK4(), dt=0.02)
    start = scene.start(1)
    end = scene.run(start, 150)
    decay = 0.4 / scene.body.mass[None, :, None]
    np.testing.assert_allclose(end.vel, start.vel * np.exp(-decay * 3), rtol=1e-8)
    np.testing.assert_allclose(end.pos - start.pos, start.vel * (1 - np.exp(-decay * 3)) / decay, rtol=1e-8)


@DIMENSIONS
def test_speed_limit_holds_along_the_diagonal(dimension: int) -> None:
    """A limit on each axis would allow sqrt(D) times the speed."""
    spawn = Spawn(low=(0,) * dimension, high=(1,) * dimension)
    scene = scene_of(dimension=dimension, groups=(Group(count=3, max_speed=2, spawn=spawn),))
    end = scene.step(scene.start(0), drive=np.full((1, 3, dimension), 50.0), steps=100)
    np.testing.assert_allclose(np.linalg.norm(end.vel, axis=2), 2, rtol=1e-12)
    np.testing.assert_allclose(end.vel, 2 / np.sqrt(dimension))


def forces(scene: Scene, state: State, drive: Array) -> Array:
    return (scene.step(state, drive=drive).vel - state.vel) / scene.dt * scene.body.mass[None, :, None]


@DIMENSIONS
def test_max_force_bounds_steering_and_drive_but_not_external_forces(dimension: int) -> None:
    spawn = Spawn(low=(0,) * dimension, high=(0.5,) * dimension, speed=(1, 2))
    groups = (Group(count=9, mass=2, max_force=3, spawn=spawn),)
    drive = np.zeros((1, 9, dimension))
    drive[0, :, 0] = 100.0
    steered = scene_of(Separation(weight=1.3, radius=2.5), dimension=dimension, groups=groups)
    state = steered.start(1)
    strong, weak = forces(steered, state, drive), forces(steered, state, drive * 0)
    np.testing.assert_allclose(np.linalg.norm(strong, axis=2), 3, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(weak, axis=2), 3, rtol=1e-12)  # separation is strong
    assert not np.allclose(strong, weak)  # the sum of drive and steering is bounded
    pushed = scene_of(Drag(rate=5), dimension=dimension, groups=groups)
    expected = -5 * state.vel
    expected[..., 0] += 3
    np.testing.assert_allclose(forces(pushed, state, drive), expected, rtol=1e-10)


# --- laws are functions -----------------------------------------------------------------------------------------------

HELD = """
from typing import Literal

from flockenv.physics.effects import Drag
from flockenv.jit.decorators import law
from flockenv.maths.vectors import add, scale


@law
def pulled(p, me):
    return scale(me.pos, -p.rate)


@law
def drift(p, me):
    return me.vel


def pull(strength, further):
    @law
    def made(p, me):
        return scale(add(me.pos, further(p, me)), -strength * p.rate)

    return made


class Pulled(Drag):
    kind: Literal["pulled_here"] = "pulled_here"
    own_law = pulled


class Made(Drag):
    kind: Literal["made_here"] = "made_here"
    own_law = pull(2.0, drift)


class More(Drag):
    kind: Literal["more_here"] = "more_here"
    own_law = pull(3.0, drift)
"""


def test_law_may_be_assigned_without_an_annotation_and_stays_a_function(tmp_path: Path) -> None:
    with users_module(tmp_path, HELD, "held_laws") as laws:
        assert laws.Pulled(rate=1).own_law is laws.pulled
        scene = scene_of(
            laws.Pulled(rate=2.0), groups=(Group(count=3, mass=0.5, spawn=Spawn(low=(1, 1), high=(2, 2))),)
        )
        start = scene.start(0)
        np.testing.assert_allclose(scene.acceleration(start), -4 * start.pos, rtol=1e-12)


def test_law_made_by_a_function_keeps_its_closure(tmp_path: Path) -> None:
    with users_module(tmp_path, HELD, "held_laws") as laws:
        group = Group(count=3, spawn=Spawn(low=(1, 1), high=(2, 2), speed=(1, 2)))
        for kind, strength in ((laws.Made, 2), (laws.More, 3)):
            scene = scene_of(kind(rate=1), groups=(group,))
            start = scene.start(0)
            np.testing.assert_allclose(scene.acceleration(start), -strength * (start.pos + start.vel), rtol=1e-12)
