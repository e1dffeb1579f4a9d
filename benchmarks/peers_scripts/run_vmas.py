"""VMAS: 1024 worlds at once in torch, on the CPU."""

from itertools import cycle

from turns import DRAWS, Case, run

WORLDS = 1024


def scenario(name: str, agents: int, does: str, **parameters: int) -> Case:
    """Step a scenario under random actions drawn before; nothing is ever reset."""
    import torch
    import vmas

    env = vmas.make_env(name, num_envs=WORLDS, device="cpu", continuous_actions=True, seed=0, **parameters)
    env.reset()
    draws = [[torch.rand(WORLDS, env.get_agent_action_size(a)) * 2 - 1 for a in env.agents] for _ in range(DRAWS)]
    actions = cycle(draws)
    return Case(lambda: env.step(next(actions)), WORLDS * agents, does)


def flocking(threads: int, agents: int) -> Case:
    """The flocking scenario: agents circle a moving target among five obstacles."""
    import torch

    torch.set_num_threads(threads)
    does = (
        f"flocking, {WORLDS} worlds x {agents} agents (and a scripted target), float32: drag and contact forces of "
        "all pairs in 5 substeps; observations with 12 lidar rays, rewards from all pairs"
    )
    return scenario("flocking", agents, does, n_agents=agents)


def tag(threads: int) -> Case:
    """The simple_tag scenario: three chase one."""
    import torch

    torch.set_num_threads(threads)
    does = (
        f"simple_tag, {WORLDS} worlds x 4 agents, 2 obstacles, float32: drag and contact forces in 10 substeps; "
        "observations of all agents, rewards"
    )
    return scenario("simple_tag", 4, does)


if __name__ == "__main__":
    run(
        {
            "flocking_4": lambda threads: flocking(threads, 4),
            "flocking_32": lambda threads: flocking(threads, 32),
            "tag": tag,
        },
        "vmas",
        "torch",
    )
