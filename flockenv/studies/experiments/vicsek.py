"""Order over noise in Vicsek's flock: the curve of 1995, with its bound and an independent run.

configs/scenes/vicsek.yaml under more and more noise: the order v_a is the length of the mean heading, over time and
worlds after the flock has settled. Its transition sharpens with the number of agents. At no size does v_a exceed
sin(eta/2) / (eta/2), the order of equal directions with angular noise, by more than the order of N random directions.
Whether positions move with the new velocity (semi_implicit_euler) or, as in the paper, with the old one
(explicit_euler), makes a difference near the transition, though a step is only .03 of the radius.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from flockenv.core.record import Record
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Vicsek
from flockenv.physics.integrators import Integrator, SemiImplicitEuler
from flockenv.scene import AnyIntegrator, Group, Scene
from flockenv.studies.experiments.experiment import Experiment, Trial
from flockenv.studies.experiments.plan import Plan
from flockenv.studies.measures import polarisation

__all__ = ["SEEN", "Flock", "NoisePlan", "bound", "order", "scene_of"]

EVERY = 10
"""Steps between two measurements of the order."""

SPEED, DENSITY = 0.03, 4.0
"""m/s, of all agents; agents per m^2. Vicsek et al. write .4, but their sizes (N = 400, L = 10) give 4."""

SEEN = {0.1: 0.9994, 1.0: 0.945, 2.0: 0.779, 4.0: 0.199, 6.28: 0.044}
"""v_a by eta, of an independent run of 400 agents at this density, moved with the new velocity."""


def scene_of(noise: float, count: int = 400, method: Integrator | None = None) -> Scene:
    """Return Vicsek's flock of `count` agents at density DENSITY, under some noise, rad."""
    edge = math.sqrt(count / DENSITY)
    group = Group(count=count, radius=0.05, spawn=Spawn(speed=(SPEED, SPEED)))
    return Scene(
        space=Torus(size=(edge, edge)), groups=(group,), effects=(Vicsek(speed=SPEED, radius=1.0, noise=noise),),
        integrator=method or SemiImplicitEuler(), dt=1.0,
    )  # fmt: skip


def bound(noise: float, count: int) -> float:
    """Return the bound of the order: that of equal directions with noise, plus that of random directions."""
    return math.sin(noise / 2) / (noise / 2) + math.sqrt(math.pi) / (2 * math.sqrt(count))


def order(scene: Scene, settle: int, steps: int, worlds: int = 4, seed: int = 0) -> np.ndarray:
    """Return v_a after `settle` steps, at every tenth of the next `steps`, (steps / 10, worlds)."""
    state = scene.run(scene.start(seed, worlds=worlds), settle)
    found = np.empty((steps // EVERY, worlds))
    for k in range(len(found)):
        state = scene.run(state, EVERY)
        found[k] = [polarisation(np.asarray(state.vel[b], np.float64)) for b in range(worlds)]
    return found


class Flock(Record):
    """A variant of the experiment: the number of agents, and the integrator."""

    count: int = Field(ge=2, description="N, at Vicsek's density")
    integrator: AnyIntegrator = Field(
        default_factory=SemiImplicitEuler, description="semi_implicit_euler moves with the new velocity"
    )


class NoisePlan(Plan):
    """Flocks under increasing noise."""

    measure: Literal["vicsek"] = Field(description="the order of Vicsek's flock")
    settle: int = Field(ge=0, description="steps before the order is measured")
    steps: int = Field(ge=EVERY, description="steps over which it is measured")
    noises: tuple[Annotated[float, Field(gt=0, lt=6.3)], ...] = Field(min_length=1, description="eta, rad")
    variants: dict[str, Flock] = Field(min_length=1)

    def experiment(self) -> Experiment:
        """Return the experiment."""
        return Experiment(
            name=self.measure, title=self.title,
            cases={f"{x:.3g}": f"errors of up to {x / 2:.3g} rad to either side" for x in self.noises},
            variants=tuple(self.variants),
            columns={
                "order": f"v_a, the length of the mean heading, mean over time and {self.worlds} worlds",
                "deviation": "its standard deviation over time and worlds",
                "bound": "what it cannot exceed",
                "seen elsewhere": "v_a of an independent run of 400",
            },
            shown=("order",), trial=self._trial, curve=("noise η, rad", "order v_a"),
        )  # fmt: skip

    def _trial(self, case: str, variant: str) -> Trial:
        """Measure the order under one noise."""
        noise = next(x for x in self.noises if f"{x:.3g}" == case)
        flock = self.variants[variant]
        scene = scene_of(noise, flock.count, flock.integrator)
        found = order(scene, self.settle, self.steps, self.worlds, self.seed)
        known = flock.count == 400 and flock.integrator == SemiImplicitEuler()
        numbers = {
            "order": float(found.mean()), "deviation": float(found.std()), "bound": bound(noise, flock.count),
            "seen elsewhere": SEEN.get(round(noise, 2), math.nan) if known else math.nan,
        }  # fmt: skip
        return Trial(numbers, scene, np.zeros((0, flock.count, 2)))
