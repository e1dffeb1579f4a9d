"""Measure contestants side by side: warmed up, in rotating order, as ratios taken within the same round.

with Bench("limit", quick=quick, out=out) as bench:
    bench.race("1024 x 32", [Contestant("C", c_step, work=32768), Contestant("ours", step, 32768)], baseline="C")
    bench.note("float32, one thread")

A machine drifts by the minute and is shared with others, so a rate on its own says little; a ratio of two samples that
were taken within the same fraction of a second says more. Leaving the block, by Ctrl-C or an error too, prints a
table and writes results/benchmarks/NAME.json with every sample in it.
"""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from importlib import metadata
from itertools import groupby, repeat
from pathlib import Path
from time import perf_counter, process_time
from types import TracebackType
from typing import Annotated, Any, Self

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from flockenv.core.atomic_files import replace_file
from flockenv.core.output_paths import valid_file

__all__ = [
    "Bench", "Contestant", "Floor", "Out", "Plan", "Quick", "Result", "Rounds", "Sample",
    "command_line", "machine", "race", "report",
]  # fmt: skip

ROOT = Path(__file__).resolve().parent.parent
FOLDER = Path("results/benchmarks")
PACKAGES = ("numpy", "numba", "llvmlite", "gymnasium", "pettingzoo", "stable-baselines3", "torch")
VARIABLES = (
    "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "MALLOC_MMAP_THRESHOLD_",
    "MALLOC_TRIM_THRESHOLD_",
)  # fmt: skip
QUARTERS = (0.25, 0.5, 0.75)
INTERRUPTED = 130  # exit code of a program that Ctrl-C ended

Numbers = dict[str, Any]
Advance = Callable[[str, int, int], None]  # what is running, samples done, samples in all

Quick = Annotated[bool, typer.Option("--quick", help="A quick look: fewer and shorter samples.")]
Rounds = Annotated[int | None, typer.Option(min=1, help="Rounds; every contestant runs once in each. [15; quick: 5]")]
Out = Annotated[str | None, typer.Option(metavar="X.json", help=f"Where to write. [{FOLDER}/NAME.json]")]


def command_line(main: Callable[..., None]) -> typer.Typer:
    """Return the command line of a benchmark: `command_line(main)()` at the end of its module."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command()(main)
    return app


@dataclass(frozen=True)
class Plan:
    """How long to measure."""

    rounds: int = 15
    sample_seconds: float = 0.075  # s, one sample of one contestant lasts about this

    @classmethod
    def of(cls, quick: bool = False, rounds: int | None = None) -> Plan:
        """Read it from the options that every benchmark has."""
        usual = cls(5, 0.03) if quick else cls()
        return cls(rounds or usual.rounds, usual.sample_seconds)


@dataclass(frozen=True)
class Floor:
    """What no program on this machine beats: counted work per item, and the rate that follows from it."""

    rate: float  # items/s
    why: str  # in words: what was counted, and at what pace the machine does it
    operations: float | None = None  # per item
    bytes: float | None = None  # per item, to and from memory

    @classmethod
    def from_counts(cls, operations: float, bytes_: float, pace: float, bandwidth: float, why: str) -> Floor:
        """Take the slower of computing (pace, operations/s) and fetching (bandwidth, bytes/s); 0 = not counted."""
        seconds = max(operations / pace, bytes_ / bandwidth)
        return cls(1.0 / seconds, why, operations, bytes_)


@dataclass(frozen=True)
class Sample:
    """One stretch of running one contestant."""

    items: float  # work done
    seconds: float  # s, wall clock
    cpu_seconds: float | None = None  # s, of all threads of this process; None: not known

    @property
    def rate(self) -> float:
        """Items/s."""
        return self.items / self.seconds


@dataclass(frozen=True)
class Contestant:
    """Something to be measured: a callable that does `work` items per call, after a first call that may compile.

    A subclass may run elsewhere, in another process say: it overrides `warm` and `sample`.
    """

    name: str
    call: Callable[[], object]
    work: float  # items per call, e.g. worlds x agents x steps
    floor: Floor | None = None
    note: str = ""  # what it does, in words

    def warm(self, seconds: float) -> int:
        """Run it until it is compiled and in the caches; return how many calls last about `seconds` s."""
        self.call()
        calls = 1
        while (took := self.sample(calls).seconds) < seconds / 2 and calls < 10**8:
            calls = max(2 * calls, min(16 * calls, round(calls * seconds / max(took, 1e-9))))
        return max(1, round(calls * seconds / max(took, 1e-9)))

    def sample(self, calls: int) -> Sample:
        """Run it a number of times."""
        cpu, began = process_time(), perf_counter()
        for _ in repeat(None, calls):
            self.call()
        return Sample(calls * self.work, perf_counter() - began, process_time() - cpu)


@dataclass(frozen=True)
class Result:
    """What was measured of one contestant; rates in items/s, spreads as (25th, 50th, 75th percentile)."""

    race: str
    name: str
    baseline: str
    rates: tuple[float, ...]  # one per complete round
    quartiles: tuple[float, float, float]
    ratios: tuple[float, float, float] | None  # to the baseline, within rounds; none: no round was complete
    first_seconds: float  # s, warming up: compiling, first calls, calibration
    calls: int  # per sample
    cores: float | None  # CPU seconds per wall second: below 1, something else had the core; above, threads
    floor: Floor | None = None
    note: str = ""

    @property
    def rate(self) -> float:
        """Median rate, items/s."""
        return self.quartiles[1]

    @property
    def ratio(self) -> float | None:
        """Median over rounds of this rate over the baseline's."""
        return self.ratios[1] if self.ratios else None


