"""Problem: a scene from a start to an end, which any method can run in any number of steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flockenv.core.warnings import CoarseContactWarning, UnmetWarning, UnsolvedContactsWarning, UnstableStepWarning
from flockenv.model.state import State, blank
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import Effect
from flockenv.physics.integrators import RK4, Integrator
from flockenv.physics.population import Crowding, Decay
from flockenv.scene import Scene
from flockenv.scene.stability import suggest_dt
from flockenv.studies.accuracy.paths import Floats, Path, distances

__all__ = ["Exact", "Problem"]

Exact = Callable[[float], tuple[ArrayLike, ArrayLike]]
"""t, s -> positions (N, D) m and velocities (N, D) m/s, in closed form."""

INSTANTS = 16
"""Most instants at which a run is compared with its reference, evenly spaced, the last at the end."""


FINER = 64
"""Ratio of the finest measured step to the finest step of a reference by own steps."""

BY_DT = (UnstableStepWarning, CoarseContactWarning, UnsolvedContactsWarning, UnmetWarning)
"""Warnings about steps that are too long: a measurement takes such steps on purpose."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, its start, its duration, and the numbers of steps in which methods run it."""

    name: str  # unique in the suite
    title: str  # for pictures
    scene: Scene
    start: State  # one world, at time 0
    seconds: float  # duration, s
    steps: tuple[int, ...]  # ascending; time step = seconds / steps
    exact: Exact | None = None  # the exact path, if it is known

    @classmethod
    def of(
        cls,
        scene: Scene,
        seconds: float,
        steps: Sequence[Any],
        seed: int = 0,
        name: str = "scene",
        title: str = "",
        motion: tuple[ArrayLike, ArrayLike] | None = None,
        exact: Exact | None = None,
    ) -> Problem:
        """Return the problem of a scene from its start with a seed, or from positions and velocities, (N, D) each.

        seconds: duration, s; steps: numbers of steps, ascending; name: of the problem; title: for pictures; motion:
        positions, m, and velocities, m/s, at the start; exact: the exact path, if it is known.

        Raises ValueError if no method can be measured on it: invalid seconds or steps, float32 (rounding hides the
        errors of methods), random draws in every step (runs with different steps have no path in common), and laws
        that are maps of one step.
        """
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"seconds = {seconds!r}: must be a finite number of seconds > 0")
        wrong = [n for n in steps if not isinstance(n, int) or isinstance(n, bool) or n < 1]
        if wrong or not steps:
            raise ValueError(f"steps = {tuple(steps)}: must be integers >= 1, at least one")
        if scene.dtype != "float64":
            raise ValueError(f"dtype = {scene.dtype}: its rounding would hide what a method does; use float64")
        _refuse_draws(scene)
        start = scene.start(seed)
        if motion is not None:
            start = start.with_motion(*(np.asarray(array, float)[None] for array in motion))
        problem = cls(name, title, scene, start, float(seconds), tuple(sorted(set(steps))), exact)
        problem.prepare(RK4(), FINER * problem.steps[-1])
        return problem

    @property
    def times(self) -> Floats:
        """The instants, (K,) s: the most, up to INSTANTS, that divide every number of steps."""
        common = math.gcd(*self.steps)
        many = max(k for k in range(1, INSTANTS + 1) if common % k == 0)
        return self.seconds * np.arange(1, many + 1) / many

    @property
    def _moving_mass(self) -> Floats:
        """The masses of agents, (N,) kg; 0 for those held in place."""
        mass = self.scene.body.mass.astype(np.float64)
        return np.where(np.isfinite(mass), mass, 0.0)

    @property
    def after_steps(self) -> str:
        """What acts between steps, outside the integration method, in words; "" if nothing does."""
        scene, parts = self.scene, self.scene.parts
        found = [constraint.kind for constraint in scene.constraints]
        found += ["births and deaths"] if scene.population else []
        found += ["numbers inside agents"] if parts.inner else []
        found += ["springs that yield or break"] if parts.keeps_bonds else []
        found += ["headings that turn"] if parts.frame_rows else []
        return ", ".join(found)

    @property
    def with_impacts_in_order(self) -> Problem:
        """The same problem with impacts found in the order of time, if its own response converges to that."""
        constraints = tuple(
            each.model_copy(update={"response": "earliest"})
            if isinstance(each, Collisions) and each.response in ("back_up", "project")
            else each
            for each in self.scene.constraints
        )
        return replace(self, scene=self.scene.model_copy(update={"constraints": constraints}))

    def prepare(self, method: Integrator, steps: int) -> tuple[Scene, State]:
        """Return the scene with a method and the step of `steps` steps, and its start.

        Raises ValueError if the scene refuses such steps as unstable; warnings about long steps are ignored.
        """
        dt = self.seconds / steps
        with warnings.catch_warnings():
            for kind in BY_DT:
                warnings.simplefilter("ignore", kind)
            return self.scene.model_copy(update={"integrator": method, "dt": dt}), replace(self.start, dt=dt)

    def stability_divisor(self, method: Integrator, most: int) -> int:
        """Return the smallest power of 2 by which the finest steps must be divided for a method to be stable.

        Raises ValueError if that is more than `most`.
        """
        limit = suggest_dt(self.prepare(method, most * self.steps[-1])[0]).dt
        finest, times = self.seconds / self.steps[-1], 1
        while finest / times > limit:
            times *= 2
            if times > most:
                raise ValueError(
                    f"the finest steps given, {finest:.3g} s, are too long: {method.kind}, which finds "
                    f"the reference, is stable up to {limit:.3g} s in this scene"
                )
        return times

    def path(self, method: Integrator, steps: int, start: State | None = None) -> Path:
        """Run, and return the path of all agents at the instants; raise FloatingPointError if it diverges.

        method: a method; steps: their number; start: (default: that of the problem).
        """
        try:
            scene, state = self.prepare(method, steps)
        except ValueError as error:  # the steps are unstable
            raise FloatingPointError(str(error)) from None
        state = replace(start, dt=scene.dt) if start is not None else state
        before, each = state.work.sum(axis=0), steps // len(self.times)
        pos, vel, who = [], [], []
        with warnings.catch_warnings():
            for kind in BY_DT:
                warnings.simplefilter("ignore", kind)
            for _ in self.times:
                state = scene.step(state, steps=each)
                pos.append(state.pos[0])
                vel.append(state.vel[0])
                who.append(np.where(state.alive[0], state.identity[0], -1) if scene.population else None)
        return Path(
            np.array(pos), np.array(vel), np.array(who) if scene.population else None,
            state.work.sum(axis=0) - before,
        )  # fmt: skip

    def distances(self, path: Path, other: Path) -> Floats:
        """Return the distance of every agent between two paths, (K, N) m; see `paths.distances`.

        path, other: at the same instants.
        """
        return distances(path, other, self.scene.space.displacement)

    def energy(self, pos: Floats, vel: Floats) -> Floats:
        """Return kinetic energy plus the potential energies that effects have, at instants (K, N, D), (K,) J.

        pos: (K, N, D) m; vel: (K, N, D) m/s.
        """
        instants, agents, dimension = pos.shape  # a world for every instant
        state = blank(instants, agents, dimension, 0, self.start.dt).with_motion(pos, vel)
        total = self.kinetic(vel)
        for effect in self._potential_effects:
            potential = self._potential(effect, state)
            total = total if potential is None else total + potential
        return total

    def _potential(self, effect: Effect, state: State) -> Floats | None:
        return effect.potential(self.scene.groups, state, self.scene.space.displacement)

    def momentum(self, vel: Floats) -> Floats:
        """Return the total momentum, (..., D) kg m/s.

        vel: (..., N, D) m/s.
        """
        return np.asarray((self._moving_mass[:, None] * vel).sum(axis=-2))

    @property
    def _potential_effects(self) -> list[Effect]:
        """The effects with a potential energy; empty on a torus, where it jumps between images."""
        known = [] if self.scene.space.periodic else self.scene.effects
        return [effect for effect in known if self._potential(effect, self.start) is not None]

    def impulse(self, vel: Floats) -> Floats:
        """Return the sum of the magnitudes of all momenta, (...) kg m/s.

        vel: (..., N, D) m/s.
        """
        return np.asarray((self._moving_mass * np.linalg.norm(vel, axis=-1)).sum(axis=-1))

    def kinetic(self, vel: Floats) -> Floats:
        """Return the kinetic energy, (...) J.

        vel: (..., N, D) m/s.
        """
        return np.asarray(0.5 * (self._moving_mass * (vel**2).sum(axis=-1)).sum(axis=-1))

    @property
    def energies(self) -> str:
        """The energies that `energy` sums up, in words."""
        if self.scene.population:
            return "not compared: agents are born and die"
        kinds = [effect.kind for effect in self._potential_effects]
        return f"kinetic and potential ({', '.join(kinds)})" if kinds else "kinetic"

    @property
    def conserves_momentum(self) -> bool:
        """True if momentum is conserved up to errors: by all effects, and no wall, limit, birth or death changes it."""
        body = self.scene.body
        walled = any(isinstance(each, Collisions) and each.obstacles for each in self.scene.constraints)
        if self.scene.population or (walled and self.scene.obstacles):
            return False
        held = np.isinf(body.mass).any() or np.isfinite(body.max_speed).any()
        free = not held and self.scene.space.kind != "box"
        asks = any(effect.steering for effect in self.scene.effects)
        free = free and not (asks and np.isfinite(body.max_force).any())
        return free and all(effect.conserves_momentum for effect in self.scene.effects)


def _refuse_draws(scene: Scene) -> None:
    """Raise ValueError for random draws in every step: other step lengths draw other numbers."""
    for k, effect in enumerate(scene.effects):
        if any(each.kick_law is not None for each in (effect, *effect.components)):
            raise ValueError(
                f"effects[{k}] {effect.kind}: kicks at random, so there is no one path to come close to; only averages "
                "over many runs could be compared (weak error), which this does not measure"
            )
    for k, member in enumerate(scene.population):
        if isinstance(member, Decay) or (isinstance(member, Crowding) and member.rate is not None):
            raise ValueError(
                f"population[{k}] {member.kind}: agents die by draws of every step, so in steps of another length "
                "others die; only averages over many runs could be compared (weak error), which this does not measure"
            )
