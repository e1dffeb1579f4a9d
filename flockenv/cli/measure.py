"""`flockenv measure`: run a scene with one or several seeds; compute and draw the measures that apply to it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flockenv.cli.targets import SceneFile
from flockenv.cli.terminal import (
    DIVERGED,
    INTERRUPTED,
    EarlyEnd,
    Force,
    Seed,
    announce_rest,
    new_console,
    progress_bar,
    relative_path,
    show_table,
)
from flockenv.core.errors import printable
from flockenv.core.yaml_paths import title_of

if TYPE_CHECKING:
    from flockenv.scene import Scene
    from flockenv.studies.measured_run import Scope, Survey
    from flockenv.studies.measures import Above, Mean
    from flockenv.studies.trajectory import Trajectory

__all__ = ["measure"]

FORMAT = 1
EVERY = 0.1
"""s, rounded to whole steps: the default interval between recorded positions."""
CELL = 0.5
"""m and s: cell size of the space-time picture of density; larger for a long run."""
MOST_CELLS = 400

ABOVE_CHANCE = {"lanes": "lanes by chance", "burst length": "burst length by chance"}


def measure(
    scene: SceneFile,
    time: Annotated[float, typer.Option(metavar="S", help="Simulated time in seconds, a whole multiple of dt.")] = 30.0,
    skip: Annotated[float, typer.Option(metavar="S", help="Seconds at the beginning that are left out.")] = 0.0,
    line: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="A line in metres; forward is to its right.")
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1",
            help="Two corners of an area, or all of its corners.",
            show_default="a box or torus",
        ),
    ] = None,
    walkable: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,X,Y,...",
            help="Where Voronoi cells end, like the area.",
            show_default="the region, less obstacles",
        ),
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time between recorded instants in seconds.", show_default="about 0.1"),
    ] = None,
    seed: Seed = 0,
    seeds: Annotated[int, typer.Option(min=1, max=10_000, help="Number of runs, from this seed on.")] = 1,
    json_file: Annotated[str | None, typer.Option("--json", metavar="X.json", help="Write the numbers.")] = None,
    out: Annotated[str | None, typer.Option(metavar="DIR", help="Write pictures into this folder.")] = None,
    force: Force = False,
) -> None:
    """Run a scene and measure its crowd: flow, density, lanes, bursts, clogging, order; table, JSON and pictures."""
    from flockenv.scene.yaml_io import load_scene
    from flockenv.studies.measured_run import mean_measures

    loaded = load_scene(Path(scene))
    numbers, folder = _output_paths(json_file, out, force)
    steps, stride = _step_counts(loaded, time, skip, every)
    scope = _scope(loaded, line, area, walkable, skip)
    surveys, first = _survey_seeds(loaded, seed, seeds, steps, stride, scope)
    means, above = mean_measures(surveys), _compare_with_chance(surveys)
    _show_tables(loaded, surveys, means, above, first, stride)
    if numbers is not None:
        _write_numbers(numbers, _summary(loaded, scope, surveys, means, above, first, stride))
    if folder is not None:
        _write_pictures(folder, first, surveys, scope, title_of(scene))
    _report_early_end(surveys, seeds)


def _output_paths(json_file: str | None, out: str | None, force: bool) -> tuple[Path | None, Path | None]:
    """Return the paths for the numbers and the pictures; raise ValueError if one cannot be written."""
    from flockenv.core.output_paths import valid_file

    numbers = valid_file(json_file, [".json"], force, "--json") if json_file is not None else None
    return numbers, _check_folder(out, force) if out is not None else None


def _step_counts(scene: Scene, time: float, skip: float, every: float | None) -> tuple[int, int]:
    """Return the number of steps of a run, and of steps between two recorded instants."""
    from flockenv.studies.trajectory import whole_steps

    steps = whole_steps("--time", time, scene.dt, 1)
    if not (math.isfinite(skip) and 0 <= skip < time):
        raise ValueError(f"--skip = {skip:g}: must be >= 0 and less than --time = {time:g}")
    stride = max(1, round(EVERY / scene.dt)) if every is None else whole_steps("--every", every, scene.dt, 1)
    return steps, stride


def _scope(scene: Scene, line: str | None, area: str | None, walkable: str | None, skip: float) -> Scope:
    """Return where and when the scene is measured; raise ValueError for options that do not fit it."""
    from flockenv.studies.measured_run import Scope

    scope = Scope(
        _parse_line(line), _parse_area("--area", area, True), _parse_area("--walkable", walkable, False), skip
    )
    scope.check(scene)
    return scope


def _survey_seeds(
    scene: Scene, seed: int, seeds: int, steps: int, stride: int, scope: Scope
) -> tuple[list[Survey], Trajectory]:
    """Run a scene with several seeds and measure each run; return the surveys, and the first run.

    A run that stops early is the last; KeyboardInterrupt is raised only if nothing has been measured yet.
    """
    from flockenv.studies.measured_run import survey
    from flockenv.studies.trajectory import record

    found: list[Survey] = []
    first: Trajectory | None = None
    try:
        for k in range(seeds):
            title = f"simulating {k + 1}/{seeds}" if seeds > 1 else "simulating"
            with progress_bar(title, steps, "steps") as progress:
                run = record(scene, seed + k, steps, stride, progress)
            if run.stopped == "interrupted":
                announce_rest(f"measuring the first {run.last.time[0]:.3g} s")
            with progress_bar("measuring", 6, "families") as progress:
                found.append(survey(run, scope, progress))
            first = first or run
            if found[-1].stopped == "interrupted" and not run.stopped:
                announce_rest("showing what was measured")
            if found[-1].stopped:
                break
    except KeyboardInterrupt:
        if first is None:
            raise
        announce_rest("showing what was measured")
    assert first is not None  # there is at least one seed
    return found, first


def _report_early_end(surveys: Sequence[Survey], seeds: int) -> None:
    """Raise EarlyEnd if a run stopped early, or if some of the seeds were not run."""
    stopped = surveys[-1].stopped or ("interrupted" if len(surveys) < seeds else "")
    if stopped:
        text = f"{stopped}; results until then are shown"
        raise EarlyEnd(text, INTERRUPTED if stopped == "interrupted" else DIVERGED)


PICTURES = ("flow_density.png", "lanes.png", "gaps.png", "space_time.png")


def _check_folder(text: str, force: bool) -> Path:
    from flockenv.core.output_paths import valid_file, valid_path

    folder = valid_path(text)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {printable(text)}: is a file; pictures go into a folder")
    for name in PICTURES:
        valid_file(str(folder / name), [".png"], force)
    return folder


def _parse_numbers(option: str, text: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) < 4 or len(numbers) % 2 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{option} = {printable(text)}: must be X0,Y0,X1,Y1 in metres, or more corners for an area")
    return numbers


def _parse_line(text: str | None) -> Any:
    import numpy as np

    if text is None:
        return None
    numbers = _parse_numbers("--line", text)
    if len(numbers) != 4 or numbers[:2] == numbers[2:]:
        raise ValueError(f"--line = {printable(text)}: must be the two ends of a line, X0,Y0,X1,Y1 in metres")
    return np.array(numbers).reshape(2, 2)


def _parse_area(option: str, text: str | None, is_convex: bool) -> Any:
    import numpy as np

    from flockenv.studies.measures.polygons import rectangle, valid_polygon

    if text is None:
        return None
    corners = np.array(_parse_numbers(option, text)).reshape(-1, 2)
    return valid_polygon(option, rectangle(*corners) if len(corners) == 2 else corners, is_convex)


def _compare_with_chance(found: Sequence[Survey]) -> dict[str, Above]:
    """Return the comparison with chance of each measure in ABOVE_CHANCE that at least five runs have."""
    from flockenv.studies.measures import above_null

    out = {}
    for name, null in ABOVE_CHANCE.items():
        pairs = [(each.values[name], each.values[null]) for each in found if null in each.values]
        pairs = [pair for pair in pairs if all(map(math.isfinite, pair))]
        if len(pairs) >= 5:
            out[name] = above_null([value for value, _ in pairs], [chance for _, chance in pairs])
    return out


def _format(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"


def _show_tables(
    scene: Scene, found: Sequence[Survey], means: dict[str, Mean], above: dict[str, Above], run: Trajectory, stride: int
) -> None:
    """Print the table of measures; for several runs, means with 95 % intervals."""
    from flockenv.studies.measured_run import UNITS

    console, many = new_console(), len(found)
    kept = f"positions every {stride * scene.dt:g} s"
    seeds = f"seed {run.seed}" if many == 1 else f"seeds {run.seed} to {run.seed + many - 1}: means and 95 % intervals"
    title = f"{scene.agents:,} agents, {float(run.last.time[0]):g} s, {kept}, {seeds}"
    if many == 1:
        single = [(name, _format(mean.mean), UNITS[name]) for name, mean in means.items()]
        show_table(console, title, single, ("measure", "value", ""))
        return
    rows = [
        (name, _format(x.mean), f"{_format(x.low)} to {_format(x.high)}", f"{x.runs}", UNITS[name])
        for name, x in means.items()
    ]
    show_table(console, title, rows, ("measure", "mean", "95 %", "runs", ""))
    verdicts = [
        (name, _format(x.excess), f"{_format(x.low)} to {_format(x.high)}", f"{x.runs}", "yes" if x.holds else "no")
        for name, x in above.items()
    ]
    if verdicts:
        show_table(console, "Above chance?", verdicts, ("measure", "excess", "95 %", "runs", "with 95 % confidence"))


def _summary(
    scene: Scene, scope: Scope, found: Sequence[Survey], means: dict[str, Mean], above: dict[str, Above],
    run: Trajectory, stride: int,
) -> dict[str, Any]:  # fmt: skip
    """Return all measurements, ready for JSON: undefined numbers are null, never NaN."""
    from flockenv.studies.measured_run import UNITS

    def plain(value: float) -> float | None:
        return value if math.isfinite(value) else None

    corners = {"line": scope.line, "area": scope.area, "walkable": scope.walkable}
    return {
        "format": FORMAT,
        "scene": scene.model_dump(mode="json"),
        "seeds": [run.seed + k for k in range(len(found))],
        "time_s": float(run.last.time[0]),
        "skip_s": scope.skip,
        "every_s": stride * scene.dt,
        **{name: None if given is None else given.tolist() for name, given in corners.items()},
        "stopped": found[-1].stopped,
        "measures": {
            name: {
                "unit": UNITS[name],
                "mean": plain(x.mean),
                "low": plain(x.low),
                "high": plain(x.high),
                "runs": x.runs,
            }
            for name, x in means.items()
        },
        "above_chance": {name: {**x._asdict(), "holds": bool(x.holds)} for name, x in above.items()},
        "by_seed": [{name: plain(value) for name, value in each.values.items()} for each in found],
        "samples": {
            "density_per_m2": [plain(float(x)) for each in found for x in each.density],
            "speed_m_per_s": [plain(float(x)) for each in found for x in each.speed],
            "gaps_s": [float(x) for each in found for x in each.gaps],
        },
    }


def _write_numbers(path: Path, summary: dict[str, Any]) -> None:
    from flockenv.core.atomic_files import new_folder, replace_file

    with new_folder(path.parent), replace_file(path) as file:
        file.write((json.dumps(summary, indent=1, allow_nan=False) + os.linesep).encode())
    new_console().print(f"numbers in {relative_path(path)}")


def _write_pictures(folder: Path, run: Trajectory, found: Sequence[Survey], scope: Scope, name: str) -> None:
    """Draw into a folder, which is created if it is missing, and print the names of the pictures."""
    from flockenv.core.atomic_files import new_folder

    with new_folder(folder):
        drawn = _draw_pictures(folder, run, found, scope, name)
    new_console().print(f"{', '.join(drawn) or 'no pictures'} in {relative_path(folder)}")


def _draw_pictures(folder: Path, run: Trajectory, found: Sequence[Survey], scope: Scope, name: str) -> list[str]:
    """Write the pictures that have data; return their names."""
    import numpy as np

    from flockenv.studies.measured_run import SAMPLES
    from flockenv.studies.measures import goodness, tail
    from flockenv.studies.measures.plots import write_flow_density, write_gaps, write_lanes, write_space_time

    drawn = []
    density, speed, gaps = (np.concatenate([getattr(s, what) for s in found]) for what in ("density", "speed", "gaps"))
    if np.isfinite(speed).any():
        write_flow_density(folder / PICTURES[0], density, speed, f"{name}: flow and speed over density")
        drawn.append(PICTURES[0])
    if run.scene.dimension == 2:
        start = next(iter(run.snapshots()))
        solids = [*start.outlines, *(p for shape in run.scene.circles for p in shape.polygons(start.low, start.high))]
        alive = run.alive & np.isfinite(run.pos).all(axis=2)
        write_lanes(
            folder / PICTURES[1], run.pos, alive, found[0].direction, (start.low, start.high),
            f"{name}: trajectories (orange along {_direction_text(found[0].axis)}, blue against it)",
            solids, scope.line, scope.area,
        )  # fmt: skip
        drawn.append(PICTURES[1])
    if (gaps > 0).any():
        fit = tail(gaps)
        title = f"{name}: {len(gaps)} gaps between passages"
        write_gaps(folder / PICTURES[2], gaps, fit, goodness(gaps, fit, SAMPLES), title)
        drawn.append(PICTURES[2])
    if run.scene.dimension == 2 and len(run.step) > 2:
        time, place, image = _space_time(run, found[0])
        where = None if scope.line is None else float(scope.line.mean(axis=0) @ found[0].axis)
        write_space_time(folder / PICTURES[3], time, place, image, f"{name}: density along the walking axis", where)
        drawn.append(PICTURES[3])
    return drawn


def _direction_text(axis: Any) -> str:
    """Return a direction as text: +x, +y, -x, -y, or its angle."""
    names = {(1.0, 0.0): "+x", (0.0, 1.0): "+y", (-1.0, 0.0): "-x", (0.0, -1.0): "-y"}
    plain = (float(axis[0]) + 0.0, float(axis[1]) + 0.0)
    return names.get(plain, f"{math.degrees(math.atan2(plain[1], plain[0])):.0f}°")


def _space_time(run: Trajectory, found: Survey) -> tuple[Any, Any, Any]:
    """Return times (T + 1,), positions along the axis (X + 1,), and the density in each cell between them, (T, X)."""
    import numpy as np

    alive = run.alive & np.isfinite(run.pos).all(axis=2)
    k, i = np.nonzero(alive)
    pos = run.pos[k, i].astype(float)
    along, across = pos @ found.axis, pos @ np.array([-found.axis[1], found.axis[0]])
    when = (run.step * run.scene.dt)[k]

    def edges(values: Any, least: float) -> Any:
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
        many = int(np.clip(np.ceil((high - low) / least), 1, MOST_CELLS))
        return np.linspace(low, max(high, low + least), many + 1)

    gap = float(np.diff(run.step).max()) * run.scene.dt
    time, place = edges(when, max(CELL, gap)), edges(along, CELL)
    people = np.histogram2d(when, along, (time, place))[0]
    instants = np.histogram(run.step * run.scene.dt, time)[0]
    width = max(float(np.ptp(across)), CELL) if len(across) else CELL
    size = width * (place[1] - place[0])
    return time, place, people / np.maximum(instants, 1)[:, None] / size
