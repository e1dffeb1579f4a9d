"""MPE2: the multi-agent particle environments, one world in Python and numpy, as PettingZoo parallel environments."""

from itertools import cycle
from typing import Any

from turns import DRAWS, Case, run

CYCLES = 300  # steps of an episode, the same for ours


def parallel(env: Any, agents: int, does: str) -> Case:
    """Step with actions drawn before, and reset where an episode is over (that is timed too)."""
    env.reset(seed=0)
    spaces = {name: env.action_space(name) for name in env.possible_agents}
    actions = cycle([{name: space.sample() for name, space in spaces.items()} for _ in range(DRAWS)])

    def step() -> None:
        env.step(next(actions))
        if not env.agents:
            env.reset()

    return Case(step, agents, does)


def spread(threads: int) -> Case:
    """The simple_spread environment: three agents share three landmarks."""
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(max_cycles=CYCLES, continuous_actions=True)
    does = "simple_spread_v3, one world x 3 agents: drag and contact forces; observations of all agents, rewards"
    return parallel(env, 3, does)


def tag(threads: int) -> Case:
    """The simple_tag environment: three chase one."""
    from mpe2 import simple_tag_v3

    env = simple_tag_v3.parallel_env(max_cycles=CYCLES, continuous_actions=True)
    does = "simple_tag_v3, one world x 4 agents, 2 obstacles: drag and contact forces; observations, rewards"
    return parallel(env, 4, does)


if __name__ == "__main__":
    run({"spread": spread, "tag": tag}, "mpe2", "pettingzoo", "numpy")
