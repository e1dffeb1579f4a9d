"""Players away from home: `python -m agents.sweep configs/studies/robustness.yaml` varies what a study names.

All players play the same held-out worlds under each setting. Writes into a folder a file per task with every world's
return (TASK.json), a map per task (TASK.png) and summary.png, and beside the folder a page. With --tasks, the page also
shows the other tasks' files of the same study.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from agents.compare import JOBS, folder_of, pick, split, write_text
from agents.invasion import worlds_among
from agents.study import INTEGRATOR, Contender, Setting, Study, contenders_of, settings_of
from agents.study_results import RANDOM, TaskResults, kind_of, read_file, read_task, stored_marks
from flockenv.cli.compare import changes_of
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.output_paths import valid_file
from flockenv.evaluation.report import json_text, rounded
from flockenv.jobs import Job, Store, Work, engine_of, run_jobs
from flockenv.players.policy import OtherSlotsError
from flockenv.scene.yaml_io import load
from flockenv.studies.play_jobs import Player, episodes_of_bytes, play_job

__all__ = ["app", "plan_digest", "sweep"]

SUMMARY = "summary.png"
DIGITS = 4
"""Significant digits of a stored return, two of them decimals at most: far more than its interval resolves."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

Content = dict[str, Any]


@dataclass
class _Entry:
    """One player in one setting: the jobs that make its results, or its results."""

    setting: Setting
    contender: Contender
    kind: str
    evaluation: Sequence[Job] = ()
    tuning: Sequence[Job] = ()
    content: Content = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Return a digest of all that the returns depend on, besides code, versions and processor."""
        text = json.dumps([job.about for job in self.evaluation], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def sweep(
    study: Study,
    tasks: Sequence[str],
    work: Work,
    changes: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
    choose: bool = True,
    stored: Mapping[str, Content] = MappingProxyType({}),
    digits: int = DIGITS,
) -> dict[str, Content]:
    """Play all settings of tasks with all players; return the content of each task's file.

    changes: arguments of tasks that hold in every setting. choose: play tuning worlds as well where a kind has several
    players, to choose the one that stands for it. stored: results by task that are kept, not played, where settings,
    worlds and players are the same. digits: significant ones of a return; at most two fewer are decimals.

    Raises:
        ValueError: in one line, a bad setting or player, before anything is played.
    """
    entries = {
        task: [
            entry
            for setting in settings_of(study, task, changes.get(task))
            for entry in _entries(study, setting, contenders_of(study, task), choose)
        ]
        for task in tasks
    }
    for task in stored.keys() & entries.keys():
        _keep(entries[task], stored[task])
    waiting = [entry for of_task in entries.values() for entry in of_task if not entry.content]
    jobs = {job.key: job for entry in waiting for job in (*entry.evaluation, *entry.tuning)}  # a grid may have home
    run_jobs(list(jobs.values()), work)
    return {
        task: {"plan": plan_digest(study, changes, task), **_content(study, of_task, work.store, digits)}
        for task, of_task in entries.items()
    }


def plan_digest(
    study: Study, changes: Mapping[str, Mapping[str, Any]] = MappingProxyType({}), task: str | None = None
) -> str:
    """Return a digest of a study and of the changes by --set, or of what concerns one task of it.

    Only results of one plan are on one page; other settings of another task do not matter to those of this one.
    """
    plan, fixed = study.model_dump(mode="json"), {name: dict(each) for name, each in changes.items()}
    del plan["left_out"]  # a text alone
    if study.seeds is None:
        del plan["seeds"]  # plans from before there was this key
    if task is not None:
        plan["tasks"] = {task: plan["tasks"][task]}
        fixed = {name: each for name, each in fixed.items() if name == task}
    return hashlib.sha256(json.dumps([plan, fixed]).encode()).hexdigest()[:16]


def _content(study: Study, entries: Sequence[_Entry], store: Store, digits: int) -> Content:
    """Return the content of a task's file, once all jobs are done."""
    settings: dict[str, Content] = {}
    for entry in entries:
        about = {"axis": entry.setting.axis, "value": entry.setting.value, "players": {}}
        setting = settings.setdefault(entry.setting.name, about)
        setting["players"][entry.contender.name] = entry.content or _played(entry, store, digits)
    task = entries[0].setting.task
    arguments = task.model_dump(mode="json")
    arguments[INTEGRATOR] = arguments[INTEGRATOR]["kind"]
    home = {entry.setting.axis: arguments[entry.setting.axis] for entry in entries if entry.setting.axis in arguments}
    head = {"task": task.name, "worlds": study.worlds, "seed": study.seed, "home": home}
    return {**head, "settings": list(settings.values())}


