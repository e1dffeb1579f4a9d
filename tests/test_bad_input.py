"""Bad input and odd requests to scenes and environments, a function for each.

A refusal is one line that names the key, the given value and the allowed ones, and it changes nothing. Other requests
do what is documented. The file of tests of each module has more refusals.
"""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.error import ResetNeeded

import flockenv  # noqa: F401  # registers the environments
from flockenv.behaviours import Alignment, Queue, Separation
from flockenv.cli.main import main
from flockenv.envs.world import World
from flockenv.geometry.shapes import HalfSpace, Polygon
from flockenv.geometry.space import Box, Torus
from flockenv.model.networks import Mesh
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag, Springs
from flockenv.physics.integrators import VelocityVerlet
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.measures import measure
from flockenv.tasks import Pursuit

SPAWN = Spawn(low=(1, 1), high=(3, 3), speed=(1, 1))
FLOCK = (Separation(weight=2, radius=2), Alignment(weight=0.1, radius=2))
"""Effects of all flocks here, so that these share one kernel."""

GOOD = """\
space: {kind: torus, size: [8, 6]}
groups:
  - {count: 3}
effects:
  - {kind: drag, rate: 0.3}
dt: 0.01
"""
PURSUIT = "flockenv/Pursuit-v0"


# --- helpers ----------------------------------------------------------------------------------------------------------


def refused(make: Callable[[], Any], *parts: str) -> None:
    """Assert that `make` raises a ValueError or TypeError of one line with all of these parts."""
    with pytest.raises((ValueError, TypeError)) as caught:
        make()
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 500
    for part in parts:
        assert part in line, line


def written(old: str, new: str, *parts: str) -> None:
    """Assert the same of a file in which `old` is replaced by `new`."""
    assert old in GOOD
    refused(lambda: load_scene(GOOD.replace(old, new)), *parts)


def scene(*effects: Any, **fields: Any) -> Scene:
    return Scene(**{"groups": (Group(count=3, spawn=SPAWN),), "effects": effects, "dt": 0.1} | fields)


def net(**fields: Any) -> Mesh:
    return Mesh(**{"vertices": ((0, 0), (1, 0), (1, 1)), "bars": ((0, 1), (1, 2))} | fields)


def single(**fields: Any) -> Any:
    return gymnasium.make(PURSUIT, **fields).unwrapped


def team(**fields: Any) -> Any:
    return pettingzoo.make("parallel", PURSUIT, **fields)


def still(env: Any) -> dict[str, Any]:
    return {name: np.zeros(2) for name in env.agents}


def same(a: Any, b: Any) -> None:
    np.testing.assert_equal(a, b)


