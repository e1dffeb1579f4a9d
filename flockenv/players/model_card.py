"""Model cards: Markdown beside weights, in the form of model hubs, made of the JSON cards.

The weights of each task that ship have a page each; a folder of several, such as other training seeds, has a table.
To write all of them anew: python -m flockenv.players.model_card agents/policies/* agents/priced
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from flockenv.core.atomic_files import replace_file
from flockenv.envs.table import ENVIRONMENTS
from flockenv.players import WEIGHTS, weights_file
from flockenv.players.policy import read_card
from flockenv.tasks import TASKS

__all__ = ["cards_in", "folder_card", "model_card"]


ABOUT_SCORES = """\
The mean return is that of the last evaluation during training, in worlds for tuning. The comparison with hand-written
players in held-out worlds is in docs/results.md of the repository."""

ABOUT_FOLDER = """\
The JSON beside each file of weights has its observation, action, arguments, learning curve, versions and digest. The
mean return is that of the last evaluation during training, in worlds for tuning. `python -m` goes before a command."""

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
        f"# {_short(card)} for {env}", about, _usage(card["task"], env), "## Training", _grid(_training(card)),
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
        "tags": ["reinforcement-learning", *_tags(card), "gymnasium", "steering", env],
        "model-index": [{"name": f"{_tags(card)[0]}-{env.removeprefix('flockenv/')}", "results": [result]}],
    }


def _short(card: Mapping[str, Any]) -> str:
    """Return the algorithm without its library, and the kind and base of a hybrid policy."""
    algorithm, hybrid = str(card["algorithm"]).split(" (")[0], card.get("hybrid")
    return f"{algorithm}, {hybrid['kind']} on {hybrid['base']}" if hybrid else algorithm


def _tags(card: Mapping[str, Any]) -> list[str]:
    """Return the algorithm, and the kind of a hybrid policy, as hubs name them."""
    names = [str(card["algorithm"]).split(" (")[0], *([card["hybrid"]["kind"]] if card.get("hybrid") else [])]
    return [name.lower().replace(" ", "-") for name in names]


def folder_card(cards: Mapping[str, Mapping[str, Any]], title: str) -> str:
    """Return the page of a folder of weights: a table of its files, whose JSON cards these are."""
    kinds = sorted({tag for card in cards.values() for tag in _tags(card)})
    tags = ["reinforcement-learning", *kinds, "gymnasium", "steering"]
    front = {"license": "mit", "library_name": "flockenv", "pipeline_tag": "reinforcement-learning", "tags": tags}
    rows = [
        f"| {name} | {card['task']} | {_short(card)} | {card['seed']} | {card['tuning_mean']:.3g} "
        f"| `{card['recipe']['command'].removeprefix('python -m ')}` |"
        for name, card in cards.items()
    ]
    table = "\n".join(["| file | task | algorithm | seed | mean return | command |", "|" + " --- |" * 6, *rows])
    parts = [
        f"---\n{yaml.safe_dump(front, sort_keys=False)}---",
        f"# {title}",
        ABOUT_FOLDER,
        table,
        "## Limits",
        LIMITS,
    ]
    return "\n\n".join(parts) + "\n"


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


def cards_in(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the cards of all weights in a folder by their file, in order of task and seed."""
    cards = {path.name: read_card(path.with_suffix(".json")) for path in folder.glob("*.safetensors")}
    return dict(sorted(cards.items(), key=lambda item: (item[1]["task"], item[1]["seed"])))


def _write_all(folders: Sequence[Path]) -> None:
    """Write the page of each task that has weights, of its other seeds, and of some folders."""
    for task in TASKS:
        path = weights_file(task).with_suffix(".json")
        if path.is_file():
            with replace_file(path.with_suffix(".md")) as file:
                file.write(model_card(read_card(path)).encode())
    for folder in (WEIGHTS / "seeds", *folders):
        with replace_file(folder / "README.md") as file:
            file.write(folder_card(cards_in(folder), folder.name).encode())


if __name__ == "__main__":
    _write_all([Path(name) for name in sys.argv[1:]])
