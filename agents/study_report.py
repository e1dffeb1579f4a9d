"""The page of a study, study.md: in which settings which kind of player is ahead, and all numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from agents.study import HOME, PARTNERS, Study
from agents.study_results import ALONE, GROUPS, KINDS, LEVEL, SettingResults, TaskResults
from flockenv.evaluation import Interval
from flockenv.evaluation.report import grid

__all__ = ["markdown", "score_text", "winner_text"]

RULES = KINDS[0]

NOTES = """\
Every value changes one thing of the setting that players were made for (home). All players of a setting play the same
held-out worlds. **Ahead** means that the 95 % interval of the difference of mean returns to the best player of every
other kind is above zero; otherwise the setting is *level*, which does not mean that they are equal: with few seeds only
large differences show. Of settings without any difference, one in twenty has a kind ahead by chance. Two kinds may be
level and ahead of a third, which the last column of the tables names. If there are several players of a kind, the best
one on the tuning worlds of that setting stands for it. The number of training or search seeds of a player stands beside
its name, if there are several; intervals are then two-level bootstraps over seeds and worlds. Those of a single seed
are over worlds alone, and do not contain the luck of training or of the search; its success: 95 % Wilson. A dash: the
player cannot read the observations of that setting; *alone*: only one kind can. A value for all tasks is left out where
a task does not accept it or its time step is unstable."""

CHECKED = """\
`{command} --check 2` plays two
stored results, drawn at random, again, and compares the return of every world with the stored one (four digits, at most
two decimals). In {folder}/TASK.json, `digest` is that of a result's settings, worlds and players."""

AMONG = """\
**Partners**: one agent of each world, or the share named there, plays the player of the column, and all others the
named player (of several seeds, the one that ships), or the *same* as that one agent. Each learner is that agent equally
often. Return and success are those of that agent; in tasks whose success is one of all agents together (Flock,
Corridor) it is that of the world. CrowdNav has no such setting: its people are scripted, and `crowd` is their law."""


def markdown(study: Study, command: str, tasks: Sequence[TaskResults], folder: str) -> str:
    """Return the page as Markdown; command: that makes it; folder: that of the pictures, as links name it."""
    parts = [
        f"# {study.title}",
        f"{_sentence(tasks)} {_behind(tasks)}Made by `{command}`, {study.worlds} worlds per setting.",
        f"![Which kind of player is ahead in which setting]({folder}/summary.png)",
        NOTES,
        CHECKED.format(command=command, folder=folder),
        *([f"**Left out**: {study.left_out}"] if study.left_out else []),
        *([AMONG] if any(results.groups[PARTNERS] for results in tasks) else []),
        "## Settings in which a kind of player is ahead",
        grid(*_counts(tasks)),
    ]
    for results in tasks:
        parts += [
            f"## {results.task}",
            f"![Map of {results.task}]({folder}/{results.task}.png)",
            grid(*_scores(results)),
        ]
        parts += [f"{player}: {reason}." for player, reason in _refused(results).items()]
    return "\n\n".join(parts) + "\n"


def _sentence(tasks: Sequence[TaskResults]) -> str:
    """Return the summary: settings won by each kind, by what is varied."""
    texts = []
    for group in GROUPS:
        counts = Counter(each.winner for results in tasks for each in results.groups[group])
        of = ", ".join(f"{kind} {counts[kind]}" for kind in (*KINDS, LEVEL, ALONE) if counts[kind])
        if of:
            texts.append(f"{group}: {of} of {counts.total()}")
    return f"Settings in which a kind of player is ahead, by what is varied: {'; '.join(texts)}."


def _behind(tasks: Sequence[TaskResults]) -> str:
    """Return where rules are not enough: settings, by what is varied, in which the best kind is ahead of them."""
    texts = []
    for group in GROUPS:
        settings = [each for results in tasks for each in results.groups[group] if RULES in each.leaders]
        if settings:
            texts.append(f"{group}: {sum(RULES in each.behind for each in settings)} of {len(settings)}")
    return f"Settings in which rules are behind the best kind: {'; '.join(texts)}. " if texts else ""


def _counts(tasks: Sequence[TaskResults]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of winners: task by what is varied."""
    groups = [group for group in GROUPS if any(results.groups[group] for results in tasks)]
    rows = [[results.task, *(_winners(results.groups[group]) for group in groups)] for results in tasks]
    return ["task", *groups], rows


def _winners(settings: Sequence[SettingResults]) -> str:
    """Return the winners of settings, those of one axis together: "agents: 4 rules, 8 rules; ..."."""
    by_axis: dict[str, list[str]] = {}
    for each in settings:
        by_axis.setdefault(each.axis, []).append(f"{each.value} {each.winner}".strip())
    return "; ".join(
        ", ".join(each) if axis == HOME else f"{axis}: {', '.join(each)}" for axis, each in by_axis.items()
    )


def _scores(results: TaskResults) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a task's table: a row per setting, a column per player."""
    names = list(dict.fromkeys(name for each in results.settings for name in (*each.scores, *each.refused)))
    seeds = {name: max((len(s.scores[name].returns) for s in results.settings if name in s.scores), default=0)
             for name in names}  # fmt: skip
    header = ["setting", *(f"{name} ({seeds[name]} seeds)" if seeds[name] > 1 else name for name in names), "ahead"]
    rows = []
    for each in results.settings:
        cells = [score_text(each, name) if name in each.scores else "–" for name in names]
        rows.append([f"{each.axis} {each.value}".strip(), *cells, winner_text(each)])
    return header, rows


def score_text(setting: SettingResults, name: str) -> str:
    """Return mean return with its interval, and success."""
    score = setting.scores[name]
    return f"{_interval(score.mean)}, {score.success_rate.value:.0%}"


def winner_text(setting: SettingResults) -> str:
    """Return which kind is ahead, and by how much."""
    lead = setting.lead
    if lead is None:
        return f"alone: {setting.leaders[setting.first]}"
    name = setting.leaders[setting.first]
    if setting.winner == LEVEL:
        behind = f"; ahead of {' and '.join(setting.behind)}" if setting.behind else ""
        return f"level ({name} {_signed(lead)}{behind})"
    return f"{setting.winner}: {name} {_signed(lead)}"


def _signed(lead: Interval) -> str:
    return f"{lead.value:+.3g} [{lead.low:.3g}, {lead.high:.3g}]"


def _interval(interval: Interval) -> str:
    return f"{interval.value:.4g} [{interval.low:.4g}, {interval.high:.4g}]"


def _refused(results: TaskResults) -> dict[str, str]:
    """Return one reason for each player that cannot play some setting."""
    return dict(_first_reasons(results))


def _first_reasons(results: TaskResults) -> Iterator[tuple[str, str]]:
    for each in reversed(results.settings):
        yield from each.refused.items()
