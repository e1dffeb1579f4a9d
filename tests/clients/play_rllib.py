# /// script
# dependencies = ["torch==2.13.0", "ray[rllib]==2.60.0"]
# [tool.flockenv]
# constraints = "configs/constraints-ray.txt"
# ///
"""RLlib: PPO by id, in this process, in a remote one and over our vector form; and over PettingZoo's parallel form."""

import pettingzoo
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env
from row import IDS, STEPS, row

PACKAGE = "flockenv:"
"""In front of an id it lets whichever process makes the environment import flockenv first."""


def config(env_id, **runners):
    """Return PPO's settings, made small."""
    settings = PPOConfig().environment(env_id).env_runners(rollout_fragment_length="auto", **runners)
    return settings.training(train_batch_size_per_learner=1000, minibatch_size=250, num_epochs=1)


def train(settings):
    """Train until STEPS are sampled; return how many were."""
    algorithm, steps = settings.build_algo(), 0
    while steps < STEPS:
        steps = int(algorithm.train()["env_runners"]["num_env_steps_sampled_lifetime"])
    algorithm.stop()
    return steps


def parallel(env_id):
    """Make PettingZoo's form; in a remote runner the ids are there only after this import."""
    import flockenv  # noqa: F401

    return pettingzoo.make("parallel", env_id)


ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
for env_id in IDS:
    with row("ray", "RLlib PPO, id", PACKAGE + env_id) as played:
        played["steps"] = train(config(PACKAGE + env_id, num_env_runners=0))
    with row("ray", "RLlib PPO, a remote runner", PACKAGE + env_id) as played:
        played["steps"] = train(config(PACKAGE + env_id, num_env_runners=1))
    with row("ray", "RLlib PPO, vector_entry_point", PACKAGE + env_id) as played:
        form = {"num_envs_per_env_runner": 4, "gym_env_vectorize_mode": "vector_entry_point"}
        played["steps"] = train(config(PACKAGE + env_id, num_env_runners=0, **form))
    with row("ray", "RLlib PPO, ParallelPettingZooEnv", env_id) as played:
        register_env("many", lambda _, env_id=env_id: ParallelPettingZooEnv(parallel(env_id)))
        kinds = {agent: agent.rsplit("_", 1)[0] for agent in parallel(env_id).possible_agents}
        many = config("many", num_env_runners=0).multi_agent(
            policies=set(kinds.values()), policy_mapping_fn=lambda agent, episode, kinds=kinds, **_: kinds[agent]
        )
        played["steps"] = train(many)
ray.shutdown()
