"""flockenv's side of every comparison: run by the Python that flockenv is installed in."""

import math
import warnings
from itertools import count, cycle
from typing import Any

from turns import DRAWS, Case, run

WORLDS, HORIZON = 1024, 300  # decisions until the time limit


def flock_batch(agents: int) -> Case:
    """The Flock task in 1024 worlds, every agent a learner, through World.step."""
    import numpy as np

    from flockenv.envs.world import World
    from flockenv.tasks import Flock

    task = Flock(agents=agents, obstacle_count=5)
    does = (
        f"Flock, {WORLDS} worlds x {agents} learners, 5 obstacles, {task.scene.dtype}: drives in {task.substeps} "
        f"substeps; {task.layout.size} observations each (6 neighbours, 16 free ways), 6 reward terms, metrics"
    )
    return _batch_case(World(task, WORLDS, HORIZON), np.random.default_rng(0), does)


def flock_vector(threads: int) -> Case:
    """The Flock task as gymnasium's VectorEnv, every agent of 1024 worlds a row of it, in float32."""
    import numpy as np

    from benchmarks.floors import of_decisions
    from flockenv.envs.vector import FlockVectorEnv
    from flockenv.jit.thread_pool import use_threads

    use_threads(threads)
    agents, rows = 32, WORLDS * 32
    env = FlockVectorEnv(
        rows, HORIZON, autoreset_mode="SameStep", infos="ends", agents=agents, learners=agents, dtype="float32"
    )
    env.reset(seed=0)
    actions = cycle(np.random.default_rng(0).uniform(-1, 1, (DRAWS, rows, 2)).astype(np.float32))
    task = env.task
    does = (
        f"Flock as a VectorEnv, {WORLDS} worlds x {agents} learners, {task.obstacle_slots} obstacles, float32: drives "
        f"in {task.substeps} substeps; {task.layout.size} observations each, 6 reward terms, metrics, infos of "
        "episodes that end, resets"
    )
    return Case(lambda: env.step(next(actions)), rows, does, of_decisions(task, WORLDS))


