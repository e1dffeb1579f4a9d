"""What a step costs through every face of every task: `python -m benchmarks.envs`.

World.step, gymnasium.make (and the environment inside its wrappers), make_vec, PettingZoo's parallel and AEC forms, and
flockenv.envs.sb3.WorldVecEnv: one world, 1024 worlds, and 1024 flocks of 32 learners on one thread and on two. Actions
are drawn before; worlds that are over begin anew, and that is timed too. World.step is what all the others wrap. Beside
each face of one world stands an environment of the same spaces that does nothing: what is left is not ours to save.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from typing import Annotated, Any

import gymnasium
import numpy as np
import pettingzoo
import typer
from gymnasium.envs.registration import EnvSpec

import flockenv  # noqa: F401  # registers the environments
from benchmarks.floors import Machine, machine, of_decisions
from benchmarks.measure import Bench, Contestant, Floor, Out, Quick, Result, Rounds, command_line, number
from flockenv.envs.table import id_of
from flockenv.envs.world import World
from flockenv.jit.thread_pool import use_threads
from flockenv.tasks import TASKS, Flock, Task

__all__ = ["TASK_IDS"]

TASK_IDS = {name: id_of(name.capitalize()) for name in ("pursuit", "obstacles", "flock")}
DRAWS = 16  # sets of random actions, used in turn
WORLDS = 1024
LEARNERS = 32  # of a flock, in the largest race
NOTHING = "of what does nothing"

Step = Callable[[], object]


def _draws(*shape: int) -> Iterator[Any]:
    """Yield random actions in [-1, 1], a number of sets in turn, float32."""
    return cycle(np.random.default_rng(0).uniform(-1, 1, (DRAWS, *shape)).astype(np.float32))


def _named_draws(env: Any) -> Iterator[dict[str, Any]]:
    """Yield random actions of every agent by its name, as PettingZoo takes them."""
    names = env.possible_agents
    drawn = _draws(len(names), *env.action_space(names[0]).shape)
    return cycle([dict(zip(names, next(drawn), strict=True)) for _ in range(DRAWS)])


# --- a step through each face ---------------------------------------------------------------------------------------


def _world_step(task: Task, worlds: int = 1) -> Step:
    world = World(task, worlds, task.horizon)
    world.reset(0)
    actions = _draws(worlds, world.learners, world.action_size)

    def step() -> None:
        ended = world.step(next(actions)).ended
        if ended.any():
            world.reset(mask=ended)

    return step


def _gymnasium_step(env: gymnasium.Env[Any, Any]) -> Step:
    assert env.action_space.shape is not None
    env.reset(seed=0)
    actions = _draws(*env.action_space.shape)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return step


def _vector_step(env: Any, rows: int) -> Step:
    """Step gymnasium's and Stable-Baselines3's vector environments alike: both begin anew by themselves."""
    env.reset()
    actions = _draws(rows, env.action_space.shape[-1])
    return lambda: env.step(next(actions))


def _parallel_step(env: Any) -> Step:
    actions = _named_draws(env)
    env.reset(seed=0)

    def step() -> None:
        action = next(actions)
        env.step({name: action[name] for name in env.agents})
        if not env.agents:
            env.reset()

    return step


def _aec_step(env: Any) -> Step:
    """Step all agents once, one after another, as PettingZoo's own example does."""
    actions = _named_draws(env)
    env.reset(seed=0)

    def step() -> None:
        action = next(actions)
        for _ in range(len(env.agents)):
            _, _, terminated, truncated, _ = env.last()
            env.step(None if terminated or truncated else action[env.agent_selection])
        if not env.agents:
            env.reset()

    return step


