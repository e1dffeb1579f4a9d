"""Problem: a scene with a start and an end, taken there by any method in any number of steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.effects import Effect
from flockenv.integrators import Integrator
from flockenv.scene import Scene
from flockenv.stability import UnstableStepWarning
from flockenv.state import State, blank

__all__ = ["Exact", "Floats", "Path", "Problem", "largest"]

Floats = NDArray[np.float64]
Exact = Callable[[float], tuple[ArrayLike, ArrayLike]]
"""t, s -> positions (N, D) m and velocities (N, D) m/s, in closed form."""

INSTANTS = 16
"""At most so many instants, equally apart and the last at the end, at which a run is compared with its reference."""


@dataclass(frozen=True, eq=False)
class Path:
    """Where a run was at some instants."""

    pos: Floats  # (K, N, D) m
    vel: Floats  # (K, N, D) m/s
    evaluations: int  # of the force


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, where it starts, for how long it runs, and in which numbers of steps methods are to take it there."""

    name: str
    title: str
    scene: Scene
    start: State  # one world, at time 0
    seconds: float
    steps: tuple[int, ...]  # ascending; time step = seconds / steps
    exact: Exact | None = None

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

        Raises ValueError, in one line, for what no method can be measured on: seconds or steps that lead nowhere,
        float32 (its rounding hides what a method does) and random kicks (no step is small enough for two runs to meet).
        """
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"seconds = {seconds!r}: must be a finite number of seconds > 0")
        wrong = [n for n in steps if not isinstance(n, int) or isinstance(n, bool) or n < 1]
        if wrong or not steps:
            raise ValueError(f"steps = {tuple(steps)}: must be whole numbers of at least 1, and one at least")
        if scene.dtype != "float64":
            raise ValueError(f"dtype = {scene.dtype}: its rounding would hide what a method does; use float64")
        for k, effect in enumerate(scene.effects):
            if effect.kick_law is not None:
                raise ValueError(
                    f"effects[{k}] {effect.kind}: kicks at random, so there is no one path to come close to"
                )
        start = scene.start(seed)
        if motion is not None:
            start = start.with_motion(*(np.asarray(array, float)[None] for array in motion))
        return cls(name, title, scene, start, float(seconds), tuple(sorted(set(steps))), exact)

    @property
    def times(self) -> Floats:
        """The instants, (K,) s: as many as every number of steps can be divided into."""
        common = math.gcd(*self.steps)
        many = max(k for k in range(1, INSTANTS + 1) if common % k == 0)
        return self.seconds * np.arange(1, many + 1) / many

    @property
    def _moving(self) -> Floats:
        """The masses of those who are not held in place, (N,) kg; 0 for them."""
        mass = self.scene.body.mass.astype(np.float64)
        return np.where(np.isfinite(mass), mass, 0.0)

    def ready(self, method: Integrator, steps: int) -> tuple[Scene, State]:
        """Return the scene advanced by a method in so many steps, and its start.

        Raises ValueError where the scene refuses such steps because they blow up; of less it does not warn.
        """
        dt = self.seconds / steps
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnstableStepWarning)
            return self.scene.model_copy(update={"integrator": method, "dt": dt}), replace(self.start, dt=dt)

    def path(self, method: Integrator, steps: int, start: State | None = None) -> Path:
        """Run, and return where everybody was at the instants; raises FloatingPointError where it diverges."""
        try:
            scene, state = self.ready(method, steps)
        except ValueError as error:  # it would
            raise FloatingPointError(str(error)) from None
        state = replace(start, dt=scene.dt) if start is not None else state
        before, each = state.counted("evaluations"), steps // len(self.times)
        pos, vel = [], []
        for _ in self.times:
            state = scene.step(state, steps=each)
            pos.append(state.pos[0])
            vel.append(state.vel[0])
        return Path(np.array(pos), np.array(vel), state.counted("evaluations") - before)

    def apart(self, pos: Floats, other: Floats) -> Floats:
        """Return how far everybody is from where another path has him, (..., N) m, the shortest way."""
        return np.asarray(np.linalg.norm(self.scene.space.displacement(pos, other), axis=-1))

    def energy(self, pos: Floats, vel: Floats) -> Floats:
        """Return kinetic energy, and what potential energy the effects know of, at instants (K, N, D), (K,) J."""
        instants, agents, dimension = pos.shape  # a world for every instant
        state = blank(instants, agents, dimension, 0, self.start.dt).with_motion(pos, vel)
        total = self.kinetic(vel)
        for effect in self._with_potential:
            potential = self._potential(effect, state)
            total = total if potential is None else total + potential
        return total

    def _potential(self, effect: Effect, state: State) -> Floats | None:
        return effect.potential(self.scene.groups, state, self.scene.space.displacement)

    def momentum(self, vel: Floats) -> Floats:
        """Return the total momentum, (..., D) kg m/s."""
        return np.asarray((self._moving[:, None] * vel).sum(axis=-2))

    @property
    def _with_potential(self) -> list[Effect]:
        """The effects that know their potential energy; none on a torus, where it jumps from image to image."""
        known = [] if self.scene.space.periodic else self.scene.effects
        return [effect for effect in known if self._potential(effect, self.start) is not None]

    def impulse(self, vel: Floats) -> Floats:
        """Return the sum of the sizes of all momenta, (...) kg m/s."""
        return np.asarray((self._moving * np.linalg.norm(vel, axis=-1)).sum(axis=-1))

    def kinetic(self, vel: Floats) -> Floats:
        """Return the kinetic energy, (...) J."""
        return np.asarray(0.5 * (self._moving * (vel**2).sum(axis=-1)).sum(axis=-1))

    @property
    def energies(self) -> str:
        """What `energy` sums up, in words."""
        kinds = [effect.kind for effect in self._with_potential]
        return f"kinetic and potential ({', '.join(kinds)})" if kinds else "kinetic"

    @property
    def conserves_momentum(self) -> bool:
        """Is momentum kept, but for errors: do all effects keep it, and neither a wall nor a limit takes it?"""
        body = self.scene.body
        held = np.isinf(body.mass).any() or np.isfinite(body.max_speed).any()
        free = not held and self.scene.space.kind != "box"
        asks = any(effect.steering for effect in self.scene.effects)
        free = free and not (asks and np.isfinite(body.max_force).any())
        return free and all(effect.conserves_momentum for effect in self.scene.effects)


def largest(values: Floats) -> float:
    """Return the largest of some numbers; NaN if one is NaN."""
    return float(np.max(values)) if np.size(values) else math.nan