def flock_after_a_pass(threads: int) -> Case:
    """The same, and before every step what a policy of two layers of 64 answers to as many rows."""
    import torch

    from flockenv.tasks import Flock

    torch.set_num_threads(threads)
    case, seen = flock_vector(threads), Flock(agents=32, learners=32).layout.size
    hidden = [torch.nn.Linear(seen, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()]
    network, rows = torch.nn.Sequential(*hidden, torch.nn.Linear(64, 2)), torch.zeros(WORLDS * 32, seen)

    def step() -> None:
        with torch.no_grad():
            network(rows)
        case.step()

    does = f"a forward pass of torch, {seen}-64-64-2, over all rows; then {case.does}"
    return case._replace(step=step, does=does, work=None)


def pursuit_batch(threads: int) -> Case:
    """The Pursuit task in 1024 worlds: three chase one, all four learn, through World.step."""
    import numpy as np

    from flockenv.envs.world import World
    from flockenv.tasks import Pursuit

    task = Pursuit(pursuers=3, evaders=1, sides="both")
    does = (
        f"Pursuit, {WORLDS} worlds x 4 learners, {task.scene.dtype}: drives in {task.substeps} substeps, walls; "
        f"{task.layout.size} observations each, 3 reward terms, captures, metrics"
    )
    return _batch_case(World(task, WORLDS, HORIZON), np.random.default_rng(0), does)


def _batch_case(world: Any, rng: Any, does: str) -> Case:
    """Step under random actions drawn before, and reset the worlds that are over (that is timed too)."""
    from benchmarks.floors import of_decisions

    world.reset(0)
    actions = cycle(rng.uniform(-1, 1, (DRAWS, world.worlds, world.learners, world.action_size)))

    def step() -> None:
        ended = world.step(next(actions)).ended
        if ended.any():
            world.reset(mask=ended)

    return Case(step, world.worlds * world.learners, does, of_decisions(world.task, world.worlds))


def flock_parallel(threads: int) -> Case:
    """The Flock task as a PettingZoo parallel environment."""
    from flockenv.envs import flock_v1

    env = flock_v1.parallel_env(max_cycles=HORIZON, agents=3, obstacle_count=3)
    size = env.task.layout.size
    return _parallel_case(
        env, 3, f"Flock, one world x 3 agents, 3 obstacles: drives in {env.task.substeps} substeps; {size} "
        "observations each, rewards, metrics"
    )  # fmt: skip


def pursuit_parallel(pursuers: int, evaders: int) -> Case:
    """The Pursuit task as a PettingZoo parallel environment; both sides are agents."""
    from flockenv.envs import pursuit_v0

    env = pursuit_v0.parallel_env(max_cycles=HORIZON, pursuers=pursuers, evaders=evaders)
    size = env.task.layout.size
    return _parallel_case(
        env, pursuers + evaders,
        f"Pursuit, one world x {pursuers} + {evaders} agents (pursuers, evaders; all counted): drives in "
        f"{env.task.substeps} substeps, walls; {size} observations each, rewards, metrics",
    )  # fmt: skip


def _parallel_case(env: Any, agents: int, does: str) -> Case:
    """Step with actions drawn before, and reset where an episode is over (that is timed too)."""
    from benchmarks.floors import of_decisions

    env.reset(seed=0)
    spaces = {name: env.action_space(name) for name in env.possible_agents}
    actions = cycle([{name: space.sample() for name, space in spaces.items()} for _ in range(DRAWS)])

    def step() -> None:
        action = next(actions)
        env.step({name: action[name] for name in env.agents})
        if not env.agents:
            env.reset()

    return Case(step, agents, does, of_decisions(env.task))


def boids(agents: int, edge: float, reach: float, apart: float, about: str) -> Case:
    """One world of boids on a torus, all three rules, through Scene.step in place."""
    from benchmarks.floors import of_scene
    from flockenv.behaviours import Alignment, Cohesion, Separation
    from flockenv.geometry.space import Torus
    from flockenv.model.spawn import Spawn
    from flockenv.scene import Group, Scene

    scene = Scene(
        space=Torus(size=(edge, edge)),
        groups=(Group(count=agents, max_speed=1.0, max_force=2.0, spawn=Spawn(speed=(0.5, 1.0))),),
        effects=(
            Separation(weight=1.0, radius=apart),
            Alignment(weight=0.5, radius=reach),
            Cohesion(weight=0.03, radius=reach),
        ),
        dt=0.05,
    )
    state = scene.start(seed=0)
    does = (
        f"boids, one world x {agents} on a torus {edge:.3g} m wide, {scene.dtype}: separation (radius {apart:g}), "
        f"alignment and cohesion (radius {reach:.3g}), all at once; no observations, no rewards{about}"
    )
    return Case(lambda: scene.step(state, out=state), agents, does, of_scene(scene, state))


def like_mesa(agents: int) -> Case:
    """Mesa's box and radii."""
    return boids(agents, 100 * math.sqrt(agents / 100), 10.0, 2.0, "")


def social_corridor(agents: int) -> Case:
    """A crowd under the preset of 2000 in a corridor of 300 m, a person per square metre at first."""
    from flockenv.geometry.shapes import Wall
    from flockenv.model.spawn import Spawn
    from flockenv.physics.effects import Course
    from flockenv.scene import Group, Scene
    from flockenv.scene.presets import preset

    wide, long = 32.0, 300.0  # m
    people = Group(
        count=agents, mass=80.0, radius=0.3, desired_speed=0.8,
        spawn=Spawn(low=(1.0, 1.0), high=(1.0 + agents * wide / 1000, wide - 1.0), spacing=0.95, jitter=0.1),
    )  # fmt: skip
    effects = preset("helbing_farkas_vicsek_2000")
    corners = ((0.0, 0.0), (long, 0.0), (long, wide), (0.0, wide))
    walls = tuple(Wall(vertices=(corners[k - 1], corners[k])) for k in range(4))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # contacts last for 6 steps, as on the other side
        scene = Scene(groups=(people,), effects=(Course(direction=(1, 0)), *effects), obstacles=walls, dt=0.01)
    does = (
        f"social force model, one crowd of {agents} people, 1 per m2 at first, float64, dt 0.01 s, semi-implicit: "
        "repulsion within 1.6 m (beyond it is below 4e-4 m/s2), body force and friction, four walls, one way to go; "
        "no observations, no rewards"
    )
    return _crowd_case(scene, does)


def social_field(agents: int) -> Case:
    """A crowd under the preset of 2009 in the open, a person per square metre at first, all the same way."""
    from flockenv.model.spawn import Spawn
    from flockenv.physics.effects import Course
    from flockenv.scene import Group, Scene
    from flockenv.scene.presets import preset

    edge = math.sqrt(agents)
    people = Group(
        count=agents, mass=80.0, radius=0.25, desired_speed=1.3, spawn=Spawn(low=(0.0, 0.0), high=(edge, edge))
    )
    scene = Scene(groups=(people,), effects=(Course(direction=(1, 0)), *preset("moussaid_2009")), dt=0.02)
    does = (
        f"social force of Moussaid 2009, one crowd of {agents} people, 1 per m2 at first, float64: turning and slowing "
        "down for all within 8 m, no walls; no observations, no rewards"
    )
    return _crowd_case(scene, does)


def _crowd_case(scene: Any, does: str) -> Case:
    """Make ten steps per call, and begin again after 2,000, before it piles up or is gone (that is timed too)."""
    from benchmarks.floors import of_scene

    start = scene.start(seed=0)
    state = scene.step(start, steps=10)

    def step() -> None:
        scene.step(state, out=state, steps=10)
        if state.tick[0] % 2000 == 0:
            state.x[...], state.v[...] = start.x, start.v

    return Case(step, 10 * scene.agents, does + "; ten steps a call", of_scene(scene, state, 10))


def declared(size: str, worlds: int = 1) -> Case:
    """The flocking model of the comparison of ABM frameworks, by the file that is contributed there."""
    from release.abm.Flocking.flockenv.flocking import LARGE, SMALL, flocking_model, run_model

    scene, seeds, steps = flocking_model(**{"small": SMALL, "large": LARGE}[size]), count(), 100
    many = f"{worlds} new worlds" if worlds > 1 else "a new world"
    does = f"own effect, {many} of {scene.agents} and {steps} steps, float64; all birds are updated at once"
    return Case(lambda: run_model(scene, next(seeds), steps, worlds), worlds * steps * scene.agents, does)


CASES = {
    "flock_4": lambda threads: flock_batch(4),
    "flock_3": lambda threads: flock_batch(3),
    "flock_32": lambda threads: flock_batch(32),
    "flock_vector": flock_vector,
    "flock_after_a_pass": flock_after_a_pass,
    "pursuit": pursuit_batch,
    "parallel_flock": flock_parallel,
    "parallel_tag": lambda threads: pursuit_parallel(3, 1),
    "parallel_pursuit": lambda threads: pursuit_parallel(8, 30),
    "boids_100": lambda threads: like_mesa(100),
    "boids_300": lambda threads: like_mesa(300),
    "crowd_1000": lambda threads: social_corridor(1000),
    "crowd_100": lambda threads: social_field(100),
    "crowd_500": lambda threads: social_field(500),
    "declared_small": lambda threads: declared("small"),
    "declared_large": lambda threads: declared("large"),
    "declared_small_100": lambda threads: declared("small", 100),
    "declared_large_100": lambda threads: declared("large", 100),
}

if __name__ == "__main__":
    run(CASES, "flockenv", "numba", "numpy")
