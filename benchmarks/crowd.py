"""Crowds of 1,000 under each published social force, and beside JuPedSim: `python -m benchmarks.crowd`.

A person per square metre, half of them walking either way on a torus, so that a crowd stays as dense as it was. Then a
minute of a crowd's time at dt = 0.01 s, on one thread and on two. JuPedSim's social force model runs in turns with ours
if it is installed (`python -m benchmarks.peers --install jupedsim`), each in a process of its own.
"""

from __future__ import annotations

import math
import sys
import warnings
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from benchmarks.floors import Machine, machine, of_scene
from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line, number
from benchmarks.peers import CACHE, DONE, SAMPLE, PeerError, python_of, start_script
from benchmarks.scenes import step_from_start
from flockenv.geometry.space import Torus
from flockenv.jit.thread_pool import use_threads
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Course
from flockenv.scene import Group, Scene
from flockenv.scene.presets import PRESETS, preset

__all__ = ["crowd"]

PEOPLE, SECONDS, DT = 1000, 60.0, 0.01


def crowd(name: str, people: int = PEOPLE, dtype: str = "float64") -> Scene:
    """Return two streams of a published model on a torus, a person per square metre."""
    edge = math.sqrt(people)
    group = Group(
        count=people // 2, mass=80.0, radius=0.25, desired_speed=1.3, haste=1.3,
        spawn=Spawn(low=(0.0, 0.0), high=(edge, edge), spacing=0.9, jitter=0.1),
    )  # fmt: skip
    ways = (Course(direction=(1, 0), group=0), Course(direction=(-1, 0), group=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # contacts of 2000 last for 6 steps
        effects = (*ways, *preset(name))
        return Scene(space=Torus(size=(edge, edge)), groups=(group, group), effects=effects, dt=DT, dtype=dtype)


def _race_models(bench: Bench, dtype: str, most: Machine | None) -> None:
    """Race all models, as they are after a second."""
    contestants = []
    for name in PRESETS:
        try:
            scene = crowd(name, dtype=dtype)
        except ValueError as error:  # a reach too large for the torus
            bench.note(f"{name} is not raced: {error}")
            continue
        start = scene.run(scene.start(0), 100)
        pairs = scene.step(start).count_of("pairs") - start.count_of("pairs")
        note = f"each looks at {number(pairs / PEOPLE)} others"
        floor = most.floor(of_scene(scene, start)) if most else None
        contestants.append(Contestant(name, step_from_start(scene, start, 1), PEOPLE, floor, note))
    bench.race(f"{PEOPLE:,} people, {dtype}", contestants, baseline="helbing_farkas_vicsek_2000")


def _time_a_minute(bench: Bench, name: str) -> None:
    """Say how long a minute of a crowd's time takes, a second a call."""
    scene, times = crowd(name), []
    start = scene.run(scene.start(0), 100)
    for threads in (1, 2):
        use_threads(threads)
        state, began = start, perf_counter()
        for _ in range(round(SECONDS)):
            state = scene.run(state, round(1 / DT))
        times.append(f"{perf_counter() - began:.1f} s on {threads} thread{'s' * (threads > 1)}")
    use_threads(1)
    bench.note(f"{PEOPLE:,} people for {SECONDS:g} s at dt = {DT:g} s, {name}: {', '.join(times)}.")


def _race_jupedsim(bench: Bench, cache: Path, most: Machine | None) -> None:
    """Race a corridor of 1,000 people under the model of 2000, turn by turn."""
    python = python_of(cache / "jupedsim")
    if not (cache / "jupedsim" / DONE).is_file() or not python.exists():
        bench.note("JuPedSim is not installed: python -m benchmarks.peers --install jupedsim")
        return
    try:
        with (
            start_script("jupedsim", python, "run_jupedsim.py", "crowd", 1, SAMPLE) as theirs,
            start_script("flockenv", Path(sys.executable), "run_ours.py", "crowd_1000", 1, SAMPLE, None, most) as ours,
        ):
            results = bench.race("corridor, 1,000 people, 2000", [theirs, ours], baseline="jupedsim")
        if results[1].ratio:
            bench.note(f"flockenv's rate over JuPedSim's, one thread each: {number(results[1].ratio)}.")
    except PeerError as error:
        bench.note(str(error))


def main(
    single: Annotated[bool, typer.Option("--single", help="Also in float32.")] = False,
    minute: Annotated[bool, typer.Option(help="Also simulate a minute.")] = True,
    models: Annotated[bool, typer.Option(help="Compare all models.")] = True,
    cache: Annotated[Path, typer.Option(help="Folder of the virtual environments of peers.")] = CACHE,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure crowds."""
    with Bench("crowd", quick, rounds, out) as bench:
        most = machine(bench)
        _race_jupedsim(bench, cache.expanduser(), most)
        if minute:
            for name in ("helbing_farkas_vicsek_2000", "helbing_molnar_1995"):
                _time_a_minute(bench, name)
        for dtype in ("float64", "float32") if single else ("float64",):
            if models:
                _race_models(bench, dtype, most)


if __name__ == "__main__":
    command_line(main)()
