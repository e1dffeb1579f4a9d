"""The state of a training, as arrays: all that the next rollout and update depend on; captured and restored.

It is captured at the start of a rollout, when the buffer is empty and earlier actions, rewards and gradients are no
longer needed. Randomness of the worlds is a function of (seed, world, step, agent), so their counters determine it.
"""

from __future__ import annotations

import json
import os
import platform
import random
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

import flockenv
from agents.checkpoint import JSON, CheckpointParts, Damaged, Tensors, json_part
from flockenv.envs.world import World
from flockenv.studies.accuracy.benchmark import machine
from flockenv.tasks import Task
from flockenv.tasks.play import name_of

if TYPE_CHECKING:
    from stable_baselines3 import PPO

__all__ = ["capture", "restore", "surroundings"]

PACKAGES = ("numpy", "numba", "gymnasium", "torch")
MOMENTS = ("exp_avg", "exp_avg_sq", "step")
"""The state of Adam for each parameter that has had a gradient."""

POSITIONS = ("state.x", "state.v")
"""The arrays of worlds that must be finite: lifetimes may be infinite, and measures without a value NaN."""


def capture(model: PPO) -> CheckpointParts:
    """Return a copy of the state of training, by part; to be called at the start of a rollout."""
    assert isinstance(model._last_obs, np.ndarray) and model._last_episode_starts is not None
    return {
        "policy": {name: _copy_of(tensor) for name, tensor in model.policy.state_dict().items()},
        "optimizer": {
            f"{index}.{name}": _copy_of(moments[name])
            for index, moments in model.policy.optimizer.state_dict()["state"].items()
            for name in MOMENTS
        },
        "worlds": {name: array.copy() for name, array in _arrays(model).items()},
        "rollout": {
            "observation": model._last_obs.copy(),
            "starts": model._last_episode_starts.astype(np.bool_),
            **{f"memory.{k}": array.copy() for k, array in enumerate(_memory(model))},
        },
        "random": {"torch": torch.get_rng_state().numpy().copy(), **json_part(_generators(model))},
    }


def restore(model: PPO, parts: CheckpointParts, steps: int, folder: Path) -> None:
    """Restore the captured state of a training into a model built by the same recipe.

    Raises:
        Damaged: a part does not fit this model; the message has the part and the reason.
    """
    assert model.env is not None
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones(model.n_envs, np.bool_)
    fresh = capture(model)
    fresh["optimizer"] = _optimizer_like(model, parts.get("optimizer", {}))
    for part, wanted in fresh.items():
        finite = tuple(name for name in wanted if part != "worlds" or name.endswith(POSITIONS))
        if fault := _fault(parts.get(part, {}), wanted, finite):
            raise Damaged(folder, f"{part}: {fault}")
    try:
        _write_into(model, parts)
    except (ValueError, TypeError, KeyError, RuntimeError, RecursionError) as error:
        raise Damaged(folder, f"random: {' '.join(str(error).split())}") from None
    model.num_timesteps = steps


def _worlds(model: PPO) -> list[World]:
    """Return the worlds of a training: one, or one for each drawn setting."""
    env: Any = model.env
    return list(env.worlds) if hasattr(env, "worlds") else [env.get_attr("world", 0)[0]]


def _memory(model: PPO) -> list[NDArray[Any]]:
    """Return what the rules of a hybrid remember."""
    env: Any = model.env
    return list(env.memory()) if hasattr(env, "resume") else []


def _arrays(model: PPO) -> Tensors:
    """Return the arrays of all worlds by name; those of second and later ones with a number before."""
    return {
        f"{k}.{name}" if k else name: array
        for k, world in enumerate(_worlds(model)) for name, array in world.arrays().items()
    }  # fmt: skip


def _copy_of(tensor: torch.Tensor) -> NDArray[Any]:
    return tensor.detach().cpu().numpy().copy()


