"""What accuracy costs: `python -m agents.cost_of_accuracy` measures three scenes, and draws them above returns.

Each scene runs with several methods and steps, as by `flockenv accuracy`. An error is that of the agent with the
largest error at the end, as a share of the distance that the farthest agent moves. Returns are those of
transfer.json, which `agents.transfer` writes. Errors are measured as jobs, whose records are stored; times afterwards,
in this process. Writes cost_of_accuracy.json and cost_of_accuracy.png.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from agents.compare import JOBS, ROOT, folder_of, provenance, write_text
from agents.cost_chart import method_name
from agents.transfer_verdict import SURVIVES, lost_settings
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes
from flockenv.cli.options import Debug
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import printable
from flockenv.evaluation.report import Results, json_text
from flockenv.jobs import Job, Store, Work, engine_of, records, run_jobs
from flockenv.physics.integrators import methods_of
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.accuracy import Choice, Problem, Report, add_times, measure

__all__ = ["AIM", "CASES", "Case", "app", "costs_of", "scores_of", "sentence"]

AIM = 0.01
"""The error for which the cheapest method is marked, as a share of the distance that the farthest agent moves."""

LEVEL = 1.1
"""Costs up to this ratio to the lowest are level: times on one machine vary by as much."""

REPETITIONS = 7
"""Runs of each setting whose median is the wall time; of implicit methods, whose runs take seconds, one."""
FILES = ("cost_of_accuracy.json", "cost_of_accuracy.png")
TASKS = ("flock", "bottleneck", "path_follow")
"""Tasks whose returns are drawn."""

EXPLICIT = ("explicit_euler", "semi_implicit_euler", "midpoint", "velocity_verlet", "rk4")
IMPLICIT = ("implicit_euler", "implicit_midpoint", "linearly_implicit_euler")

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class Case:
    """A scene to measure, from its state after `after` seconds, over `seconds`."""

    scene: str  # name of a file in configs/scenes
    title: str
    short: str  # in sentences
    after: float
    seconds: float
    runs: tuple[tuple[tuple[str, ...], tuple[int, ...]], ...]
    """Methods and the numbers of steps in which they run."""
    finer: int
    """Steps of the reference per step of the finest run, if it is found by own steps."""

    @property
    def name(self) -> str:
        """The name of the scene's file, without its suffix."""
        return Path(self.scene).stem

    def load(self) -> Scene:
        """Return the scene of the file."""
        return load_scene(ROOT / "configs" / "scenes" / self.scene)

    @property
    def about(self) -> Results:
        """All that the errors depend on, besides the code."""
        return {**dataclasses.asdict(self), "contents": self.load().model_dump(mode="json")}

    def problems(self) -> list[Problem]:
        """Return the problem of each group of methods; all have the same start."""
        scene = self.load()
        found = [Problem.of(scene, self.seconds, steps, name=self.name, title=self.title) for _, steps in self.runs]
        before = round(self.after / scene.dt)
        if not before:
            return found
        start = scene.step(scene.start(0), steps=before)
        return [dataclasses.replace(problem, start=start) for problem in found]


CASES = (
    Case("boids.yaml", "A flock of 300", "flock", 10.0, 1.0, ((EXPLICIT, (5, 10, 20, 40, 80, 160)),), 64),
    Case("crowd_room.yaml", "A crowd in contact", "crowd", 6.0, 0.5, ((EXPLICIT, (20, 40, 80, 160, 320)),), 16),
    Case(
        "cloth.yaml", "A stiff cloth", "cloth", 0.0, 0.5,
        ((EXPLICIT, (180, 360, 720, 1440, 2880)), (IMPLICIT, (15, 30, 60, 120))), 16,
    ),
)  # fmt: skip
"""A flock, a crowd with contact, and a cloth; over horizons in which a difference at the start hardly grows."""


# --- the command line -------------------------------------------------------------------------------------------------


