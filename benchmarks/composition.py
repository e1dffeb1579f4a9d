"""What composing costs, and what is not listed costs: `python -m benchmarks.composition`.

Rules alone and together in one scene; three rules in one sweep beside three scenes of a rule each; a generated kernel
beside one written by hand for the same mix (by_hand.py), after both were found to go to the same places; and a scene
beside itself in a process where one more effect was defined: the same bits, the same work, the same time.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer

from benchmarks.by_hand import MIXES, by_hand
from benchmarks.floors import Machine, machine, of_scene
from benchmarks.measure import Bench, Contestant, Floor, Out, Quick, Result, Rounds, command_line, number
from benchmarks.peers import PeerError, start_script
from benchmarks.scenes import WORLD_RADII, crowd, restart_each_call, rules, step_from_start, world
from flockenv.jit.thread_pool import use_threads
from flockenv.model.state import State
from flockenv.scene import Scene

__all__ = ["mix_scene"]

WORLDS, STEPS, CROWD = 1024, 10, 10_000
NAMES = ("separation", "alignment", "cohesion")
FOV = 270.0  # degrees
CLOSE = {"float64": 1e-9, "float32": 1e-2}  # m, all agents, after STEPS steps; in float32 a neighbour may be lost
SAMPLE, QUICK_SAMPLE = 0.1, 0.05  # s, of a process beside this one


def _mixes(effects: Sequence[Any]) -> dict[str, tuple[Any, ...]]:
    """Return what is raced, by name."""
    a, b, c = effects
    return {
        "no effect": (), "separation": (a,), "alignment": (b,), "cohesion": (c,),
        "separation + alignment": (a, b), "all three": (a, b, c),
    }  # fmt: skip


def _race_rules(bench: Bench, title: str, scene: Scene, worlds: int, most: Machine | None) -> None:
    """Race rules alone, together, and in sweeps of their own."""
    start = scene.start(0, worlds=worlds)
    work = worlds * scene.agents * STEPS
    contestants = []
    for name, effects in _mixes(scene.effects).items():
        mix = scene.with_effects(*effects)
        contestants.append(Contestant(name, step_from_start(mix, start, STEPS), work, _floor(mix, start, most)))
    alone = [step_from_start(scene.with_effects(effect), start, STEPS) for effect in scene.effects]

    def apart() -> None:
        for step in alone:
            step()

    contestants.append(Contestant("three scenes of one each", apart, work))
    results = bench.race(title, contestants, baseline="all three")
    _note_costs(bench, results)


def _floor(scene: Scene, start: State, most: Machine | None) -> Floor | None:
    return most.floor(of_scene(scene, start, STEPS)) if most else None


def _note_costs(bench: Bench, results: Sequence[Result]) -> None:
    """Say what rules cost alone and together, less what a scene without any costs; ratios are of the same rounds."""
    rounds = min((len(r.rates) for r in results), default=0)
    if len(results) < len(_mixes(("", "", ""))) or not rounds:
        return
    cost = {r.name: [1e9 / rate for rate in r.rates] for r in results}
    beyond = {name: [a - b for a, b in zip(cost[name], cost["no effect"], strict=False)] for name in cost}
    saved = [sum(beyond[name][k] for name in NAMES) / beyond["all three"][k] for k in range(rounds)]
    alone = [sum(cost[name][k] for name in NAMES) / len(NAMES) for k in range(rounds)]
    times = statistics.median(cost["all three"][k] / alone[k] for k in range(rounds))
    costs = ", ".join(f"{name} {number(statistics.median(beyond[name]))}" for name in (*NAMES, "all three"))
    bench.note(
        f"{results[0].race}: without effects {number(statistics.median(cost['no effect']))} ns per agent and step; "
        f"beyond that {costs}. One by one they cost {number(statistics.median(saved))} times what they cost together. "
        f"With all it costs {number(times)} times what a scene of one rule does (the mean of the three)."
    )


# --- by hand --------------------------------------------------------------------------------------------------------


def mix_scene(mix: str, dtype: str) -> Scene:
    """Return the scene that by_hand has a kernel for."""
    a, b, c = rules(WORLD_RADII[2], FOV if mix == "seeing" else 360.0)
    return world(dtype).with_effects(*((a, c) if mix == "two" else (a, b, c)))


def _race_by_hand(bench: Bench, mix: str, dtype: str, most: Machine | None) -> bool:
    """Race a generated kernel against the one by hand; False where they do not do the same."""
    scene = mix_scene(mix, dtype)
    start = scene.start(0, worlds=WORLDS)
    mine, theirs = start.copy(), start.copy()
    step = by_hand(mix, scene, theirs, STEPS)
    scene.step(mine, out=mine, steps=STEPS)
    step()
    apart = float(np.abs(scene.space.displacement(mine.pos, theirs.pos)).max())
    title = f"{', '.join(type(e).__name__ for e in scene.effects)}{', 270 degrees' * (mix == 'seeing')}, {dtype}"
    same_pairs = mine.count_of("pairs") == theirs.count_of("pairs")
    if apart > CLOSE[dtype] or not same_pairs:
        bench.note(
            f"{title}: NOT RACED. After {STEPS} steps both are {number(apart)} m apart; same pairs: {same_pairs}"
        )
        return False
    bench.extra.setdefault("by_hand_apart_m", {})[title] = apart
    work, floor = WORLDS * scene.agents * STEPS, _floor(scene, start, most)
    contestants = [
        Contestant("by hand", restart_each_call(start, theirs, step), work, floor),
        Contestant("generated", step_from_start(scene, start, STEPS), work, floor),
    ]
    bench.race(title, contestants, baseline="by hand")
    return True


def _note_hand_ratios(bench: Bench) -> None:
    ratios = [f"{r.race} {number(r.ratio)}" for r in bench.results if r.name == "generated" and r.ratio]
    if ratios:
        bench.note(f"generated over by hand: {'; '.join(ratios)}.")


# --- what is not listed ---------------------------------------------------------------------------------------------


def _race_unlisted(bench: Bench) -> bool:
    """Race a scene against itself where one more effect exists; False if bits or work differ."""
    seconds = QUICK_SAMPLE if bench.quick else SAMPLE
    python = Path(sys.executable)
    try:
        with (
            start_script("as it is", python, "run_unlisted.py", "plain", 1, seconds) as plain,
            start_script("one more defined", python, "run_unlisted.py", "another", 1, seconds) as another,
        ):
            bench.race("an effect that is listed nowhere, 1024 x 32, float32", [plain, another], baseline=plain.name)
            same = plain.note == another.note
    except PeerError as error:
        bench.note(str(error))
        return False
    bench.note(f"with an effect defined that is listed nowhere, bits and work are {'the same' if same else 'OTHERS'}.")
    return same


def main(quick: Quick = False, rounds: Rounds = None, out: Out = None) -> None:
    """Measure composed scenes beside single rules, beside kernels by hand, and beside an effect never asked for."""
    use_threads(1)
    with Bench("composition", quick, rounds, out) as bench:
        most = machine(bench)
        _race_rules(bench, f"rules, {WORLDS} worlds x 32, float32", world("float32"), WORLDS, most)
        _race_rules(bench, f"rules, one world of {CROWD:,}, float32", crowd(CROWD, "float32"), 1, most)
        same = [_race_by_hand(bench, mix, dtype, most) for dtype in ("float32", "float64") for mix in MIXES]
        _note_hand_ratios(bench)
        same.append(_race_unlisted(bench))
        bench.note(f"One thread, 2-D torus; every call begins in the same state and does {STEPS} steps.")
    if not all(same):
        raise typer.Exit(1)


if __name__ == "__main__":
    command_line(main)()