def _report_nothing(what: str, done: int, most: int) -> None:
    """Report nothing."""


def race(
    title: str,
    contestants: Sequence[Contestant],
    baseline: str,
    plan: Plan | None = None,
    advance: Advance = _report_nothing,
) -> tuple[list[Result], bool]:
    """Measure contestants in turns; return their results, and whether Ctrl-C cut it short (what was done is kept).

    Every round runs each contestant once; the next round begins with the next one, so that none is always first.
    Raises ValueError if two have one name, or none is called `baseline`.
    """
    plan = plan or Plan()
    names = [c.name for c in contestants]
    if len(set(names)) < len(names) or baseline not in names:
        raise ValueError(f"race {title!r}: baseline {baseline!r}, contestants {names}: one must be it, no name twice")
    samples: list[list[Sample]] = [[] for _ in names]
    ready: list[tuple[int, float]] = []
    interrupted = False
    try:
        for contestant in contestants:
            advance(f"{title}: warming {contestant.name}", 0, plan.rounds * len(names))
            began = perf_counter()
            ready.append((contestant.warm(plan.sample_seconds), perf_counter() - began))
        for done, k in enumerate(_turns(len(names), plan.rounds)):
            advance(f"{title}: {names[k]}", done, plan.rounds * len(names))
            samples[k].append(contestants[k].sample(ready[k][0]))
    except KeyboardInterrupt:
        interrupted = True
    return _results(title, contestants, names.index(baseline), ready, samples), interrupted


def _turns(count: int, rounds: int) -> Iterator[int]:
    """Yield the next contestant: each once a round; the first of a round moves on by one."""
    for r in range(rounds):
        yield from ((r + k) % count for k in range(count))


def _results(
    title: str,
    contestants: Sequence[Contestant],
    baseline: int,
    ready: Sequence[tuple[int, float]],
    samples: Sequence[Sequence[Sample]],
) -> list[Result]:
    """Summarise the complete rounds, or single samples if there is no complete round."""
    complete = min(map(len, samples))
    theirs = [s.rate for s in samples[baseline]]
    results = []
    for contestant, mine, (calls, first) in zip(contestants, samples, ready, strict=False):
        kept = mine[:complete] if complete else mine
        if kept:
            rates = tuple(s.rate for s in kept)
            ratios = quartiles([a / b for a, b in zip(rates, theirs, strict=False)]) if complete else None
            results.append(
                Result(
                    title, contestant.name, contestants[baseline].name, rates, quartiles(rates), ratios, first, calls,
                    _cores(kept), contestant.floor, contestant.note,
                )
            )  # fmt: skip
    return results


