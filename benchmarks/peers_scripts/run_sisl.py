"""PettingZoo SISL: pursuit_v5 (1.27 refuses v4), a grid world in Python, as a PettingZoo parallel environment."""

from itertools import cycle

from turns import DRAWS, Case, run

PURSUERS, EVADERS = 8, 30


def pursuit(threads: int) -> Case:
    """Eight pursuers look for thirty evaders that walk at random; resets are timed as well."""
    from pettingzoo.sisl import pursuit_v5

    env = pursuit_v5.parallel_env(n_pursuers=PURSUERS, n_evaders=EVADERS, max_cycles=300)
    env.reset(seed=0)
    spaces = {name: env.action_space(name) for name in env.possible_agents}
    actions = cycle([{name: space.sample() for name, space in spaces.items()} for _ in range(DRAWS)])

    def step() -> None:
        env.step(next(actions))
        if not env.agents:
            env.reset()

    does = (
        f"pursuit_v5, one world x {PURSUERS} pursuers and {EVADERS} evaders (all counted), moves on a 16 x 16 grid, "
        "no forces; observations 7 x 7 x 3 of the pursuers, rewards"
    )
    return Case(step, PURSUERS + EVADERS, does)


if __name__ == "__main__":
    run({"pursuit": pursuit}, "pettingzoo", "numpy")