@app.command()
def main(
    transfer: Annotated[
        str, typer.Option(metavar="FILE", help="Returns, as agents.transfer writes them.")
    ] = "results/transfer.json",
    repetitions: Annotated[
        int, typer.Option(min=1, max=1000, help="Runs of each setting; the wall time is their median.")
    ] = REPETITIONS,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    out: Annotated[str, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = "results",
    debug: Debug = False,
) -> None:
    """Measure error against wall time in three scenes, and draw it above the returns of some tasks."""
    with report_errors("cost_of_accuracy", STOPPED, debug):
        folder = folder_of(out, FILES)
        played = _read_transfer(Path(transfer))
        tasks = {task: scores_of(played, task) for task in TASKS}
        runner = engine_of(engine, processes)
        with job_bar("compiling and measuring errors") as progress:
            scenes = _measure(CASES, repetitions, Work(Store(folder / JOBS), runner, fresh, progress))
        results = {
            "aim": AIM, "repetitions": repetitions, "scenes": scenes, "tasks": tasks,
            "sentence": sentence(scenes, played), "transfer": {key: played[key] for key in ("worlds", "seed", "git")},
            **provenance(),
        }  # fmt: skip
        write_all_or_none(folder, {
            FILES[0]: lambda path: write_text(path, json_text(results)), FILES[1]: lambda path: _draw(path, results),
        })  # fmt: skip
    for line in [*map(_line, scenes.values()), results["sentence"]]:
        typer.echo(line)
    typer.echo(f"{', '.join(FILES)} are in {folder}")


def _read_transfer(path: Path) -> Results:
    """Return the results of agents.transfer; raise ValueError, in one line, if there are none."""
    makes = "`python -m agents.transfer` writes it"
    if not path.is_file():
        raise ValueError(f"--transfer {printable(str(path))}: no such file; {makes}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        content = None
    if not isinstance(content, dict) or not {"tasks", "worlds", "seed", "git"} <= content.keys():
        raise ValueError(f"--transfer {printable(str(path))}: not the results of a transfer; {makes}")
    return content


def _draw(path: Path, results: Results) -> None:
    from agents.cost_chart import write_chart

    write_chart(path, results)


# --- scenes -----------------------------------------------------------------------------------------------------------


def _measure(cases: Sequence[Case], repetitions: int, work: Work) -> Results:
    """Measure the errors of all cases as jobs, then all times in this process; return plain data by scene."""
    jobs = {case: Job(f"cost_of_accuracy/{case.name}", _errors, (case,), case.about) for case in cases}
    run_jobs(list(jobs.values()), work)
    return {case.name: costs_of(case, _timed(case, work.store.read(job, _reports), repetitions))
            for case, job in jobs.items()}  # fmt: skip


def _errors(case: Case) -> bytes:
    """Return the reports of a case without times, one per group of methods, as bytes."""
    pairs = zip(case.problems(), case.runs, strict=True)
    return records.to_bytes([measure(problem, methods_of(names), 0, case.finer) for problem, (names, _) in pairs])


def _reports(data: bytes) -> list[Report]:
    found = records.from_bytes(data, (Report,))
    if not isinstance(found, list) or not all(isinstance(report, Report) for report in found):
        raise ValueError("damaged: must hold reports")
    return found


def _timed(case: Case, reports: Sequence[Report], repetitions: int) -> list[Report]:
    """Return the reports with wall times, measured now; raise KeyboardInterrupt if that was interrupted."""
    timed = [
        add_times(report, problem, methods_of(names), 1 if names == IMPLICIT else repetitions)
        for report, problem, (names, _) in zip(reports, case.problems(), case.runs, strict=True)
    ]
    if any(report.stopped for report in timed):
        raise KeyboardInterrupt
    return timed


def costs_of(case: Case, reports: Sequence[Report]) -> Results:
    """Return errors and times of a case as plain data, and the cheapest method that reaches the aim.

    An error is a share of the distance that the farthest agent moves; None: the run diverged, or was refused as
    unstable. Raises ValueError if the reference is too inexact for the aim.
    """
    reach = reports[0].reach
    floor = max(report.floor for report in reports) / reach
    if floor > AIM:
        raise ValueError(f"{case.scene}: errors below {floor:.1%} are not trusted, so {AIM:.0%} cannot be measured")
    curves = [curve for report in reports for curve in report.curves]
    choices = {curve.method: curve.cheapest_choice(AIM * reach, "seconds") for curve in curves}
    reached = {method: found.cost for method, found in choices.items() if found}
    return {
        "scene": f"configs/scenes/{case.scene}", "title": case.title, "short": case.short, "agents": reports[0].agents,
        "after_s": case.after, "seconds": case.seconds, "reach_m": reach, "floor": floor,
        "growth": max(report.growth for report in reports), "reference": reports[0].reference,
        "note": reports[0].note, "machine": reports[0].machine.model_dump(),
        "methods": {
            curve.method: [
                {
                    "dt": point.dt, "error": None if point.error is None else point.error / reach,
                    "ms_per_s": None if point.seconds is None else 1e3 * point.seconds / case.seconds,
                    "evaluations_per_s": point.evaluations / case.seconds,
                }
                for point in curve.points
            ]
            for curve in curves
        },
        "to_aim": {method: _choice(found, case, reach) for method, found in choices.items()},
        "cheapest": min(reached, key=lambda method: reached[method], default=None),
    }  # fmt: skip


def _choice(found: Choice | None, case: Case, reach: float) -> Results | None:
    """Return the cost of the aim with one method; None if it does not reach the aim in the steps measured."""
    if found is None:
        return None
    return {
        "dt": found.dt, "ms_per_s": 1e3 * found.cost / case.seconds, "error": found.error / reach,
        "interpolated": found.interpolated,
    }  # fmt: skip


# --- returns ----------------------------------------------------------------------------------------------------------


def scores_of(played: Results, task: str, players: Sequence[str] = ("rules", "ppo")) -> Results:
    """Return the scores of players under each double-precision setting, 0 = random actions, 1 = rules as tuned.

    Raises:
        ValueError: the task, or one of its players, has not been played.
    """
    about = played["tasks"].get(task)
    missing = f"task {task!r}" if about is None else next(
        (f"player {name!r} of task {task!r}" for name in ("random", *players) if name not in about["again"]), ""
    )  # fmt: skip
    if missing:
        raise ValueError(f"--transfer: has no results of {missing}; `python -m agents.transfer` plays all tasks")
    home = about["settings"][about["trained"]]["players"]
    low, high = home["random"]["mean"], home["rules"]["mean"]
    return {
        "trained": about["trained"],
        "players": {
            name: [
                {
                    "setting": key, "method": each["method"], "dt": each["dt"], "us_per_s": each["us_per_s"],
                    "score": (each["players"][name]["mean"] - low) / (high - low),
                }
                for key, each in about["settings"].items() if each["dtype"] == "float64"
            ]
            for name in players
        },
    }  # fmt: skip


# --- sentences --------------------------------------------------------------------------------------------------------


def sentence(scenes: Results, played: Results) -> str:
    """Return the message of the picture: the cheapest methods of each scene, and in how many tasks policies survive."""
    cheapest = ", ".join(f"with {_cheapest(about)} ({about['short']})" for about in scenes.values())
    tasks = played["tasks"]
    pilots = " and ".join(dict.fromkeys(list(about["again"])[-1] for about in tasks.values()))
    safe = sum(not lost_settings(about, list(about["again"])[-1]) for about in tasks.values())
    kept = f"keeps {100 * SURVIVES:.0f} % of its lead over random with every method and step"
    who = pilots.replace("ppo", "PPO")
    return f"An error of {100 * AIM:.0f} % costs least {cheapest}; {who} {kept} in {safe} of {len(tasks)} tasks."


def _cheapest(about: Results) -> str:
    """Return the names of the methods of a scene whose costs are level with the lowest, which comes first."""
    costs = {method: found["ms_per_s"] for method, found in about["to_aim"].items() if found}
    level = [method for method in sorted(costs, key=lambda m: costs[m]) if costs[method] <= LEVEL * min(costs.values())]
    *others, last = map(method_name, level or ["no method"])
    return f"{', '.join(others)} or {last}" if others else last


def _line(about: Results) -> str:
    """Return the costs of the aim in one scene as text, the cheapest method first."""
    costs = {method: found["ms_per_s"] for method, found in about["to_aim"].items() if found}
    reached = ", ".join(f"{method_name(m)} {costs[m]:.3g}" for m in sorted(costs, key=lambda m: costs[m]))
    missed = ", ".join(method_name(method) for method, found in about["to_aim"].items() if not found)
    text = f"{about['title']}: {100 * AIM:.0f} % of {about['reach_m']:.3g} m, in ms per simulated second: {reached}"
    return text + (f"; not reached: {missed}" if missed else "")


if __name__ == "__main__":
    run_program("cost_of_accuracy", app, STOPPED)