def _cores(samples: Sequence[Sample]) -> float | None:
    """Return CPU seconds per wall second, the median."""
    shares = [s.cpu_seconds / s.seconds for s in samples if s.cpu_seconds is not None]
    return statistics.median(shares) if shares else None


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the 25th, 50th and 75th percentile, interpolated linearly."""
    ordered = sorted(values)

    def at(q: float) -> float:
        place = q * (len(ordered) - 1)
        low = math.floor(place)
        return ordered[low] + (place - low) * (ordered[min(low + 1, len(ordered) - 1)] - ordered[low])

    return at(QUARTERS[0]), at(QUARTERS[1]), at(QUARTERS[2])


# --- one benchmark: its races, its table, its file ------------------------------------------------------------------


@dataclass
class Bench:
    """Races under one name, shown and written when its `with` block is left; Ctrl-C leaves it with exit code 130."""

    name: str
    quick: bool = False
    rounds: int | None = None
    out: str | None = None
    unit: str = "M agent-steps/s"
    scale: float = 1e6  # items/s per unit
    results: list[Result] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    extra: Numbers = field(default_factory=dict)  # what else belongs into the file

    def __post_init__(self) -> None:
        """Refuse a path that cannot be written before anything is measured."""
        self.plan = Plan.of(self.quick, self.rounds)
        self.path = _place(self.name, self.out)
        self.before = machine()

    def race(self, title: str, contestants: Sequence[Contestant], baseline: str) -> list[Result]:
        """Measure, show progress on stderr, keep the results and return them."""
        with _bar(title) as advance:
            results, interrupted = race(title, contestants, baseline, self.plan, advance)
        self.results += results
        if interrupted:
            raise KeyboardInterrupt
        return results

    def note(self, text: str) -> None:
        """Say something below the table and in the file."""
        self.notes.append(text)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Show and write what there is."""
        if error is not None and not isinstance(error, KeyboardInterrupt):
            self.extra["error"] = f"{type(error).__name__}: {error}"
        if self.results or self.notes:
            report(
                self.name, self.results, self.notes, unit=self.unit, scale=self.scale, out=self.path,
                before=self.before, interrupted=error is not None, extra={"plan": asdict(self.plan), **self.extra},
            )  # fmt: skip
        if isinstance(error, KeyboardInterrupt):
            print(f"{self.name}: interrupted", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None


def report(
    name: str,
    results: Sequence[Result],
    notes: Sequence[str] = (),
    *,
    unit: str = "M agent-steps/s",
    scale: float = 1e6,
    out: str | Path | None = None,
    before: Numbers | None = None,
    interrupted: bool = False,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Print the tables and notes, and write everything to `out`; return where.

    Args:
        name: of the benchmark, and of its file in results/benchmarks/.
        results: of any number of races.
        notes: sentences.
        unit: of the rates in the table; the file holds items/s.
        scale: how many items/s that unit is.
        out: another file; a string is checked as every --out is.
        before: `machine()` when the benchmark began.
        interrupted: whether it was cut short.
        extra: what else to write.
    """
    path = out if isinstance(out, Path) else _place(name, out)
    console = Console(width=None if sys.stdout.isatty() else 120)
    for title, group in groupby(results, key=lambda result: result.race):
        console.print(_table(title, list(group), unit, scale))
    for note in notes:
        console.print(f"* {note}", markup=False, highlight=False)
    after = machine()
    content = {
        "name": name,
        "interrupted": interrupted,
        "unit": "items/s",
        "shown_unit": unit,
        "shown_scale": scale,
        "machine": {**(before or after), "load_at_end": after["load"], "ended": after["date"]},
        "notes": list(notes),
        "results": [{**asdict(r), "rate": r.rate, "ratio": r.ratio} for r in results],
        **(extra or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as file:
        text = json.dumps(_rounded(content), indent=1, ensure_ascii=False, allow_nan=False)
        file.write(text.encode() + b"\n")
    console.print(f"{'interrupted; what was measured is' if interrupted else 'written'} in {path}", highlight=False)
    return path


def _rounded(content: Any) -> Any:
    """Return data with six significant digits of each float: more than a measurement has."""
    if isinstance(content, float):
        return float(f"{content:.6g}")
    if isinstance(content, dict):
        return {key: _rounded(each) for key, each in content.items()}
    return [_rounded(each) for each in content] if isinstance(content, (list, tuple)) else content


def _place(name: str, out: str | None) -> Path:
    """Return the path to write to; a bad one is a usage error."""
    try:
        return valid_file(out or str(FOLDER / f"{name}.json"), [".json"], force=True)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def _table(title: str, results: Sequence[Result], unit: str, scale: float) -> Table:
    """Return what a terminal shows of one race."""
    table = Table(title=escape(title), title_style="bold", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
    floors = any(r.floor for r in results)
    noted = any(r.note for r in results)
    table.add_column("contestant", no_wrap=True)
    for heading in (unit, "25-75 %", f"x {results[0].baseline}", *(["of its floor"] if floors else []), "cores"):
        table.add_column(escape(heading), justify="right")
    if noted:
        table.add_column("what it does", ratio=1)
    for r in results:
        low, _, high = (number(q / scale) for q in r.quartiles)
        cells = [r.name, number(r.rate / scale), f"{low}-{high}", _ratio(r)]
        cells += [number(r.rate / r.floor.rate) if r.floor else ""] * floors
        cells += ["" if r.cores is None else f"{r.cores:.2f}", *([r.note] if noted else [])]
        table.add_row(*map(escape, cells))
    return table


def _ratio(result: Result) -> str:
    """Return '1.84 (1.80-1.90)', or what there is of it."""
    if result.ratios is None or result.name == result.baseline:
        return "1" if result.name == result.baseline else "-"
    low, middle, high = map(number, result.ratios)
    return f"{middle} ({low}-{high})"


def number(value: float) -> str:
    """Return three significant digits, never as a power of ten where that can be avoided."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{digits}f}" if digits <= 6 else f"{value:.2e}"


@contextmanager
def _bar(title: str) -> Iterator[Advance]:
    """Show a bar on a terminal, a line a race anywhere else; drawn between samples only, never during one."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description:<50}"), BarColumn(30), TimeElapsedColumn())
    if not console.is_terminal:
        console.print(f"measuring {title}", markup=False, highlight=False)
    with Progress(
        *columns, console=console, transient=True, auto_refresh=False, disable=not console.is_terminal
    ) as progress:
        bar = progress.add_task(title)

        def advance(what: str, done: int, most: int) -> None:
            progress.update(bar, description=escape(what), completed=done, total=most, refresh=True)

        yield advance


# --- where it was measured ------------------------------------------------------------------------------------------


def machine() -> Numbers:
    """Return what is needed to judge the numbers: processor, cores, load, versions, commit, date."""
    return {
        "cpu": _cpu("model name") or platform.processor() or None,
        "simd": [flag for flag in ("sse4_2", "avx2", "fma", "avx512f") if flag in (_cpu("flags") or "").split()],
        "cores": os.cpu_count(),
        "cores_allowed": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,  # 1, 5, 15 minutes
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
        "variables": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "commit": _git("rev-parse", "HEAD"),
        "changed": None if (changes := _git("status", "--porcelain")) is None else bool(changes),
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
    }


def _cpu(key: str) -> str | None:
    """Return a line of /proc/cpuinfo, if there is one."""
    with suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8") as file:
        return next((line.split(":", 1)[1].strip() for line in file if line.split(":")[0].strip() == key), None)
    return None


def _version(package: str) -> str | None:
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def _git(*command: str) -> str | None:
    """Ask git about this checkout; None where there is no git or no commit."""
    try:
        answer = subprocess.run(["git", "-C", str(ROOT), *command], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
