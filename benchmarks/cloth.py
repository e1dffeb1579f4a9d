"""What a frame of cloth costs, by the stiffness of its springs: `python -m benchmarks.cloth`.

A sheet held at two corners, in frames of 1/60 s: one step of a method that is stable at any step for springs, or as
many steps of semi-implicit Euler as are stable. Every call makes the same frames from the same beginning.
"""

from __future__ import annotations

import math
from typing import Annotated

import typer

from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line
from benchmarks.scenes import step_from_start
from flockenv.model.networks import Cloth
from flockenv.physics.effects import Drag, Gravity, Springs
from flockenv.physics.integrators import ImplicitEuler, Integrator, LinearlyImplicitEuler, SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt

__all__ = ["sheet"]

FRAME = 1 / 60  # s
FRAMES = 4
MASS = 0.2  # kg/m^2
LONGEST = 5_000
"""Largest number of steps in a frame for which the explicit method is measured."""
LARGEST = 500
"""Largest number of particles for which Newton's method is measured."""


def sheet(cells: int, stiffness: float, method: Integrator, dt: float = FRAME) -> Scene:
    """Return a square sheet of 5 m, of cells x cells, held at two corners, as in configs/scenes/cloth.yaml."""
    cloth = Cloth(cells=(cells, cells), edges=((5, 0, 0), (0, -3, 4)), pinned=("bottom_left", "top_right"))
    effects = (
        Gravity(acceleration=(0, -7.848, -5.886)),
        Springs(stiffness=stiffness, shear=stiffness / 4, bend=stiffness / 4000, ratio=0.02),
        Drag(rate=0.005),
    )
    group = Group(network=cloth, mass=MASS * 25 / cloth.size, radius=0.01)
    return Scene(dimension=3, groups=(group,), effects=effects, integrator=method, dt=dt)


def substeps(cells: int, stiffness: float) -> int:
    """Return the number of steps of semi-implicit Euler in a frame that are stable."""
    short = sheet(cells, stiffness, SemiImplicitEuler(), 1e-9)
    return math.ceil(FRAME / suggest_dt(short).dt)


def main(
    cells: Annotated[int, typer.Option(min=1, help="Cells along each side; 50: 2,601 particles.")] = 12,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure frames per second for springs of 1e2 to 1e8 N/m, as ratios to the linearly implicit method."""
    with Bench("cloth", quick, rounds, out, unit="frames per second", scale=1.0) as bench:
        for stiffness in (1e2, 1e4, 1e6, 1e8):
            explicit, contestants = substeps(cells, stiffness), []
            methods: dict[str, tuple[Integrator, int]] = {"linear": (LinearlyImplicitEuler(), 1)}
            if explicit <= LONGEST:
                methods["explicit"] = (SemiImplicitEuler(), explicit)
            if (cells + 1) ** 2 <= LARGEST:
                methods["Newton"] = (ImplicitEuler(), 1)
            for name, (method, steps) in methods.items():
                scene = sheet(cells, stiffness, method, FRAME / steps)
                call = step_from_start(scene, scene.start(0), FRAMES * steps)
                contestants.append(Contestant(name, call, FRAMES, note=f"{method.kind}, {steps} steps a frame"))
            bench.race(f"k = {stiffness:g} N/m, {(cells + 1) ** 2:,} particles", contestants, baseline="linear")
        bench.note(f"frames of {FRAME:.4g} s, the first {FRAMES} after the release, float64, one thread")


if __name__ == "__main__":
    command_line(main)()
