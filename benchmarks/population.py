"""A fountain of particles that are born and die: `python -m benchmarks.population`.

100,000 of them alive under gravity and drag, as many born as die, against the same motion of as many that live for
ever. Every call does ten steps of 1/60 s. What a step of a particle costs, and how many steps a second there are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from benchmarks.floors import Machine, machine, of_scene
from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line, number
from benchmarks.scenes import step_from_start
from flockenv.model.state import State
from flockenv.physics.effects import Drag, Gravity
from flockenv.physics.population import Decay, Disc, Emitter
from flockenv.scene import Group, Scene

__all__ = ["fountain", "settle"]

STEPS = 10
DT = 1 / 60
LIFETIME = 4.0  # s, on average


def fountain(alive: int, dtype: str, dimension: int, mortal: bool) -> Scene:
    """Return `alive` particles on average, born at a nozzle, that die after 3 to 5 s; or the same that never die."""
    up = (0.0,) * (dimension - 1)
    nozzle = Disc(centre=(0.0,) * dimension, radius=0.5)
    emitter = Emitter(place=nozzle, rate=alive / LIFETIME, speed=(15.0, 20.0), direction=(*up, 1.0), spread=15.0,
                      lifetime=(LIFETIME - 1.0, LIFETIME + 1.0))  # fmt: skip
    if not mortal:
        emitter = emitter.model_copy(update={"lifetime": None})
    return Scene(
        dimension=dimension, groups=(Group(count=alive + alive // 20 if mortal else alive, mass=0.01, radius=0.02),),
        effects=(Gravity(acceleration=(*up, -9.81)), Drag(rate=0.002)), dt=DT, dtype=dtype, population=(emitter,),
    )  # fmt: skip


def settle(scene: Scene) -> State:
    """Return a state in which as many are born as die."""
    return scene.run(scene.start(0), round((LIFETIME + 2.0) / DT))


def _contestants(alive: int, dtype: str, dimension: int, most: Machine | None) -> list[Contestant]:
    """Return the fountain, one whose particles decay besides, and the same motion without a population."""
    scene = fountain(alive, dtype, dimension, True)
    start = settle(scene)
    more = scene.model_copy(update={"population": (Decay(rate=1e-6), *scene.population)})
    plain = scene.model_copy(update={"population": (), "groups": (scene.groups[0].model_copy(update={
        "count": alive, "spawn": {"low": (0.0,) * dimension, "high": (1.0,) * dimension}}),)})  # fmt: skip
    living = int(start.alive.sum())
    note = f"{living:,} alive, {number(scene.population[0].rate)} born per s"
    floor = most.floor(of_scene(plain, plain.start(0), STEPS)) if most else None  # birth and death are not counted
    forever = step_from_start(plain, plain.start(0), STEPS)
    return [
        Contestant("no population", forever, alive * STEPS, floor, f"{alive:,} alive"),
        Contestant("fountain", _keep_stepping(scene, start), living * STEPS, floor, note),
        Contestant("fountain with decay", _keep_stepping(more, start), living * STEPS, floor, note),
    ]


def _keep_stepping(scene: Scene, start: State) -> Callable[[], object]:
    """Return a call that does STEPS steps and goes on where the last one ended: births and deaths stay in balance."""
    state = start.copy()
    return lambda: scene.step(state, out=state, steps=STEPS)


def main(
    alive: Annotated[int, typer.Option(min=1000, help="Number of living agents.")] = 100_000,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure particle-steps per second with births and deaths, and without."""
    with Bench("population", quick, rounds, out) as bench:
        most = machine(bench)
        for dimension in (2, 3):
            for dtype in ("float32", "float64"):
                pack = _contestants(alive, dtype, dimension, most)
                results = bench.race(f"{alive:,} particles, {dimension}-D, {dtype}", pack, baseline=pack[0].name)
                for result in results[1:]:
                    rate = result.rate
                    bench.note(
                        f"{dimension}-D {dtype}, {result.name}: {1e9 / rate:.3g} ns per particle-step, "
                        f"{rate / alive:,.0f} steps of {alive:,} per s, {rate / alive * DT:.3g} times as fast as time; "
                        f"{rate / alive / (result.cores or 1):,.0f} per s of processor time."
                    )
        bench.note("One thread unless FLOCKENV_THREADS says otherwise; ten steps per call.")


if __name__ == "__main__":
    command_line(main)()
