"""Commands of studies: accuracy of integrators, hard cases, experiments, gallery of behaviours."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flockenv.cli.jobs import EngineName, Processes
from flockenv.cli.targets import complete_scene
from flockenv.cli.terminal import (
    INTERRUPTED,
    EarlyEnd,
    Force,
    Seed,
    announce_rest,
    flush_output,
    new_console,
    progress_bar,
    relative_path,
    show_table,
)
from flockenv.core import signals
from flockenv.core.errors import printable
from flockenv.core.yaml_paths import title_of

if TYPE_CHECKING:
    from rich.console import Console

    from flockenv.core.record import Record
    from flockenv.jobs import Engine
    from flockenv.physics.integrators import Integrator
    from flockenv.studies.accuracy import Problem, Report
    from flockenv.studies.trial_log import Results

    Run = Callable[[Results | None, Callable[[int], None], Callable[[Results], None]], Results]

__all__ = [
    "FEW",
    "accuracy",
    "experiment",
    "gallery",
    "read_findings",
    "run_trials",
    "stress",
    "write_numbers",
]

Scenes = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="SCENE", help="Scenes of `flockenv list`, or files; not with --suite.", autocompletion=complete_scene
    ),
]
Steps = Annotated[
    str,
    typer.Option(metavar="N,M", help="Numbers of steps in which a scene is simulated.", show_default="around its dt"),
]
Finer = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=4, help="Steps of the reference per step of the finest run.", show_default="up to 64"
    ),
]

Methods = Annotated[
    str,
    typer.Option(
        metavar="A,B", help="Integrators, also with a field: KIND:FIELD=NUMBER.", show_default="all explicit ones"
    ),
]

FEW = 8
"""Trials for which no processes are started."""
INTERRUPTED_LATER = "interrupted; results so far are shown"
"""Message about an interrupt after the first problem has been measured."""


def accuracy(
    scenes: Scenes = None,
    suite: Annotated[bool, typer.Option("--suite", help="Measure the built-in problems instead.")] = False,
    problems: Annotated[
        str, typer.Option(metavar="A,B", help="Only these problems of the suite.", show_default="all")
    ] = "",
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Simulated time of a scene in seconds.", show_default="about 1")
    ] = None,
    methods: Methods = "",
    steps: Steps = "",
    dts: Annotated[str, typer.Option(metavar="S,S", help="The same, as lengths of a step in seconds.")] = "",
    tolerance: Annotated[
        str, typer.Option(metavar="M,M", help="Errors in metres for which the cheapest method is found.")
    ] = "1e-2,1e-4,1e-6",
    repetitions: Annotated[int, typer.Option(min=0, max=1000, help="Runs; the wall time is their median.")] = 20,
    finer: Finer = None,
    seed: Seed = 0,
    out: Annotated[
        str | None, typer.Option(metavar="X.json|X.png", help="Write the numbers; a picture has X.json beside it.")
    ] = None,
    force: Force = False,
    engine: EngineName = "local",
    processes: Processes = None,
) -> None:
    """Show the cost of accuracy: the final error of each integrator for each step length, and its time.

    Errors of several problems are measured as jobs; times afterwards in this process, one run at a time.
    """
    from flockenv.core.output_paths import valid_file
    from flockenv.jobs import engine_of
    from flockenv.studies.accuracy import methods_named, usual_methods

    todo = _problem_makers(scenes or (), suite, problems, seconds, steps, dts, seed)
    aimed = _parse_numbers("--tolerance", tolerance)
    path = valid_file(out, [".json", ".png"], force, beside=".json") if out is not None else None
    chosen = methods_named(_split_words(methods)) if methods else usual_methods()
    console = new_console()

    write = functools.partial(_write_reports, path)
    runner = engine_of(engine, processes, small=len(todo) <= FEW)
    reports, refused = _measure_problems(todo, chosen, repetitions, finer, aimed, console, write, runner)
    stopped = len(reports) + refused < len(todo) or (reports and reports[-1].stopped)
    if path is not None and reports:
        if path.suffix.lower() == ".png":
            if stopped:
                announce_rest(f"drawing {relative_path(path)}")
            _draw_precision(reports, path)
        console.print(f"{len(reports)} problems in {relative_path(path)}")
    if stopped:
        raise EarlyEnd(INTERRUPTED_LATER, INTERRUPTED)
    if not reports:
        raise ValueError("accuracy: no problem has a reference; each line gives the reason")


def _write_reports(path: Path | None, reports: Sequence[Report]) -> None:
    from flockenv.studies.accuracy import Results

    if path is not None:
        write_numbers(path, Results(reports=tuple(reports)))


def _problem_makers(
    scenes: Sequence[str], suite: bool, problems: str, seconds: float | None, steps: str, dts: str, seed: int
) -> dict[str, Callable[[], Problem]]:
    """Return functions that make the problems, by name or file; raise ValueError if options exclude each other."""
    from flockenv.studies.accuracy import select_problems

    if suite == bool(scenes):
        raise ValueError("accuracy: needs either a SCENE or --suite")
    if suite and (seconds is not None or steps or dts):
        raise ValueError("--suite: has its own horizons and steps; --seconds, --steps and --dts are for scenes")
    if problems and not suite:
        raise ValueError("--problems: needs --suite")
    if suite:
        return {each.name: functools.partial(_return_problem, each) for each in select_problems(_split_words(problems))}
    return {file: functools.partial(_problem_of_scene, file, seconds, steps, dts, seed) for file in scenes}


def _measure_problems(
    todo: Mapping[str, Callable[[], Problem]], methods: Sequence[Integrator], repetitions: int, finer: int | None,
    tolerances: Sequence[float], console: Console, keep: Callable[[Sequence[Report]], None], engine: Engine,
) -> tuple[list[Report], int]:  # fmt: skip
    """Measure problem after problem, store and show each; return the reports, and the number of problems without one.

    keep: called with all reports after each problem; an interrupt during compilation ends the process and loses none.
    engine: measures all errors first if it has several processes. If there are several problems, each one without a
    reference gives a line; a single one raises its ValueError.
    """
    from flockenv.studies.accuracy import add_times, measure

    reports: list[Report] = []
    known: dict[str, Report | ValueError] = {}
    rejected = 0
    if engine.parallel:
        todo = {name: functools.cache(problem) for name, problem in todo.items()}
        if _measure_errors(todo, methods, finer, engine, known):
            todo, repetitions = {name: problem for name, problem in todo.items() if name in known}, 0
    try:
        for name, problem in todo.items():
            try:
                if isinstance(found := known.get(name), ValueError):
                    raise found
                current = problem()
                with progress_bar(f"measuring {current.name}", 100, "%") as progress:
                    if found is None:
                        report = measure(current, methods, repetitions, finer=finer, progress=progress)
                    else:
                        report = add_times(found, current, methods, repetitions, progress)
            except ValueError as error:
                if len(todo) < 2:
                    raise
                rejected += 1
                console.print(f"{_error_line(name, error)}\n", soft_wrap=True)
                continue
            reports.append(report)
            keep(reports)
            _show_accuracy(console, reports[-1], tolerances)
            flush_output()
            signals.set_message(INTERRUPTED_LATER)
            if reports[-1].stopped:
                break
    except KeyboardInterrupt:
        if not reports:
            raise
        keep(reports)
    return reports, rejected


def _measure_errors(
    todo: Mapping[str, Callable[[], Problem]], methods: Sequence[Integrator], finer: int | None, engine: Engine,
    known: dict[str, Report | ValueError],
) -> bool:  # fmt: skip
    """Measure the errors of all problems as jobs, and enter the reports, or why there is none, into `known`.

    Returns True if interrupted; KeyboardInterrupt is raised only if there is no report yet.
    """
    from flockenv.studies.accuracy import Report, measure_errors

    problems: dict[str, Problem] = {}
    for name, problem in todo.items():
        try:
            problems[name] = problem()
        except ValueError as error:
            known[name] = error
    try:
        with progress_bar("measuring errors", len(problems), "problems") as advance:
            for done, (name, found) in enumerate(measure_errors(problems, methods, finer, engine), 1):
                known[name] = found
                advance(done)
    except KeyboardInterrupt:
        if not any(isinstance(found, Report) for found in known.values()):
            raise
        return True
    return False


def _error_line(name: str, error: ValueError) -> str:
    """Return the first line of an error, prefixed by the name of the problem."""
    first, *more = str(error).splitlines()
    where = "" if first.startswith(name) else f"{name}: "
    return f"{where}{first}{f' (and {len(more)} more)' if more else ''}"


def _show_accuracy(console: Console, report: Report, tolerances: Sequence[float]) -> None:
    """Print one report: its reference, the errors, the cost of each tolerance, the cheapest method."""
    from flockenv.studies.accuracy import table

    show_table(console, report.title, ([line] for line in table.headlines(report)), [""])
    heads, rows = table.errors(report)
    if rows:
        title = (
            f"Error at the end, m, \u00b1 {report.reference_error:.0e} of the reference (? = not clearly above that)"
        )
        show_table(console, title, rows, heads)
    show_table(console, "Cost", table.rows(report, tolerances), table.columns(tolerances))
    show_table(console, "The cheapest", ([line] for line in table.cheapest_lines(report, tolerances)), [""])


def _return_problem(problem: Problem) -> Problem:
    return problem


def _problem_of_scene(file: str, seconds: float | None, steps: str, dts: str, seed: int) -> Problem:
    """Return the `Problem` of a scene file; by default with 8 step lengths, each half of the one before.

    The longest is 4 dt; 2 dt or dt if the duration is no multiple of 4 dt.
    """
    from flockenv.scene.yaml_io import load_scene
    from flockenv.studies.accuracy import Problem
    from flockenv.studies.trajectory import whole_steps

    loaded = load_scene(Path(file))
    horizon = max(1, round(1.0 / loaded.dt)) * loaded.dt if seconds is None else seconds
    if steps and dts:
        raise ValueError("--steps and --dts: both set the steps; give one of them")
    if steps:
        counts = [int(n) if n == int(n) else n for n in _parse_numbers("--steps", steps)]
    elif dts:
        counts = [whole_steps("--seconds", horizon, dt, 1) for dt in _parse_numbers("--dts", dts)]
    else:
        usual = whole_steps("--seconds", horizon, loaded.dt, 1)
        coarsest = max(d for d in (1, 2, 4) if usual % d == 0)
        counts = [usual * 2**k // coarsest for k in range(8)]
    return Problem.of(loaded, horizon, counts, seed, name=title_of(file), title=Path(file).name)


def _write_results(path: Path, numbers: Record, draw: Callable[[Path], None]) -> None:
    """Write results as JSON and, if `path` is a picture, draw them there: both files or neither."""
    from flockenv.core.atomic_files import write_all_or_none

    writers: dict[str, Callable[[Path], None]] = {
        path.with_suffix(".json").name: functools.partial(write_numbers, numbers=numbers)
    }
    if path.suffix.lower() == ".png":
        writers[path.name] = draw
    write_all_or_none(path.parent, writers)


def write_numbers(path: Path, numbers: Record) -> None:
    """Write results as JSON, completely or not at all, with the suffix of `path` replaced by .json."""
    from flockenv.core.atomic_files import new_folder, replace_file
    from flockenv.evaluation.report import json_text

    with new_folder(path.parent), replace_file(path.with_suffix(".json")) as file:
        file.write(json_text(json.loads(numbers.model_dump_json())).encode())


def read_findings(path: Path | None, what: str, sources: str) -> Results | None:
    """Return the findings stored beside a path, None if there are none.

    Raise ValueError if the file has other content, or findings of another version of the sources.
    """
    from flockenv.studies.trial_log import Results

    numbers = None if path is None else path.with_suffix(".json")
    if numbers is None or not numbers.exists():
        return None
    try:
        found = Results.model_validate_json(numbers.read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(f"--out: {numbers.name} contains no findings of {what}; --force overwrites it") from None
    if found.sources != sources:
        count = len(found.findings)
        raise ValueError(
            f"--out: {numbers.name} contains findings ({count}) of another version of the code; --force starts again"
        )
    return found


def run_trials(what: str, count: int, path: Path | None, known: Results | None, run: Run) -> tuple[Results, bool]:
    """Run unknown trials, and write all results after each; return the results, and True if interrupted."""
    found = known

    def keep(results: Results) -> None:
        nonlocal found
        found = results
        if path is not None:
            write_numbers(path, results)

    try:
        with progress_bar(what, count, "trials") as advance:
            return run(known, advance, keep), False
    except KeyboardInterrupt:
        if found is None:
            raise
        if path is not None and path.suffix.lower() != ".json":
            announce_rest(f"drawing {relative_path(path)}")
        return found, True


def _draw_precision(reports: Sequence[Report], path: Path) -> None:
    from flockenv.studies.accuracy.plots import write_precision

    write_precision(path, reports)


def _draw_verdicts(results: Results, path: Path) -> None:
    from flockenv.studies.stress.plots import write_verdicts

    write_verdicts(path, results)


def _split_words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _parse_numbers(option: str, text: str) -> list[float]:
    """Return comma-separated positive numbers; ValueError if the text is anything else."""
    try:
        numbers = [float(word) for word in _split_words(text)]
    except ValueError:
        numbers = []
    if not numbers or not all(math.isfinite(x) and x > 0 for x in numbers):
        raise ValueError(f"{option} = {printable(text)}: must be positive numbers, separated by commas")
    return numbers


def stress(
    cases: Annotated[str, typer.Option(metavar="A,B", help="Only these hard cases, such as N14.")] = "",
    methods: Annotated[str, typer.Option(metavar="A,B", help="Integrators.", show_default="all")] = "",
    out: Annotated[
        str | None,
        typer.Option(
            metavar="X.json|X.png",
            help="Store the findings; a picture has X.json beside it. Findings in X.json are not computed again.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Start again, ignoring X.json.")] = False,
    engine: EngineName = "local",
    processes: Processes = None,
) -> None:
    """Run every hard case with every integrator, and show value, bound and verdict of each."""
    from flockenv.core.output_paths import valid_file
    from flockenv.jobs import engine_of
    from flockenv.physics.integrators import methods_of
    from flockenv.studies.stress import CASES, fingerprint, run, select_cases, trials, usual_methods

    path = valid_file(out, [".json", ".png"], True, beside=".json") if out is not None else None
    todo = select_cases(CASES, _split_words(cases))
    under = methods_of(_split_words(methods)) if methods else usual_methods()
    kinds = [method.kind for method in under]
    known = None if force else read_findings(path, "hard cases", fingerprint())
    count = trials(todo, kinds)
    runner = engine_of(engine, processes, small=count <= FEW)
    found, stopped = run_trials(
        "hard cases", count, path, known, lambda known, progress, keep: run(todo, under, known, progress, keep, runner)
    )
    asked = found.only({case.name for case in todo}, kinds)
    console = new_console()
    show_table(console, "Hard cases", asked.rows(), ("case", "scene", "bound", *asked.unders))
    if notes := [(f.case, f.under, f.verdict, f.note) for f in asked.findings if f.verdict != "pass"]:
        show_table(console, "Findings that did not pass", notes, ("case", "method", "", ""))
    show_table(console, "Verdicts", asked.legend())
    if path is not None:
        _write_results(path, found, functools.partial(_draw_verdicts, found))
        every = trials(CASES, [method.kind for method in usual_methods()])
        console.print(f"{relative_path(path)} contains {len(found.findings)} of {every} findings")
    if stopped:
        raise EarlyEnd("interrupted; results so far are shown, the same command continues", INTERRUPTED)


def experiment(
    plan: Annotated[str, typer.Argument(metavar="PLAN.yaml", help="Cases and variants: see configs/experiments.")],
    out: Annotated[
        str | None, typer.Option(metavar="X.json|X.png", help="Write the numbers; a picture has X.json beside it.")
    ] = None,
    force: Force = False,
) -> None:
    """Run an experiment about steering; write a table of the measures and a picture of the trajectories."""
    from flockenv.core.output_paths import valid_file
    from flockenv.studies.experiments import load_plan, run
    from flockenv.studies.experiments.curves import write_order
    from flockenv.studies.experiments.plots import write_trials

    path = valid_file(out, [".json", ".png"], force, beside=".json") if out is not None else None
    chosen = load_plan(Path(plan)).experiment()
    with progress_bar(chosen.title, len(chosen.cases) * len(chosen.variants), "trials") as advance:
        results, trials = run(chosen, advance)
    console = new_console()
    show_table(console, chosen.title, results.rows(), ("case", "", *results.columns))
    show_table(console, "Cases", results.cases.items())
    show_table(console, "Columns", results.columns.items())
    if path is not None:
        draw = write_trials if chosen.curve is None else write_order
        _write_results(path, results, lambda picture: draw(picture, chosen, trials))
        console.print(f"{len(results.cells)} trials in {relative_path(path)}")


def gallery(
    out: Annotated[str, typer.Option(metavar="X.md", help="File of the page; pictures go into a folder X beside it.")],
    force: Force = False,
) -> None:
    """Draw every behaviour in its own small scene, and write a page about all of them."""
    from flockenv.behaviours import BEHAVIOURS
    from flockenv.cli.gallery import write_gallery
    from flockenv.core.output_paths import valid_file

    path = valid_file(out, [".md"], force, beside="")
    with progress_bar("drawing", len(BEHAVIOURS), "behaviours") as advance:
        many = write_gallery(path, progress=advance)
    new_console().print(f"{many} behaviours in {relative_path(path)}")
