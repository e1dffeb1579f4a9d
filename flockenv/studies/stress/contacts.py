"""Hard cases of soft contact: restitution of a spring over few steps, and bodies that begin inside others."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.core.warnings import CoarseContactWarning
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Contact, ObstacleContact
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.scene.stability import contact_limit
from flockenv.studies.stress.setup import TOO_LONG, collect_step_warnings, start_with
from flockenv.studies.trial_log import Case, Value

__all__ = ["CONTACTS", "DTS", "Hit", "hits"]

Floats = NDArray[np.float64]

STIFFNESS, MASS, RADIUS = 1.2e5, 80.0, 0.25  # Helbing, Farkas and Vicsek 2000
SPEED, PHASES = 1.0, 16  # m/s, of the hit; phases of the step at which it begins
DTS = (0.03, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # s
FAR = 50.0  # m, the place of the obstacle


def contact_scene(method: Integrator, dt: float, count: int = 2, most: float | None = None) -> Scene:
    """Return undamped bodies of 80 kg and a round obstacle: one set of laws for all cases of this file."""
    group = Group(count=count, mass=MASS, radius=RADIUS, spawn=Spawn(low=(0, 0), high=(1, 1)))
    effects = (
        Contact(stiffness=STIFFNESS, radius=2 * RADIUS, most=most), ObstacleContact(stiffness=STIFFNESS, most=most)
    )  # fmt: skip
    around = ({"centre": (FAR, 0.0), "radius": 1.0},)
    return Scene(groups=(group,), effects=effects, obstacles=around, integrator=method, dt=dt)


class Hit(NamedTuple):
    """Restitution of undamped hits in steps of one length."""

    dt: float  # s
    least: float  # restitution over the phases of the step; NaN if the scene was refused
    largest: float
    outcome: str  # "", "warned" (of a coarse contact), "refused" or "diverges"


def hits(method: Integrator, dt: float, wall: bool) -> Hit:
    """Return the restitution of a head-on hit of two bodies, or of one and a wall, at PHASES phases of the step."""
    with warnings.catch_warnings(record=True) as caught:
        for kind in TOO_LONG:
            warnings.simplefilter("always", kind)
        try:
            scene = contact_scene(method, dt)
            outcome = "warned" if any(issubclass(w.category, CoarseContactWarning) for w in caught) else ""
            found = _restitution(scene, dt, wall)
        except SimulationDiverged:
            return Hit(dt, math.nan, math.nan, "diverges")
        except ValueError:
            return Hit(dt, math.nan, math.nan, "refused")
    return Hit(dt, float(found.min()), float(found.max()), outcome)


def _restitution(scene: Scene, dt: float, wall: bool) -> Floats:
    """Return the speed after the hit over that before it, (PHASES,): a world for each phase."""
    gap = SPEED * dt * (np.arange(PHASES) + 0.5) / PHASES
    start = scene.start(0, worlds=PHASES)
    pos, vel = np.zeros((PHASES, 2, 2)), np.zeros((PHASES, 2, 2))
    if wall:
        pos[:, 0, 0], vel[:, 0, 0], pos[:, 1, 0] = FAR - 1 - RADIUS - gap, SPEED, -FAR
    else:
        pos[:, 1, 0], vel[:, 0, 0], vel[:, 1, 0] = 2 * RADIUS + gap, SPEED / 2, -SPEED / 2
    lasts = math.pi * math.sqrt(MASS / STIFFNESS)  # of a wall; a pair's is shorter
    end = scene.run(start.with_motion(pos, vel), math.ceil(2 * lasts / dt) + 3)
    return np.asarray((-end.vel[:, 0, 0] / SPEED) if wall else (end.vel[:, 1, 0] - end.vel[:, 0, 0]) / SPEED)


def restitution_trial(wall: bool) -> Callable[[Integrator], Value]:
    """Return the trial that a hit without a warning has a restitution of .95 to 1.05."""

    def trial(method: Integrator) -> Value:
        edge = 0.999 * contact_limit(method) / math.sqrt(2 * STIFFNESS / MASS)  # the longest step without a warning
        found = [hits(method, dt, wall) for dt in (*DTS, edge)]
        silent = [h for h in found if not h.outcome]
        off = max((max(abs(h.least - 1), abs(h.largest - 1)) for h in silent), default=0.0)
        note = ", ".join(
            f"{h.dt:.3g} s: " + (f"{h.least:.3f} to {h.largest:.3f}" if h.least == h.least else "")
            + (f" ({h.outcome})" if h.outcome else "") for h in found
        )  # fmt: skip
        return Value(off, off <= 0.05 and bool(silent), note)  # some step must give no warning

    return trial


MOST = 2.0  # m/s


def inside_each_other(method: Integrator) -> Value:
    """Start two bodies that overlap deeply, and 30 in a disc of twice their radius: no pair may part faster than MOST.

    A step is 1.5 ms; a contact of a pair lasts 38 steps.
    """
    dt, worst = 0.0015, 0.0
    with collect_step_warnings():  # explicit Euler is never stable without damping; here that is harmless
        pair, heap = contact_scene(method, dt, most=MOST), contact_scene(method, dt, count=30, most=MOST)
    state = start_with(pair, [(0.0, 0.0), (0.1, 0.0)], np.zeros((2, 2)))
    for _ in range(100):
        state = pair.run(state, 4)
        worst = max(worst, float(state.vel[0, 1, 0] - state.vel[0, 0, 0]))
    rng = np.random.default_rng(1)
    turn, out = rng.uniform(0, 2 * math.pi, 30), RADIUS * np.sqrt(rng.uniform(size=30))
    start = start_with(heap, np.stack([out * np.cos(turn), out * np.sin(turn)], axis=1), np.zeros((30, 2)))
    end, fastest = start, 0.0
    for _ in range(100):
        end = heap.run(end, 10)
        fastest = max(fastest, float(np.linalg.norm(end.vel, axis=2).max()))
    momentum, overlap = float(np.abs(end.vel[0].sum(axis=0)).max()), _deepest_overlap(end)
    holds = worst <= MOST * (1 + 1e-9) and momentum <= 1e-10 and overlap <= 1e-9
    note = f"pair {worst:.3f} m/s, heap {fastest:.3f} m/s, then overlap {overlap:.2g} m, momentum {momentum:.1g}"
    return Value(worst, holds, note)


def _deepest_overlap(state: State) -> float:
    """Return the deepest overlap of any two, m."""
    apart = np.linalg.norm(state.pos[0, :, None] - state.pos[0, None], axis=2) + 1e9 * np.eye(state.shape[1])
    return float(2 * RADIUS - apart.min())


CONTACTS = (
    Case(
        "N12 pair",
        "Helbing's contact of two, dt .03 to .0005 s",
        "e in .95 to 1.05, or warned",
        restitution_trial(False),
    ),
    Case("N12 wall", "the same against a wall", "e in .95 to 1.05, or warned", restitution_trial(True)),
    Case("P27", "begun inside each other, U = 2 m/s", "no pair parts faster; apart after 1.5 s", inside_each_other),
)