def fresh(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# --- scenes -----------------------------------------------------------------------------------------------------------


def b01_dt(tmp_path: Path) -> None:
    for value, shown in (
        (0, "0"),
        (-0.01, "-0.01"),
        (np.nan, "nan"),
        (np.inf, "inf"),
        ("1e-3", "'1e-3'"),
        (True, "True"),
    ):
        refused(lambda value=value: scene(dt=value), f"dt = {shown}", "must be a")
    for text, shown in (("0", "dt = 0"), ("-.01", "-0.01"), (".nan", ".nan"), (".inf", ".inf"), ("'1e-3'", "not text")):
        written("dt: 0.01", f"dt: {text}", "text:6: dt", shown)


def b02_no_time(tmp_path: Path) -> None:
    out = tmp_path / "x.npz"
    assert main(["run", str(fresh(tmp_path, GOOD)), "--duration", "0", "--out", str(out)]) == 0
    begun = load_scene(GOOD).start(0)
    with np.load(out) as kept:
        same(kept["pos"], begun.pos)
        same(kept["time"], [0.0])
    same(load_scene(GOOD).run(begun, 0).pos, begun.pos)


def b03_time_is_no_multiple(tmp_path: Path) -> None:
    path = fresh(tmp_path, GOOD.replace("dt: 0.01", "dt: 0.3"))
    assert main(["run", str(path), "--duration", "1.0"]) == 2
    refused(lambda: Pursuit(control_dt=1.0, dt=0.3), "control_dt = 1 s", "a whole multiple of dt = 0.3 s")
    made = scene(dt=0.1)
    assert made.run(made.start(0), 10).time[0] == 1.0  # steps are counted, not summed up


def b04_no_agent_and_one(tmp_path: Path) -> None:
    written("count: 3", "count: 0", "groups[0].count = 0", ">= 1")
    alone = scene(*FLOCK, groups=(Group(count=1, spawn=SPAWN),))
    begun = alone.start(0)
    end = alone.run(begun, 5)
    same(end.vel, begun.vel)
    assert np.isnan(measure(alone, end)["nearest_neighbour"])  # written as null


def b05_counts(tmp_path: Path) -> None:
    for text in ("-1", "2.5", "ten"):
        written("count: 3", f"count: {text}", "groups[0].count = ", "must be an integer >= 1")
    for text in ("1000000000", "1e30"):
        written("count: 3", f"count: {text}", "groups: 1,000,000,000", "GiB")


def b06_bodies(tmp_path: Path) -> None:
    for value in (0, -1, np.nan):
        refused(lambda value=value: Group(count=1, mass=value), f"mass = {value}", "> 0")
    refused(lambda: Group(count=1, radius=-1), "radius = -1", ">= 0")
    assert Group(count=1, radius=0).radius == 0  # a point
    big = (Group(count=1, radius=5),)
    refused(lambda: scene(space=Box(size=(8, 6)), groups=big), "groups[0].radius = 5", "does not fit", "(8.0, 6.0)")


def b08_unknown_names(tmp_path: Path) -> None:
    written("dt: 0.01", "dtt: .01", "dtt = 0.01: unknown key, did you mean `dt`")
    written("kind: drag", "kind: dragg", "effects[0].kind = 'dragg': unknown, did you mean `drag`")
    written("dt: 0.01", "integrator: {kind: rk44}", "integrator.kind = 'rk44': unknown, did you mean `rk4`")


def b09_given_twice(tmp_path: Path) -> None:
    written("dt: 0.01", "dt: 0.01\ndt: 0.02", "dt: given twice, first on line 6")


def b10_exponents(tmp_path: Path) -> None:
    assert load_scene(GOOD.replace("dt: 0.01", "dt: 1e-3")).dt == 0.001


def b11_tags(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    written("dt: 0.01", f"dt: !!python/object/apply:os.system ['touch {marker}']", "dt: the tag", "is not read")
    assert not marker.exists()


def b13_files(tmp_path: Path) -> None:
    for content, part in (
        (b"", "empty"), (bytes(range(256)), "binary data"), (GOOD.encode("utf-16"), "save it as UTF-8"),
        (b"a: 1\n" * 10**7, "larger than 1000000 bytes"),
    ):  # fmt: skip
        refused(lambda content=content: load_scene(fresh(tmp_path, content)), "scene.yaml", part)
    assert load_scene(fresh(tmp_path, b"\xef\xbb\xbf" + GOOD.encode())) == load_scene(GOOD)


def b14_no_numbers(tmp_path: Path) -> None:
    for text in (".nan", ".inf", "-.inf", "1e999"):
        written("rate: 0.3", f"rate: {text}", "effects[0].rate", text)


def b16_signs(tmp_path: Path) -> None:
    for value in (-0.1, 1.5):
        refused(lambda value=value: Box(size=(8, 6), restitution=value), f"restitution = {value}", "0", "1")
    refused(lambda: Drag(rate=-1), "rate = -1", ">= 0")  # a negative rate would add energy
    refused(lambda: Springs(stiffness=1, damping=-1), "damping = -1", ">= 0")
    refused(lambda: Queue(weight=1, target=(0, 0), headway=0), "headway = 0", "> 0")
    # friction, and restitution between bodies: see the tests of collisions


def b17_springs(tmp_path: Path) -> None:
    refused(lambda: net(bars=((0, 3),)), "bars[0] = (0, 3)", "0 to 2")
    refused(lambda: net(bars=((0, 1), (2, 2))), "bars[1] = (2, 2)", "twice")
    refused(lambda: net(bars=((0, 1), (1, 0))), "bars[1] = (1, 0)", "the same as bars[0]")
    refused(lambda: net(rest=(-1, 1)), "rest[0] = -1")
    refused(lambda: Springs(stiffness=np.inf), "stiffness = inf")


def b18_small_worlds(tmp_path: Path) -> None:
    small = Torus(size=(8, 6))
    refused(lambda: scene(Separation(weight=1, radius=3.1), space=small), "effects[0].radius = 3.1", "3 m, is allowed")
    for kind in (Torus, Box):
        refused(lambda kind=kind: kind(size=(8, 0)), "size[1] = 0", "> 0")
        refused(lambda kind=kind: kind(size=(-8, 6)), "size[0] = -8", "> 0")
    wide = (Group(count=1, radius=3.5),)
    refused(lambda: scene(space=small, groups=wide), "groups[0].radius = 3.5", "fit into a torus", "(8.0, 6.0)")


def b20_polygons(tmp_path: Path) -> None:
    refused(lambda: Polygon(vertices=((0, 0), (1, 0))), "vertices", "a list of 3 to")
    refused(lambda: Polygon(vertices=((0, 0), (1, 0), (2, 0))), "vertices")
    refused(lambda: Polygon(vertices=((0, 0), (1, 1), (1, 0), (0, 1))), "vertices", "cross")
    refused(lambda: Polygon(vertices=((0, 0), (1, 0), (0, np.nan))), "vertices[2][1] = nan")
    corners = ((0, 0), (2, 0), (2, 1), (0, 1))
    for place in ((1.0, 0.4), (3.0, 1.0)):  # clockwise is the same shape
        assert Polygon(vertices=corners[::-1]).gap(place) == pytest.approx(float(Polygon(vertices=corners).gap(place)))


def b21_starting_positions(tmp_path: Path) -> None:
    half = scene(obstacles=(HalfSpace(point=(2, 2), direction=(1, 0)),)).start(0)
    assert (half.pos[..., 0] >= 2.1).all()  # drawn again until they are outside
    there = Group(count=3, spawn=Spawn(low=(1, 1), high=(1, 1)))
    heap = scene(*FLOCK, groups=(there,))
    end = heap.run(heap.start(0), 20)
    apart = np.linalg.norm(end.pos[0, :, None] - end.pos[0], axis=-1)[np.triu_indices(3, 1)]
    assert np.isfinite(end.pos).all()
    assert apart.min() > 0.1
    # no room outside an obstacle, overlapping bodies, a door narrower than a body: see the tests of collisions


# --- environments -----------------------------------------------------------------------------------------------------


def b22_seeds(tmp_path: Path) -> None:
    env, world = single(), World(Pursuit(), 1)
    for seed in (-1, 1.5, "abc", 2**64):
        refused(lambda seed=seed: env.reset(seed=seed), "seed", str(seed).strip("'"))
        refused(lambda seed=seed: world.reset(seed), "seed", str(seed))
    _, info = env.reset()
    same(single().reset(seed=info["seed"])[0], env.reset(seed=info["seed"])[0])


def b23_out_of_turn(tmp_path: Path) -> None:
    with pytest.raises(ResetNeeded, match="reset"):
        single().step(np.zeros(2))
    env = team(capture_distance=100.0)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step({})
    env.reset(seed=0)
    env.step(still(env))
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})  # as in PettingZoo's own environments
    with pytest.raises(ResetNeeded, match="reset"):
        env.step({env.possible_agents[0]: np.zeros(2)})
    closed = single()
    closed.reset(seed=0)
    closed.close()
    with pytest.raises(ResetNeeded, match="reset"):
        closed.step(np.zeros(2))