class _Nothing(gymnasium.Env[Any, Any]):
    """An environment in which nothing happens: what Gymnasium's wrappers cost around it, it costs around any."""

    def __init__(self, like: gymnasium.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = like.observation_space, like.action_space
        assert self.observation_space.shape is not None
        self._row = np.zeros(self.observation_space.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self._row.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._row.copy(), 0.0, False, False, {}


def _make_nothing(like: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Return it as gymnasium.make makes any."""
    assert like.spec is not None
    spec = EnvSpec("Nothing-v0", lambda: _Nothing(like), max_episode_steps=like.spec.max_episode_steps)
    return gymnasium.make(spec)


class _NobodyActs(pettingzoo.ParallelEnv[str, Any, Any]):
    """The same for PettingZoo: five dictionaries a step, and what lies in them was there before."""

    def __init__(self, like: Any) -> None:
        self.possible_agents, self.action_space = like.possible_agents, like.action_space
        self._row = np.zeros(like.observation_space(self.possible_agents[0]).shape, np.float32)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.agents = self.possible_agents
        return dict.fromkeys(self.agents, self._row), {name: {} for name in self.agents}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
        names = self.agents
        no = dict.fromkeys(names, False)
        return dict.fromkeys(names, self._row), dict.fromkeys(names, 0.0), no, {**no}, {n: {} for n in names}


def _sb3(bench: Bench, task: Task, worlds: int, floor: Floor | None) -> list[Contestant]:
    """Return the face for Stable-Baselines3, if that is installed."""
    try:
        from flockenv.envs.sb3 import WorldVecEnv
    except ImportError as error:
        note = f"no WorldVecEnv: {error}"
        if note not in bench.notes:
            bench.note(note)
        return []
    rows = worlds * task.learners
    return [Contestant("WorldVecEnv", _vector_step(WorldVecEnv(task, worlds), rows), rows, floor)]


# --- the races ------------------------------------------------------------------------------------------------------


def _race_one_learner(bench: Bench, env_id: str, most: Machine | None) -> None:
    """Race the faces of one world with one learner."""
    env = gymnasium.make(env_id)
    task: Task = env.unwrapped.task  # type: ignore[attr-defined]  # our own environment
    floor = _floor(task, 1, most)
    contestants = [
        Contestant("World.step", _world_step(task), 1, floor),
        Contestant("gymnasium.make", _gymnasium_step(env), 1, floor),
        Contestant(NOTHING, _gymnasium_step(_make_nothing(env)), 1),
        Contestant("the first, unwrapped", _gymnasium_step(gymnasium.make(env_id).unwrapped), 1, floor),
        Contestant("make_vec of 1", _vector_step(gymnasium.make_vec(env_id, num_envs=1), 1), 1, floor),
        *_sb3(bench, task, 1, floor),
    ]
    _note_microseconds(bench, bench.race(_title(env_id, task, 1), contestants, baseline="World.step"), 1)


def _race_many_learners(bench: Bench, env_id: str, most: Machine | None) -> None:
    """Race the faces of one world whose learners all have names."""
    env = pettingzoo.make("parallel", env_id)
    task: Task = env.unwrapped.task
    work, floor = task.learners, _floor(task, 1, most)
    contestants = [
        Contestant("World.step", _world_step(task), work, floor),
        Contestant("PettingZoo parallel", _parallel_step(env), work, floor),
        Contestant(NOTHING, _parallel_step(_NobodyActs(env)), work),
        Contestant("PettingZoo AEC", _aec_step(pettingzoo.make("aec", env_id)), work, floor),
        *(_sb3(bench, task, 1, floor) if task.ends_together else []),
    ]
    _note_microseconds(bench, bench.race(_title(env_id, task, 1), contestants, baseline="World.step"), work)


def _race_batches(bench: Bench, env_id: str, most: Machine | None) -> None:
    """Race the faces of many worlds with one learner each."""
    vector: Any = gymnasium.make_vec(env_id, num_envs=WORLDS)
    task: Task = vector.unwrapped.task
    single, floor = task.model_copy(update={"dtype": "float32"}), _floor(task, WORLDS, most)
    contestants = [
        Contestant("World.step", _world_step(task, WORLDS), WORLDS, floor),
        Contestant("World.step, float32", _world_step(single, WORLDS), WORLDS, _floor(single, WORLDS, most)),
        Contestant("make_vec", _vector_step(vector, WORLDS), WORLDS, floor),
        *_sb3(bench, task, WORLDS, floor),
    ]
    bench.race(_title(env_id, task, WORLDS), contestants, baseline="World.step")


def _race_flocks(bench: Bench, threads: Sequence[int], most: Machine | None) -> None:
    """Race 1024 flocks of learners as a vector environment, on one thread and on several."""
    from flockenv.envs.vector import FlockVectorEnv

    rows = WORLDS * LEARNERS
    contestants = []
    flock: dict[str, Any] = {"max_episode_steps": Flock().horizon, "agents": LEARNERS, "learners": LEARNERS}
    for dtype, infos in (("float64", "steps"), ("float32", "steps"), ("float32", "ends")):
        env = FlockVectorEnv(rows, dtype=dtype, infos=infos, **flock)
        step = _vector_step(env, rows)
        kind = dtype if infos == "steps" else f"{dtype}, infos of ends"
        names = {count: f"{kind}, {count} thread{'s' * (count > 1)}" for count in threads}
        for count, name in names.items():
            contestants.append(Contestant(name, _on_threads(count, step), rows, _floor(env.task, WORLDS, most, count)))
    title = f"Flock as a VectorEnv, {WORLDS} worlds x {LEARNERS} learners"
    bench.race(title, contestants, baseline="float64, 1 thread")
    use_threads(1)


def _floor(task: Task, worlds: int, most: Machine | None, threads: int = 1) -> Floor | None:
    return most.floor(of_decisions(task, worlds), threads) if most else None


def _on_threads(threads: int, step: Step) -> Step:
    """Return a step on a number of threads."""

    def call() -> None:
        use_threads(threads)
        step()

    return call


def _title(env_id: str, task: Task, worlds: int) -> str:
    many = "one world" if worlds == 1 else f"{worlds} worlds"
    return (
        f"{env_id.split('/')[1]}, {many}: {task.learners} of {task.agents} learn, {task.layout.size} observations, "
        f"{task.substeps} substeps, {task.dtype}"
    )


def _note_microseconds(bench: Bench, results: Sequence[Result], work: int) -> None:
    """Say what a step of one world takes, and what each face adds to World.step."""
    if not results or not results[0].rates:
        return
    inside = results[0]
    texts = []
    for r in results:
        took = 1e6 * work / r.rate
        more = statistics.median(1e6 * work * (1 / a - 1 / b) for a, b in zip(r.rates, inside.rates, strict=False))
        wraps = r.name not in (inside.name, NOTHING)
        texts.append(f"{r.name} {number(took)}" + (f" (+{number(more)})" if wraps else ""))
    bench.note(f"{inside.race.split(':')[0]}, microseconds per step of the world: {'; '.join(texts)}.")


def main(
    only: Annotated[str, typer.Option(help=f"One task: {', '.join(TASK_IDS)}.")] = "",
    threads: Annotated[int, typer.Option(min=1, help="Largest number of threads; 1 is always measured.")] = 2,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure a step through every face of every task, alone and batched."""
    if only and only not in TASK_IDS:
        raise typer.BadParameter(f"--only {only!r}: unknown; allowed: {', '.join(TASK_IDS)}")
    use_threads(1)
    ids = [env_id for name, env_id in TASK_IDS.items() if only in ("", name) and name in TASKS]
    several = (1,) if threads == 1 else (1, threads)
    with Bench("envs", quick, rounds, out, unit="k agent-steps/s", scale=1e3) as bench:
        most = machine(bench, *several)
        for env_id in ids:
            _race_one_learner(bench, env_id, most)
        for env_id in ids:
            if env_id in pettingzoo.parallel_registry:
                _race_many_learners(bench, env_id, most)
        for env_id in ids:
            _race_batches(bench, env_id, most)
        if only in ("", "flock"):
            _race_flocks(bench, several, most)
        bench.note("Agent-steps are decisions of learners: physics steps within one are not counted. One thread.")


if __name__ == "__main__":
    command_line(main)()