def _entries(study: Study, setting: Setting, contenders: Sequence[Contender], choose: bool = True) -> list[_Entry]:
    """Return the entries of a setting; a player that cannot play it has the reason as its content."""
    found = []
    _check_partners(setting, study.seed)
    for contender in contenders:
        try:
            policies = [member.policy(setting.task, study.seed) for member in contender.members]
        except OtherSlotsError as error:
            reason = str(error).partition(": ")[2]  # without the path of the file, which is this machine's
            found.append(_Entry(setting, contender, "", content={"refused": reason}))
            continue
        if setting.partners is not None and hasattr(policies[0], "watch"):
            found.append(_Entry(setting, contender, "", content={"refused": "acts for all agents of a world at once"}))
            continue
        jobs = [_job(study, setting, member, "evaluation") for member in contender.members]
        found.append(_Entry(setting, contender, kind_of(policies[0]), jobs))
    kinds = [entry.kind for entry in found]
    for entry in found:
        if choose and entry.kind not in ("", RANDOM) and kinds.count(entry.kind) > 1:
            entry.tuning = [_job(study, setting, member, "tuning") for member in entry.contender.members]
    return found


def _keep(entries: Sequence[_Entry], stored: Content) -> None:
    """Set the contents of entries that are stored already: by the same digest, with tuning worlds if they need them."""
    players = {
        (setting["axis"], setting["value"], name): player
        for setting in stored["settings"] for name, player in setting["players"].items() if "returns" in player
    }  # fmt: skip
    for entry in entries:
        found = players.get((entry.setting.axis, entry.setting.value, entry.contender.name))
        if not entry.content and found and found["digest"] == entry.digest:
            entry.content = found if not entry.tuning or found["tuning_mean"] is not None else {}


def _check_partners(setting: Setting, seed: int) -> None:
    """Raise ValueError, in one line, if the player of the other agents cannot play the setting."""
    if setting.partners is None or (player := setting.partners.player) is None:
        return
    try:
        policy = player.policy(setting.task, seed)
    except ValueError as error:
        raise ValueError(f"{setting.task.name}, {setting.name}: {error}") from None
    if hasattr(policy, "watch"):
        raise ValueError(f"{setting.task.name}, {setting.name}: {player.name} acts for all agents of a world at once")


def _job(study: Study, setting: Setting, player: Player, purpose: Any) -> Job:
    kind = "sweep" if purpose == "evaluation" else "sweep-tuning"
    within = None
    if (partners := setting.partners) is not None:
        others = partners.player or player
        within = worlds_among(setting.task, others, study.seed, False, partners.egos, setting.disturbance)
    return play_job(
        kind, setting.task, player, study.worlds, study.seed, disturbance=setting.disturbance, purpose=purpose,
        within=within,
    )  # fmt: skip


def stored_return(value: float, digits: int = DIGITS) -> float:
    """Return a return as it is stored: in significant digits, and then in at most two fewer decimals.

    It is rounded twice, as those of files from before that had more decimals are.
    """
    return rounded(round(rounded(value, digits), digits - 2), digits)


def _played(entry: _Entry, store: Store, digits: int = DIGITS) -> Content:
    """Return the results of an entry from the records of its jobs."""
    episodes = [store.read(job, episodes_of_bytes) for job in entry.evaluation]
    tuning = [store.read(job, episodes_of_bytes) for job in entry.tuning]
    return {
        "kind": entry.kind,
        "digest": entry.digest,
        "microseconds": rounded(float(np.median([each.microseconds for each in episodes]))),
        "tuning_mean": rounded(float(np.mean([each.returns.mean() for each in tuning]))) if tuning else None,
        "success": [stored_marks(each.success) for each in episodes],
        "returns": [[stored_return(value, digits) for value in each.returns] for each in episodes],
    }


# --- the command line -------------------------------------------------------------------------------------------------