def b24_names(tmp_path: Path) -> None:
    env = team(pursuers=2, sides="both", capture_distance=1e-3)
    env.reset(seed=0)
    kept, good = env.state(), still(env)
    first = env.agents[0]
    refused(lambda: env.step({k: v for k, v in good.items() if k != first}), f"'{first}'")
    refused(lambda: env.step({**good, f"{first}0": np.zeros(2)}), f"'{first}0'", f"did you mean `{first}`")
    same(env.state(), kept)


def b25_actions(tmp_path: Path) -> None:
    env = single()
    env.reset(seed=3)
    kept = env.world.state.copy()
    for bad in ([np.nan, 0], [np.inf, 0], np.zeros(3), np.zeros((2, 1)), "left", None, 0.5):
        refused(lambda bad=bad: env.step(bad), "action")
    same(env.world.state.pos, kept.pos)
    found = []
    wide = np.array([[0.5, 9.0], [0.25, 9.0]])
    for action in (
        [0.5, 0.25], (0.5, 0.25), np.array([0.5, 0.25], np.float32), np.array([0.5, 0.25], np.float16), wide[:, 0],
        np.array([0.5, 0.25], ">f8"),
    ):  # fmt: skip
        env.reset(seed=3)
        found.append(env.step(action)[0])
    for other in found[1:]:
        same(other, found[0])
    env.reset(seed=3)
    assert np.isfinite(env.step(np.array([1e300, -1e300]))[0]).all()
    env.reset(seed=3)
    whole = env.step(np.array([1, -1]))[0]  # integers
    env.reset(seed=3)
    same(whole, env.step(np.array([1.0, -1.0]))[0])


