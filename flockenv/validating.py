"""The command that tries models of pedestrians in the scenes of guidelines: a table, a page, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flockenv.terminal import INTERRUPTED, EarlyEnd, Force, new_console, progress_bar, relative, show_table

if TYPE_CHECKING:
    from flockenv.validation import Results

__all__ = ["validate"]


def validate(
    cases: Annotated[
        list[str] | None, typer.Argument(metavar="[CASE]...", help="Names, or first words of them [default: all].")
    ] = None,
    preset: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Published models; may be given again [default: all].")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON instead of tables.")] = False,
    out: Annotated[
        str | None, typer.Option(metavar="X.md|X.json", help="Write the page, X.json beside it, pictures into X/.")
    ] = None,
    force: Force = False,
) -> None:
    """Try published models of pedestrians in the scenes of RiMEA and NIST: value, bound and verdict of each."""
    from flockenv.outputs import checked_file
    from flockenv.validation import CASES, VERDICTS, cases_named, presets_named, run, trials

    path = checked_file(out, [".json", ".md"], True) if out is not None else None
    todo, under = cases_named(CASES, cases or []), presets_named(preset or [])
    found = None if path is None or force else _known(path.with_suffix(".json"))

    def keep(results: Results) -> None:
        nonlocal found
        found = results
        if path is not None:
            _write(path.with_suffix(".json"), results)

    stopped = False
    try:
        with progress_bar("crowds", trials(todo, under), "trials") as advance:
            found = run(todo, under, found, advance, keep)
    except KeyboardInterrupt:
        if found is None:
            raise
        stopped = True
    asked = found.only({case.name for case in todo}, set(under))
    if as_json:
        print(asked.model_dump_json(indent=1))
    else:
        console = new_console()
        show_table(console, "Crowds", asked.rows(), ("case", "", "bound", *asked.presets))
        show_table(
            console, "What came of each", [(f.case, f.preset, f.verdict, f.note) for f in asked.findings], [""] * 4
        )
        show_table(console, "Verdicts", VERDICTS.items())
    if path is not None:
        _write(path, found)
        if not as_json:
            new_console().print(f"{relative(path)} holds {len(found.findings)} findings")
    if stopped:
        raise EarlyEnd("interrupted; what was done is shown, the same command goes on", INTERRUPTED)


def _known(numbers: Path) -> Results | None:
    """Return what a file says already, none if it is not there; ValueError if it says something else."""
    from flockenv.validation import Results

    try:
        return Results.model_validate_json(numbers.read_text(encoding="utf-8")) if numbers.exists() else None
    except ValueError:
        raise ValueError(f"--out: {numbers.name} holds no findings of crowds; --force overwrites it") from None


def _write(path: Path, results: Results) -> None:
    """Write the findings as JSON; of a page that, the page, and its pictures."""
    from flockenv.outputs import replacing

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path.with_suffix(".json")) as file:
        file.write((results.model_dump_json(indent=1) + "\n").encode())
    if path.suffix.lower() == ".md":
        from flockenv.render.validation import write_pictures
        from flockenv.validation.page import page

        folder = path.with_suffix("")
        folder.mkdir(exist_ok=True)
        drawn = [picture.stem for picture in write_pictures(folder, results)]
        with replacing(path) as file:
            file.write(page(results, folder.name, drawn).encode())
