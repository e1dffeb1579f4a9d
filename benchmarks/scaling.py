"""How rates, threads and memory scale: `python -m benchmarks.scaling`.

Boids at a constant density (15 neighbours each) from 100 to 1,000,000 agents in one world, and from 1 to 4096 worlds of
32 agents; one thread and two. All sizes of a series run in turns, so that ratios between sizes hold too. Memory is what
Scene.bytes_per_world says, beside how much a process grows that holds a million agents.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.floors import Machine, machine, of_scene
from benchmarks.measure import ROOT, Bench, Contestant, Out, Quick, Result, Rounds, command_line, number
from benchmarks.scenes import crowd, step_from_start, world
from flockenv.jit.thread_pool import use_threads
from flockenv.scene import Scene

__all__ = ["AGENTS", "WORLDS", "memory_growth"]

AGENTS = (100, 1_000, 10_000, 100_000, 1_000_000)
WORLDS = (1, 4, 16, 64, 256, 1024, 4096)
USUAL_AGENTS, USUAL_WORLDS = 10_000, 1024  # what the others are compared with
ENOUGH = 100_000  # agent-steps of a call at least, if 100 steps are that many: the call itself costs microseconds
MANY = 1_000_000  # agents whose memory is measured


def _steps(agents: int) -> int:
    return min(100, max(10, ENOUGH // agents))


def _contestant(threads: int, scene: Scene, worlds: int, name: str, most: Machine | None) -> Contestant:
    """Return a scene stepped by a number of threads."""
    agents = worlds * scene.agents
    steps, start = _steps(agents), scene.start(0, worlds=worlds)
    step = step_from_start(scene, start, steps)
    floor = most.floor(of_scene(scene, start, steps), threads) if most else None

    def call() -> None:
        use_threads(threads)
        step()

    return Contestant(f"{name}, {_threads(threads)}", call, agents * steps, floor)


def _threads(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _single_thread_size(name: str) -> str | None:
    """Return the size of a contestant on one thread."""
    return name.removesuffix(f", {_threads(1)}") if name.endswith(_threads(1)) else None


def _race_agents(bench: Bench, dtype: str, threads: Sequence[int], largest: int, most: Machine | None) -> None:
    """Race sizes of one world."""
    sizes = [n for n in AGENTS if n <= max(largest, USUAL_AGENTS)]
    contestants = [_contestant(t, crowd(n, dtype), 1, f"{n:,}", most) for n in sizes for t in threads]
    title = f"agents in one world, 15 neighbours each, 2-D, {dtype}"
    results = bench.race(title, contestants, baseline=f"{USUAL_AGENTS:,}, 1 thread")
    costs = [f"{size} {number(1 / r.ratio)}" for r in results if r.ratio and (size := _single_thread_size(r.name))]
    bench.note(f"{dtype}, 1 thread, cost per agent relative to {USUAL_AGENTS:,} agents: {'; '.join(costs)}.")
    _note_speed_ups(bench, results, "agents", dtype)


def _race_worlds(bench: Bench, dtype: str, threads: Sequence[int], most: Machine | None) -> None:
    """Race numbers of worlds."""
    contestants = [_contestant(t, world(dtype), b, f"{b:,}", most) for b in WORLDS for t in threads]
    results = bench.race(f"worlds of 32 agents, 2-D, {dtype}", contestants, baseline=f"{USUAL_WORLDS:,}, 1 thread")
    _note_speed_ups(bench, results, "worlds of 32", dtype)


def _note_speed_ups(bench: Bench, results: Sequence[Result], what: str, dtype: str) -> None:
    """Say what threads bring, from samples of the same round."""
    texts = [f"{name} {number(up)}" for name, up in _speed_ups(results)]
    if texts:
        bench.note(f"{dtype}, speed-up by the most threads, {what}: {'; '.join(texts)}.")


def _speed_ups(results: Sequence[Result]) -> Iterator[tuple[str, float]]:
    """Yield sizes, and the rate of the most threads over that of one."""
    by_size: dict[str, list[Result]] = {}
    for r in results:
        by_size.setdefault(r.name.rsplit(", ", 1)[0], []).append(r)
    for size, several in by_size.items():
        if len(several) > 1:
            pairs = zip(several[-1].rates, several[0].rates, strict=False)
            yield size, statistics.median(many / one for many, one in pairs)


# --- memory ---------------------------------------------------------------------------------------------------------


def memory_growth(dtype: str, agents: int = MANY) -> float:
    """Return by how many bytes per agent this process grows when it starts and steps a large world. Linux only."""
    small = crowd(1000, dtype)
    small.step(small.start(0))  # whatever compiles, compiles now
    scene = crowd(agents, dtype)
    before = _resident_bytes()
    state = scene.start(0)
    scene.step(state, out=state)
    return (_resident_bytes() - before) / agents


def _resident_bytes() -> int:
    """Return the bytes of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _note_memory(bench: Bench, dtype: str) -> None:
    """Say what an agent of a large world takes: counted beforehand, and measured in a process of its own."""
    predicted = crowd(MANY, dtype).bytes_per_world() / MANY
    code = f"from benchmarks.scaling import memory_growth; print(memory_growth({dtype!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    measured = float(done.stdout) if done.returncode == 0 else None
    bench.extra.setdefault("bytes_per_agent", {})[dtype] = {"bytes_per_world says": predicted, "measured": measured}
    beside = f"a process grows by {measured:.0f}" if measured is not None else "not measured on this system"
    bench.note(
        f"{dtype}, bytes per agent of one world of {MANY:,}: Scene.bytes_per_world says {predicted:.0f}; {beside}."
    )


def main(
    double: Annotated[bool, typer.Option("--double", help="Also in float64.")] = False,
    threads: Annotated[int, typer.Option(min=1, help="Largest number of threads; 1 is always measured.")] = 2,
    largest: Annotated[int, typer.Option(min=1, help="Largest number of agents in a world.")] = AGENTS[-1],
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure rates against the number of agents, worlds and threads, and memory per agent."""
    several = (1,) if threads == 1 else (1, threads)
    with Bench("scaling", quick, rounds, out) as bench:
        most = machine(bench, *several)
        for dtype in ("float32", "float64") if double else ("float32",):
            _race_agents(bench, dtype, several, largest, most)
            _race_worlds(bench, dtype, several, most)
            _note_memory(bench, dtype)
        bench.note(
            f"Every call begins in the same state and does 10 steps, up to 100 where those are below {ENOUGH:,} "
            "agent-steps. Two threads need two cores without other work: see the column `cores`."
        )


if __name__ == "__main__":
    command_line(main)()