def b26_bounds(tmp_path: Path) -> None:
    """Every face clips to the bound, from just beyond it and from far beyond."""
    env, many, side = single(), gymnasium.make_vec(PURSUIT, 2), team()
    found = []
    for action in (1.0, np.nextafter(1.0, 2.0), 7.0):
        actions = np.array([action, -action])
        env.reset(seed=4)
        many.reset(seed=4)
        side.reset(seed=4)
        found.append((env.step(actions)[0], side.step(dict.fromkeys(side.agents, actions))[0]))
        same(many.step(np.tile(actions, (2, 1)))[0][0], found[-1][0])
    for other in found[1:]:
        same(other, found[0])


def b28_resets(tmp_path: Path) -> None:
    env = single()
    same(env.reset(seed=5)[0], env.reset(seed=5)[0])
    refused(lambda: env.reset(options={"bogus": 1}), "'bogus'")


def b29_closing(tmp_path: Path) -> None:
    env = single(render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="reset"):
        env.render()
    env.close()
    env.close()
    blind = single()
    blind.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert blind.render() is None


def b30_copies(tmp_path: Path) -> None:
    env, rng = single(), np.random.default_rng(0)
    env.reset(seed=6)
    for _ in range(20):
        env.step(rng.uniform(-1, 1, 2))
    twins = (copy.deepcopy(env), pickle.loads(pickle.dumps(env)))
    for _ in range(1000):
        action = rng.uniform(-1, 1, 2)
        outcomes = [each.step(action)[:4] for each in (env, *twins)]
        same(outcomes[1], outcomes[0])
        same(outcomes[2], outcomes[0])
        if outcomes[0][2] or outcomes[0][3]:
            for each in (env, *twins):
                each.reset()


def played(seed: int, steps: int = 60) -> Any:
    """Return the observations of a new world under random actions."""
    world, rng = World(Pursuit(), 1), np.random.default_rng(seed)
    world.reset(seed)
    return np.array([world.step(rng.uniform(-1, 1, (1, 1, 2))).observation for _ in range(steps)])


def b32_side_by_side(tmp_path: Path) -> None:
    expected = {seed: played(seed) for seed in range(8)}
    worlds, rngs = [World(Pursuit(), 1) for _ in range(2)], [np.random.default_rng(seed) for seed in range(2)]
    for seed, world in enumerate(worlds):
        world.reset(seed)
    steps = [
        [w.step(r.uniform(-1, 1, (1, 1, 2))).observation for w, r in zip(worlds, rngs, strict=True)] for _ in range(60)
    ]
    for seed in range(2):
        same(np.array([step[seed] for step in steps]), expected[seed])
    with ThreadPoolExecutor(8) as pool:
        for seed, found in enumerate(pool.map(played, range(8))):
            same(found, expected[seed])
    with multiprocessing.get_context("spawn").Pool(1) as pool_:  # forked children: see test_threads.py
        same(pool_.apply(played, (1,)), expected[1])


