"""Pages of the environments: the page that `help` of an environment shows, a film, rewards, ends, and results."""

from __future__ import annotations

import inspect
import json
import re
import sys
from pathlib import Path
from typing import Any

from docstrings import markdown, table
from films import hybrid_of

from flockenv.envs.docstring import page as page_of_environment
from flockenv.envs.table import ENVIRONMENTS, EnvInfo
from flockenv.tasks import TASKS, Task

__all__ = ["pages"]


def pages(docs: Path, films_are_drawn: bool) -> dict[str, str]:
    """Return a page for each environment, and their overview; warn of a film that is missing but should be there."""
    results = json.loads((docs / "results.json").read_text(encoding="utf-8"))
    infos = {info.task_type().name: info for info in ENVIRONMENTS.values()}
    made = {f"environments/{name}": _page(docs, name, infos[name], results) for name in TASKS}
    for name in TASKS:
        if films_are_drawn and not _path_of_film(docs, name).exists():
            from sphinx.util import logging  # here: tests read the pages without sphinx

            logging.getLogger(__name__).warning("%s: its film is missing", name)  # with -W it fails the build
    return {**made, "environments/index": _overview(infos)}


def _overview(infos: dict[str, EnvInfo]) -> str:
    rows = [
        (f"[{info.name}]({name}.md)", f"`{info.id}`", "yes" if info.team else "no", info.summary)
        for name, info in infos.items()
    ]
    return (
        "# Environments\n\nEach task is a Gymnasium environment with one learner; those with a team are PettingZoo "
        "environments also. [Results](../../results.md) compares players in all of them.\n\n"
        f"{table(('task', 'id', 'PettingZoo', 'summary'), rows)}\n\n"
        "```{toctree}\n:hidden:\n" + "\n".join(infos) + "\n```\n"
    )


def _page(docs: Path, name: str, info: EnvInfo, results: dict[str, Any]) -> str:
    task = TASKS[name](**info.single)
    text = page_of_environment(info, task)
    first, *sections = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    by_title = {section.splitlines()[0].removeprefix("## "): section for section in sections}
    by_title["Description"] = "## Description\n\n" + markdown(type(task).__doc__) + "\n\n"
    by_title["Rewards"] += _reward_table(task) + "\n\n"
    by_title["Episode end"] = _end(task, by_title["Episode end"])
    if info.team:
        by_title["As a team"] = _team(info)
    by_title["Results"] = _results(docs, name, results)
    body = "\n\n".join(section.strip() for section in by_title.values())
    return f"# {info.name}\n\n{_film(docs, name)}{first}{body}\n"


def _film(docs: Path, name: str) -> str:
    """Return the film above a page; if it was not drawn, or has no hybrid of rules and policy, say so."""
    hybrid = "" if hybrid_of(name) else f"No hybrid of rules and policy was trained in {name}.\n\n"
    if not _path_of_film(docs, name).exists():
        return f"{hybrid}This site was built without films (`-D films=0`).\n\n"
    players = "rules and PPO" if hybrid else "rules, PPO and a hybrid of both"
    return f"![An episode of {name} in the same world, from left to right: {players}](../films/{name}.gif)\n\n{hybrid}"


def _path_of_film(docs: Path, name: str) -> Path:
    return docs / "generated" / "films" / f"{name}.gif"


def _kernel_text(task: Task, kernel: str) -> str:
    """Return the first paragraph of the docstring of a task's kernel."""
    text = inspect.getdoc(getattr(sys.modules[type(task).__module__], kernel)) or ""
    return markdown(" ".join(text.split("\n\n")[0].split()))


def _reward_table(task: Task) -> str:
    """Return the table of reward terms and their factors, and what the kernel says about all terms after a `;`."""
    fields = type(task).model_fields
    weights = [key for key in fields if key.endswith(("_reward", "_cost"))]
    rows = []
    for term in task.terms:
        own = [key for key in weights if _stem(key).startswith(_stem(term)[:5])]
        factors = "; ".join(f"`{key}` = {getattr(task, key):g}" for key in own)
        rows.append((f"`{term}`", factors, "; ".join(fields[key].description or "" for key in own)))
    text = (
        "The table has a row for each term: the argument that is its factor, with its default, and what the factor is "
        "paid for; a factor whose name ends in `_cost` is subtracted."
    )
    note = _kernel_text(task, "reward").partition("; ")[2]
    return f"{text}{f' Note: {note}' if note else ''}\n\n{table(('term', 'factor', 'paid'), rows)}"


def _stem(name: str) -> str:
    """Return what a term and its factor have in common: off_track and off_cost, dead and death_cost."""
    known = {"dead": "death", "together": "loneliness", "pressed": "press", "off_track": "off"}
    return re.sub(r"_(reward|cost)$", "", known.get(name, name))


def _end(task: Task, section: str) -> str:
    own = f"Termination: see the description. The kernel `ended` of the task: {_kernel_text(task, 'ended')}"
    return section.replace("Termination: see the description.", own, 1)


def _team(info: EnvInfo) -> str:
    """Return the section about the PettingZoo environment of a task."""
    task = info.task_type()(**info.parallel)
    _, *sections = re.split(r"^## ", page_of_environment(info, task), flags=re.MULTILINE)
    spaces = {section.splitlines()[0]: section.partition("\n")[2] for section in sections}
    options = ", ".join(f"`{key}` = {value!r}" for key, value in info.parallel.items())
    return (
        f'## As a team\n\n{info.team}\n\n```python\npettingzoo.make("parallel", "{info.id}")  # or "aec"\n```\n\n'
        f"Agents: {_few(task.agent_names)}. "
        + (f"Its defaults differ: {options}. " if options else "")
        + f"An observation of each agent:\n{spaces['Observation space'].rstrip()}\n\n"
    )


def _few(names: tuple[str, ...]) -> str:
    quoted = [f"`{name}`" for name in names]
    return ", ".join(quoted if len(quoted) <= 8 else [*quoted[:3], "...", quoted[-1]])


def _results(docs: Path, name: str, results: dict[str, Any]) -> str:
    """Return the section with the results of each player in docs/results.json."""
    rows = [
        (
            f"`{player}`",
            f"{about['mean']:.2f} [{about['mean_low']:.2f}, {about['mean_high']:.2f}]",
            f"{about['success_rate']:.0%}",
            str(len(about["runs"])),
            f"{about['lowest']:.2f}, {about['highest']:.2f}",
            f"{about['microseconds_single']:.0f}",
        )
        for player, about in results["tasks"][name]["players"].items()
    ]
    head = ("player", "mean return [95 % interval]", "success", "seeds", "lowest, highest seed", "µs per decision")
    text = (
        f"## Results\n\nMean over {results['worlds']} held-out worlds; [results](../../results.md) explains the "
        f"columns.\n\n{table(head, rows)}\n\n"
    )
    if (docs / "study" / f"{name}.png").exists():
        picture = f"![Players of {name} in other settings](../../study/{name}.png)"
        text += f"[In other settings](../../study.md):\n\n{picture}\n\n"
    return text + (
        f"A film of an episode: `flockenv render {name} --player rules,ppo --out {name}.gif`. "
        f"Play along: `flockenv play {name} --players rules,ppo,you`.\n"
    )