def _optimizer_like(model: PPO, kept: Tensors) -> Tensors:
    """Return moments in the form that a checkpoint must have: all of them for each parameter that it names."""
    fresh: Tensors = {}
    for index, parameter in enumerate(model.policy.parameters()):
        if any(name.startswith(f"{index}.") for name in kept):
            like = parameter.detach().numpy()
            fresh |= {f"{index}.exp_avg": like, f"{index}.exp_avg_sq": like, f"{index}.step": np.zeros((), np.float32)}
    return fresh


def _fault(kept: Tensors, wanted: Tensors, finite: Sequence[str]) -> str:
    """Return the first difference of names, types, shapes or finiteness between tensors and `wanted`; '' if none."""
    if odd := sorted(kept.keys() ^ wanted.keys()):
        return f"{odd[0]} is {'missing' if odd[0] in wanted else 'unknown'}"
    for name, like in wanted.items():
        array = kept[name]
        if array.dtype != like.dtype or (array.shape != like.shape and name != JSON):
            return f"{name} is {array.dtype} of shape {array.shape}, must be {like.dtype} of shape {like.shape}"
        if name in finite and not np.isfinite(array).all():
            return f"{name} holds {array[~np.isfinite(array)].flat[0]}"
    return ""


def _write_into(model: PPO, parts: CheckpointParts) -> None:
    """Write the parts of a checkpoint into a model; the random generators last, since building draws numbers."""
    policy, optimizer, moments = model.policy, model.policy.optimizer, parts["optimizer"]
    policy.load_state_dict({name: torch.from_numpy(array) for name, array in parts["policy"].items()})
    indices = sorted({int(name.split(".")[0]) for name in moments})
    state = {k: {name: torch.from_numpy(moments[f"{k}.{name}"].copy()) for name in MOMENTS} for k in indices}
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    for k, world in enumerate(_worlds(model)):
        world.restore({name: parts["worlds"][f"{k}.{name}" if k else name] for name in world.arrays()})
    rollout = parts["rollout"]
    model._last_obs, model._last_episode_starts = rollout["observation"], rollout["starts"]
    env: Any = model.env
    if hasattr(env, "resume"):
        memory = [rollout[f"memory.{k}"] for k in range(len(_memory(model)))]
        env.resume(rollout["observation"], rollout["starts"], memory)
    _seed_generators(model, json.loads(parts["random"][JSON].tobytes()))
    torch.set_rng_state(torch.from_numpy(parts["random"]["torch"]))


def _generators(model: PPO) -> dict[str, Any]:
    """Return the states of the generators that SB3 seeds besides torch's: Python's, numpy's, and the action space's."""
    numpy = dict(np.random.get_state(legacy=False))  # noqa: NPY002  # SB3 draws minibatches from it
    numpy["state"] = {**numpy["state"], "key": numpy["state"]["key"].tolist()}
    return {"python": random.getstate(), "numpy": numpy, "actions": model.action_space.np_random.bit_generator.state}


def _seed_generators(model: PPO, states: Mapping[str, Any]) -> None:
    kind, numbers, rest = states["python"]
    numpy = {**states["numpy"], "state": {**states["numpy"]["state"]}}
    numpy["state"]["key"] = np.array(numpy["state"]["key"], np.uint32)
    random.setstate((kind, tuple(numbers), rest))
    np.random.set_state(numpy)  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = states["actions"]


# --- versions and machine: what results depend on besides the recipe --------------------------------------------------


def surroundings(task: Task, library: str = "stable-baselines3") -> dict[str, str]:
    """Return the surroundings of training, by name: versions, the machine, and the source of the task's kernel."""
    processor = f"{machine().cpu}, {os.cpu_count()} cores, torch uses {torch.backends.cpu.get_cpu_capability()}"
    return {
        "flockenv": flockenv.__version__,
        **{name: version(name) for name in (*PACKAGES, library)},
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor,
        "kernel": name_of(task),
    }
