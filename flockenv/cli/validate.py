"""The `validate` command: models of pedestrians in the test scenes of guidelines; table, page and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flockenv.cli.jobs import EngineName, Processes
from flockenv.cli.studies import FEW, read_findings, run_trials, write_numbers
from flockenv.cli.terminal import INTERRUPTED, EarlyEnd, Force, new_console, relative_path, show_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flockenv.studies.trial_log import Case, Results

__all__ = ["validate"]


def validate(
    cases: Annotated[
        list[str] | None,
        typer.Argument(metavar="CASE", help="Names of cases, or their beginnings.", show_default="all"),
    ] = None,
    preset: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Published models; may be repeated.", show_default="all"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON instead of tables.")] = False,
    out: Annotated[
        str | None,
        typer.Option(metavar="X.md|X.json", help="Write a page, X.json beside it, and pictures in X/."),
    ] = None,
    scenes: Annotated[
        str | None,
        typer.Option(metavar="FOLDER", help="Only write the cases' scenes, as YAML, into this folder."),
    ] = None,
    force: Force = False,
    engine: EngineName = "local",
    processes: Processes = None,
) -> None:
    """Run published models of pedestrians in the test scenes of RiMEA and NIST: value, bound and verdict of each."""
    from flockenv.core.output_paths import valid_file
    from flockenv.jobs import engine_of
    from flockenv.studies.validation import CASES, fingerprint, run, select_cases, select_presets, trials

    path = valid_file(out, [".json", ".md"], True, beside=".json") if out is not None else None
    if path is not None and path.suffix.lower() == ".md":
        valid_file(str(path), [".md"], True, beside="")  # the folder of pictures
    todo, under = select_cases(CASES, cases or []), select_presets(preset or [])
    if scenes is not None:
        _write_scenes(scenes, force, todo, under)
        return
    known = None if force else read_findings(path, "crowds", fingerprint())
    count = trials(todo, under)
    runner = engine_of(engine, processes, small=count <= FEW)
    found, stopped = run_trials(
        "crowds", count, path, known, lambda known, progress, keep: run(todo, under, known, progress, keep, runner)
    )
    asked = found.only({case.name for case in todo}, set(under))
    if as_json:
        print(asked.model_dump_json(indent=1))
    else:
        console = new_console()
        show_table(console, "Crowds", asked.rows(3), ("case", "", "bound", *asked.unders))
        show_table(console, "Remarks", [(f.case, f.under, f.verdict, f.note) for f in asked.findings], [""] * 4)
        show_table(console, "Verdicts", asked.legend())
    if path is not None:
        _write(path, found)
        if not as_json:
            new_console().print(f"{relative_path(path)} contains {len(found.findings)} findings")
    if stopped:
        raise EarlyEnd("interrupted; results so far are shown, the same command continues", INTERRUPTED)


def _write_scenes(folder: str, force: bool, cases: Sequence[Case], presets: Sequence[str]) -> None:
    """Write the scenes of some cases as YAML, and print their number."""
    from flockenv.core.output_paths import valid_path
    from flockenv.studies.validation.scenes import write_scenes

    path = valid_path(folder, "--scenes")
    written = write_scenes(path, cases, presets, force)
    new_console().print(f"{relative_path(path)} contains {len(written)} scenes")


def _write(path: Path, results: Results) -> None:
    """Write the findings as JSON; if `path` is a page (.md), also the page and its pictures."""
    write_numbers(path, results)
    if path.suffix.lower() == ".md":
        from flockenv.core.atomic_files import new_folder, replace_file
        from flockenv.studies.validation.page import page
        from flockenv.studies.validation.plots import write_pictures

        folder = path.with_suffix("")
        with new_folder(folder):
            drawn = [picture.stem for picture in write_pictures(folder, results)]
        with replace_file(path) as file:
            file.write(page(results, folder.name, drawn).encode())
