"""JaxMARL: the multi-agent particle environments, 1024 worlds at once, compiled by XLA for the CPU."""

from typing import Any

from turns import Case, run

WORLDS = 1024


def environment(name: str, agents: int, does: str, steps: int = 25, **parameters: int) -> Case:
    """Run `steps` steps of all worlds inside one jitted scan, as JaxMARL's own training loops do.

    Every step of it computes observations and rewards; their sums are returned, or XLA would leave them out. It need
    not write them to memory, though, as ours does: a favour to it. An episode that ends is replaced by a new one,
    inside the step.
    """
    import jax
    import jaxmarl

    env = jaxmarl.make(name, **parameters)
    keys = jax.random.split(jax.random.PRNGKey(0), WORLDS)
    _, first = jax.vmap(env.reset)(keys)
    draws = jax.random.split(jax.random.PRNGKey(2), len(env.agents))
    shape = (steps, WORLDS)  # discrete actions: stay, or push one of four ways; drawn before
    actions = {a: jax.random.randint(key, shape, 0, 5) for a, key in zip(env.agents, draws, strict=True)}

    def one(carry: Any, action: Any) -> Any:
        key, state = carry
        key, draw = jax.random.split(key)
        seen, state, paid, _, _ = jax.vmap(env.step)(jax.random.split(draw, WORLDS), state, action)
        return (key, state), sum(x.sum() for x in jax.tree.leaves((seen, paid)))

    @jax.jit
    def many(carry: Any) -> Any:
        return jax.lax.scan(one, carry, actions, steps)

    held = [(jax.random.PRNGKey(1), first)]

    def step() -> None:
        held[0], sums = many(held[0])
        sums.block_until_ready()

    return Case(step, WORLDS * agents * steps, does)


def spread(threads: int, agents: int) -> Case:
    """Agents share as many landmarks."""
    does = (
        f"MPE_simple_spread_v3, {WORLDS} worlds x {agents} agents, float32: drag and contact forces of all pairs; "
        "observations of all agents, rewards"
    )
    return environment("MPE_simple_spread_v3", agents, does, 100 // agents, num_agents=agents, num_landmarks=agents)


def tag(threads: int) -> Case:
    """Three chase one."""
    does = (
        f"MPE_simple_tag_v3, {WORLDS} worlds x 4 agents, 2 obstacles, float32: drag and contact forces; "
        "observations of all agents, rewards"
    )
    return environment("MPE_simple_tag_v3", 4, does)


if __name__ == "__main__":
    run(
        {
            "spread_3": lambda threads: spread(threads, 3),
            "spread_32": lambda threads: spread(threads, 32),
            "tag": tag,
        },
        "jaxmarl",
        "jax",
        "jaxlib",
    )