def b33_states(tmp_path: Path) -> None:
    made = scene()
    state = made.start(0)
    kept = state.copy()
    bad = state.pos.copy()
    bad[0, 1, 0] = np.nan
    refused(lambda: state.with_motion(bad, state.vel), "pos", "NaN", "(0, 1, 0)")
    refused(lambda: state.with_motion(bad[:, :2], state.vel[:, :2]), "pos has shape (1, 2, 2)", "(1, 3, 2)")
    same(state.pos, kept.pos)
    other = scene(groups=(Group(count=4, spawn=SPAWN),)).start(0)
    refused(lambda: made.step(other), "(4, 2)", "(3, 2)")


def b34_another_method(tmp_path: Path) -> None:
    """A state keeps nothing of its method: another one continues as from the start. A new dt must be declared."""
    made = scene(Drag(rate=0.5))
    verlet = made.model_copy(update={"integrator": VelocityVerlet()})
    state = verlet.run(verlet.start(0), 5)
    anew = made.start(0).with_motion(state.pos, state.vel)
    same(made.step(state).pos, made.step(anew).pos)
    moved = state.with_motion(state.pos + 1, -state.vel)  # no acceleration of the former positions is reused
    clean = verlet.start(0).with_motion(state.pos + 1, -state.vel)
    same(verlet.step(moved).vel, verlet.step(clean).vel)
    finer = made.model_copy(update={"dt": 0.05})
    refused(lambda: finer.step(state), "counts steps of 0.1 s", "steps of 0.05 s", "with_dt")
    assert finer.step(state.with_dt(0.05)).time[0] == pytest.approx(0.55)


def b35_toggled(tmp_path: Path) -> None:
    slow, free = scene(Drag(rate=0.5)), scene()
    state = slow.run(slow.start(0), 3)
    same(slow.with_effects().step(state).vel, free.step(state).vel)
    assert (slow.step(state).vel != free.step(state).vel).all()


def b36_all_at_once(tmp_path: Path) -> None:
    env = team(pursuers=2, sides="both", capture_distance=100.0)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(still(env))
    assert all(terminated.values())
    assert not any(truncated.values())
    assert env.agents == []
    env = team(max_cycles=1, capture_distance=1e-3)
    env.reset(seed=0)
    env.agents.clear()  # `agents` returns a new list each time
    assert env.agents == env.possible_agents
    _, _, terminated, truncated, _ = env.step(still(env))
    assert all(truncated.values())
    assert not any(terminated.values())


def b38_observations(tmp_path: Path) -> None:
    """1e5 decisions, in corners and at full speed."""
    many, rng = gymnasium.make_vec(PURSUIT, 500), np.random.default_rng(0)
    space = many.observation_space
    many.reset(seed=0)
    for k in range(200):
        actions = rng.uniform(-1, 1, (500, 2)) if k % 2 else np.sign(rng.uniform(-1, 1, 2)) * np.ones((500, 2))
        seen = many.step(actions)[0]
        assert seen.dtype == np.float32
        assert seen in space


ROWS = (
    b01_dt, b02_no_time, b03_time_is_no_multiple, b04_no_agent_and_one, b05_counts, b06_bodies, b08_unknown_names,
    b09_given_twice, b10_exponents, b11_tags, b13_files, b14_no_numbers, b16_signs, b17_springs, b18_small_worlds,
    b20_polygons, b21_starting_positions, b22_seeds, b23_out_of_turn, b24_names, b25_actions, b26_bounds, b28_resets,
    b29_closing, b30_copies, b32_side_by_side, b33_states, b34_another_method, b35_toggled, b36_all_at_once,
    b38_observations,
)  # fmt: skip
"""All functions of requests."""


SLOW = (b34_another_method,)
"""Functions that compile another method."""


@pytest.mark.parametrize(
    "row",
    [pytest.param(row, marks=pytest.mark.slow) if row in SLOW else row for row in ROWS],
    ids=[row.__name__ for row in ROWS],
)
def test_bad_input(row: Callable[[Path], None], tmp_path: Path) -> None:
    row(tmp_path)