@app.command()
def main(
    study: Annotated[Path, typer.Argument(metavar="STUDY.yaml", help="Such as configs/studies/robustness.yaml.")],
    tasks: Annotated[list[str] | None, typer.Option(help="Tasks of the study, by comma or repeated. [all]")] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="TASK.ARGUMENT=VALUE, in every setting of that task; repeatable.")
    ] = None,
    out: Annotated[
        str, typer.Option(help="Folder for TASK.json, TASK.png, summary.png; the page is OUT.md.")
    ] = "results/study",
    check: Annotated[
        int, typer.Option(min=0, help="Play this many results of --out again, drawn at random, and compare them.")
    ] = 0,
    engine: EngineName = "local",
    processes: Processes = None,
    reuse: Annotated[
        bool, typer.Option("--reuse", help="Keep results of --out whose settings, worlds and players are the same.")
    ] = False,
    fresh: Fresh = False,
    shard: ShardText = None,
    debug: Debug = False,
) -> None:
    """Play all settings of a study with all players, and draw which kind is ahead where."""
    with report_errors("sweep", STOPPED, debug), end_of_shard():
        plan = load(study, Study)
        names = pick("--tasks", split(tasks) or list(plan.tasks), plan.tasks)
        fixed = changes_of(changes or [], plan.tasks)
        folder = folder_of(out, (SUMMARY, *(f"{name}.{end}" for name in names for end in ("json", "png"))))
        page = valid_file(f"{folder}.md", (".md",), force=True)
        before = {name: read_file(folder / f"{name}.json") for name in plan.tasks}
        runner, part = engine_of(engine, processes), shard_of(shard)
        if check and part is not None:
            raise ValueError("--check: not together with --shard")
        if reuse and (check or fresh):
            raise ValueError("--reuse: not together with --check or --fresh, which play anew")
        with job_bar() as progress:
            work = Work(Store(folder / JOBS), runner, fresh or check > 0, progress, part)
            if check:
                chosen = {name: before[name] for name in names}
                raise typer.Exit(0 if _check(plan, chosen, fixed, check, work) else 1)
            kept = {name: each for name, each in before.items() if each is not None}
            contents = sweep(plan, names, work, fixed, stored=kept if reuse else {})
        _write(folder, contents)
        others = {name: each for name, each in kept.items() if each["plan"] == plan_digest(plan, fixed, name)}
        found = {name: read_task(content) for name, content in {**others, **contents}.items()}
        _publish(page, plan, _command(study, out, changes or []), found)
    for name in names:
        typer.echo(f"{folder / name}.json, .png: written")
    typer.echo(f"{page}: written")


def _write(folder: Path, contents: Mapping[str, Content]) -> None:
    """Write the files of the tasks, all or none."""
    texts = {name: json_text(content) for name, content in contents.items()}
    write_all_or_none(folder, {
        f"{name}.json": functools.partial(write_text, text=text) for name, text in texts.items()
    })  # fmt: skip


def _command(study: Path, out: str, changes: Sequence[str]) -> str:
    """Return the command that makes the page."""
    options = [f"--out {out}", *(f"--set {text}" for text in changes)]
    return f"python -m agents.sweep {study.as_posix()} {' '.join(options)}"


def _publish(page: Path, study: Study, command: str, found: Mapping[str, TaskResults]) -> None:
    """Write the page, and the pictures of all tasks that have results in the folder of the same name."""
    from agents.study_chart import draw_map, draw_summary
    from agents.study_report import markdown

    folder = page.with_suffix("").name
    writers: dict[str, Callable[[Path], None]] = {
        f"{folder}/{name}.png": functools.partial(draw_map, results=results) for name, results in found.items()
    }
    writers[f"{folder}/{SUMMARY}"] = functools.partial(draw_summary, results=list(found.values()), title=study.title)
    text = markdown(study, command, list(found.values()), folder)
    writers[page.name] = lambda target: write_text(target, text)
    write_all_or_none(page.parent, writers)


def _check(
    study: Study, before: Mapping[str, Content | None], changes: Mapping[str, Any], count: int, work: Work
) -> bool:
    """Play stored results again, drawn at random; print each, and return True if all returns are the same."""
    stored = [
        (task, setting, name, player)
        for task, content in before.items() if content is not None
        for setting in content["settings"] for name, player in setting["players"].items() if "returns" in player
    ]  # fmt: skip
    if not stored:
        raise ValueError("--check: there are no results in --out")
    console, same = Console(highlight=False, soft_wrap=True), True
    for number in np.random.default_rng().permutation(len(stored))[:count]:
        task, setting, name, player = stored[number]
        again = _play_again(study, task, changes.get(task), setting, name, work)
        place = f"{task}, {setting['axis']} {setting['value']}, {name}".replace(" ,", ",")
        if again is None or again["digest"] != player["digest"]:
            console.print(f"{place}: cannot be made again: its settings or its player are others now")
            same = False
            continue
        old, new = np.array(player["returns"]), np.array(again["returns"])
        same &= bool((old == new).all())
        means = f"mean return {new.mean():.4f}, stored {old.mean():.4f}"
        console.print(f"{place}: {means}; {(old == new).sum()} of {old.size} worlds equal")
    return same


def _play_again(
    study: Study, task: str, changes: Mapping[str, Any] | None, setting: Content, name: str, work: Work
) -> Content | None:
    """Return the results of one player in one setting, made anew; None if the study does not have it."""
    for each in settings_of(study, task, changes):
        if (each.axis, each.value) == (setting["axis"], setting["value"]):
            chosen = [contender for contender in contenders_of(study, task) if contender.name == name]
            for entry in _entries(study, each, chosen):
                if entry.content:
                    return None
                run_jobs(entry.evaluation, work)
                return _played(entry, work.store)
    return None


if __name__ == "__main__":
    run_program("sweep", app, STOPPED)
