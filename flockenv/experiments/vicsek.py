"""Order against noise in Vicsek's flock: the curve of 1995, beside its bound and an independent run.

configs/vicsek.yaml under more and more noise: the order v_a is the length of the mean heading, over time and worlds
after the flock has settled. Its transition sharpens with the number of agents; at no size is it above
sin(eta/2) / (eta/2), what errors alone leave of directions that agree, by more than what chance leaves of none.
Whether positions move with the new velocity (semi_implicit_euler) or, as the paper writes it, with the old one
(explicit_euler), makes a difference near the transition, though a step is .03 of the reach.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from flockenv.effects import Vicsek
from flockenv.experiments.base import Experiment, Trial
from flockenv.integrators import ExplicitEuler, Integrator, SemiImplicitEuler
from flockenv.measures import polarisation
from flockenv.scene import Group, Scene
from flockenv.space import Torus
from flockenv.spawn import Spawn

__all__ = ["EXPERIMENT", "bound", "order", "scene_of"]

WORLDS, SEED, SETTLE, STEPS, EVERY = 4, 0, 3000, 4000, 10
SPEED, DENSITY = 0.03, 4.0
"""m/s, of all; agents per m^2. Vicsek's text says .4, but his sizes (N = 400, L = 10) are 4."""

NOISES = {f"{x:.3g}": x for x in (0.1, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 2 * math.pi)}
KINDS: dict[str, tuple[int, Integrator]] = {
    "100": (100, SemiImplicitEuler()), "400": (400, SemiImplicitEuler()), "400, old velocity": (400, ExplicitEuler()),
}  # fmt: skip
"""How many, and with which velocity they move."""

SEEN = {0.1: 0.9994, 1.0: 0.945, 2.0: 0.779, 4.0: 0.199, 2 * math.pi: 0.044}
"""v_a of an independent run of 400 at this density, moved with the new velocity."""


def scene_of(noise: float, count: int = 400, method: Integrator = KINDS["400"][1]) -> Scene:
    """Return Vicsek's flock of so many at his density, under some noise, rad."""
    edge = math.sqrt(count / DENSITY)
    group = Group(count=count, radius=0.05, spawn=Spawn(speed=(SPEED, SPEED)))
    return Scene(
        space=Torus(size=(edge, edge)), groups=(group,), effects=(Vicsek(speed=SPEED, radius=1.0, noise=noise),),
        integrator=method, dt=1.0,
    )  # fmt: skip


def bound(noise: float, count: int) -> float:
    """Return what order cannot exceed: of directions that agree but for errors, and of none, by chance."""
    return math.sin(noise / 2) / (noise / 2) + math.sqrt(math.pi) / (2 * math.sqrt(count))


def order(scene: Scene, settle: int, steps: int, worlds: int = WORLDS, seed: int = SEED) -> np.ndarray:
    """Return v_a of worlds that settled for so many steps, at every tenth of the next, (steps / 10, worlds)."""
    state = scene.run(scene.start(seed, worlds=worlds), settle)
    found = np.empty((steps // EVERY, worlds))
    for k in range(len(found)):
        state = scene.run(state, EVERY)
        found[k] = [polarisation(np.asarray(state.vel[b], np.float64)) for b in range(worlds)]
    return found


def trial(case: str, variant: str) -> Trial:
    """Measure the order under one noise."""
    noise, (count, method) = NOISES[case], KINDS[variant]
    scene = scene_of(noise, count, method)
    found = order(scene, SETTLE, STEPS)
    numbers = {
        "order": float(found.mean()), "deviation": float(found.std()), "bound": bound(noise, count),
        "seen elsewhere": SEEN.get(noise, math.nan) if variant == "400" else math.nan,
    }  # fmt: skip
    return Trial(numbers, scene, np.zeros((0, count, 2)))


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    title="Vicsek's flock: order against noise",
    cases={name: f"errors of up to {x / 2:.3g} rad to either side" for name, x in NOISES.items()},
    variants=tuple(KINDS),
    columns={
        "order": "v_a, the length of the mean heading, mean over time and 4 worlds",
        "deviation": "its standard deviation over time and worlds",
        "bound": "what it cannot exceed",
        "seen elsewhere": "v_a of an independent run of 400",
    },
    shown=("order",),
    trial=trial,
    curve=("noise η, rad", "order v_a"),
)
