"""Model cards: a Markdown page beside the weights of each task, in the form of model hubs, made of the JSON card.

To write all of them anew: python -m flockenv.players.model_card
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from flockenv.core.atomic_files import replace_file
from flockenv.envs.table import ENVIRONMENTS
from flockenv.players import weights_file
from flockenv.players.policy import read_card
from flockenv.tasks import TASKS

__all__ = ["model_card"]


ABOUT_SCORES = """\
The mean return is that of the last evaluation during training, in worlds for tuning. The comparison with hand-written
players in held-out worlds is in docs/results.md of the repository."""

LIMITS = """\
The policy was trained in one simulated task, with these arguments, and with physics of this package alone. With other
arguments it may fail; docs/study.md of the repository has measurements. It controls no robot and predicts no crowd."""


def model_card(card: Mapping[str, Any]) -> str:
    """Return the page of a policy whose JSON card this is; all numbers are the card's.

    Raises:
        KeyError: the card is not of a task of flockenv.
    """
    kind = TASKS[card["task"]]
    about, env = " ".join((kind.__doc__ or "").split("\n\n")[0].split()), ENVIRONMENTS[kind.__name__].id
    parts = [
        f"---\n{yaml.safe_dump(_front_matter(card, env), sort_keys=False)}---",
        f"# PPO for {env}", about, _usage(card["task"], env), "## Training", _grid(_training(card)),
        ABOUT_SCORES,
        "## Observation", f"{card['observation_size']} numbers, in this order.", _slots(card.get("observation", ())),
        "## Action", _slots(card.get("action", ())), "## Arguments of the task",
        _grid([(f"`{name}`", f"`{_plain(value)}`") for name, value in card["arguments"].items()]), "## Limits",
        LIMITS,
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _front_matter(card: Mapping[str, Any], env: str) -> dict[str, Any]:
    """Return the metadata at the top of the page, which hubs read."""
    name = "mean return in worlds for tuning"
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement learning"},
        "dataset": {"type": env, "name": env},
        "metrics": [{"type": "mean_reward", "name": name, "value": round(card["tuning_mean"], 2), "verified": False}],
    }
    return {
        "license": "mit",
        "library_name": "flockenv",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "ppo", "gymnasium", "steering", env],
        "model-index": [{"name": f"ppo-{env.removeprefix('flockenv/')}", "results": [result]}],
    }


def _usage(task: str, env: str) -> str:
    return (
        "```python\n"
        "import flockenv\n"
        "from flockenv.players import load_player, trained_task\n\n"
        f'policy = load_player("ppo", trained_task("{task}"))\n'
        "action, state = policy.predict(observation)  # (rows, observation size) -> (rows, action size)\n"
        "```\n\n"
        f'`gymnasium.make("{env}")` makes an environment of the task. The weights are in the package: '
        f"`flockenv render {task} --player ppo --out {task}.gif` draws an episode."
    )


def _training(card: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what was trained how, as rows of a table."""
    versions = ", ".join(f"{name} {version}" for name, version in card.get("versions", {}).items() if name != "kernel")
    seeds = card.get("seeds", {})
    scores = "one seed"
    if seeds:
        ends = f"{seeds['lowest']:.3g} to {seeds['highest']:.3g}"
        scores = f"the median of {len(seeds['scores'])} training seeds, {ends}"
    return [
        ("algorithm", str(card.get("algorithm", ""))),
        ("command", f"`{card.get('recipe', {}).get('command', '')}`"),
        ("seed", str(card["seed"])),
        ("agent-steps", f"{card['steps']:,}"),
        ("wall time", f"{card['wall_time_s']:.0f} s on {card.get('machine', 'an unknown machine')}"),
        ("mean return", f"{card['tuning_mean']:.3g} ({scores})"),
        ("versions", versions),
        ("SHA-256 of the weights", f"`{card['sha256']}`"),
    ]


def _grid(rows: Sequence[tuple[str, str]]) -> str:
    return "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)])


def _plain(value: Any) -> str:
    """Return an argument as text; a record by its kind."""
    return str(value["kind"]) if isinstance(value, dict) else str(value)


def _slots(slots: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of slots: the meaning of the numbers of an observation or action."""
    rows = [
        f"| `{slot['name']}` | {' x '.join(map(str, slot['shape'])) or 'one number'} "
        f"| {slot['scale']:g} {slot['unit'] if slot['unit'] != '1' else ''} | {slot['low']:g} to 1 |"
        for slot in slots
        if 0 not in slot["shape"]
    ]
    return "\n".join(["| name | shape | 1 stands for | range |", "| --- | --- | --- | --- |", *rows])


def _write_all() -> None:
    """Write the page of each task that has weights."""
    for task in TASKS:
        path = weights_file(task).with_suffix(".json")
        if path.is_file():
            with replace_file(path.with_suffix(".md")) as file:
                file.write(model_card(read_card(path)).encode())


if __name__ == "__main__":
    _write_all()
