"""What a scene computes, for whom, at what cost, and what it does not compute because nobody asked for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from flockenv.effects import EFFECTS, Effect
from flockenv.grants import Grants
from flockenv.scene import Scene
from flockenv.stability import Suggestion, suggest_dt
from flockenv.state import WORK, State

__all__ = ["Explanation", "Row", "explain"]

ROUNDS = 7
INSTANTS, BETWEEN = 20, 10  # at which shares are looked at, and the steps between two
TIMED = 0.01  # s per measurement: long against the clock, short against a change of the processor's speed


@dataclass(frozen=True)
class Row:
    """One effect of a scene."""

    effect: Effect
    calls_for: tuple[str, ...]  # in words; empty = nothing but the agent itself
    cost: float  # us per step that the scene would save without it; what it shares with others is not in it


@dataclass(frozen=True)
class Explanation:
    """What one step of one world does."""

    scene: Scene
    rows: tuple[Row, ...]
    step: float  # us, a whole step
    rest: float  # us, a step without any effect: integrator, limits, confinement, constraints, population
    work: dict[str, float]  # per step, see state.WORK
    left_out: tuple[str, ...]  # one line each
    stable: Suggestion  # the largest stable step
    shares: tuple[tuple[str, str, float], ...] = ()  # of each Steer's behaviours: which, and the mean share granted

    @property
    def shared(self) -> float:
        """Us per step that no single effect could save: the query and the sweep that several share."""
        return max(0.0, self.step - self.rest - sum(row.cost for row in self.rows))

    @property
    def remains(self) -> str:
        """What is left of a step without any effect, in words."""
        scene = self.scene
        parts = [scene.integrator.kind, "limits", scene.space.kind, *(each.kind for each in scene.constraints)]
        return ", ".join(parts + ["births and deaths"] * bool(scene.population))

    @property
    def largest_step(self) -> str:
        """The largest stable step in words, beside the step that is made."""
        found, made = self.stable, f"dt = {self.scene.dt:g} s"
        if math.isfinite(found.dt):
            return f"{found.dt:.3g} s ({found.effect}, agent {found.agent}), {made}"
        if found.frequency or found.damping:
            return f"any is stable with {self.scene.integrator.kind}, {made}"
        return f"nothing in it sets a limit, unless agents that meet do; {made}"


def explain(
    scene: Scene, state: State | None = None, progress: Callable[[int], None] = lambda done: None
) -> Explanation:
    """Measure a scene from a state on (default: its start with seed 0), one effect left out at a time.

    All variants are timed in turn, several rounds, and the shortest time of each counts: a disturbance hits all of them
    or is not counted. `progress` is called with the number of variants that are ready; each may have to be compiled.
    """
    state = scene.start(0) if state is None else state
    effects = scene.effects
    variants = [effects, *(effects[:k] + effects[k + 1 :] for k in range(len(effects))), ()]
    timers = []
    for done, kept in enumerate(variants):
        progress(done)
        timers.append(_Timer(scene.with_effects(*kept), state))
    for _ in range(ROUNDS):
        for timer in timers:
            timer.measure()
    whole, *without, bare = (timer.best for timer in timers)
    rows = tuple(
        Row(effect, _calls(scene, k), max(0.0, whole - less))
        for k, (effect, less) in enumerate(zip(effects, without, strict=True))
    )
    return Explanation(
        scene, rows, whole, bare, _work(scene, state), _left_out(scene), suggest_dt(scene), _shares(scene, state)
    )


class _Timer:
    """The shortest time per step of a scene, in us."""

    def __init__(self, scene: Scene, state: State) -> None:
        self._scene, self._state, self._scratch = scene, state, state.copy()
        self._steps, self.best = 1, math.inf
        self.measure()  # compiles
        self.best = math.inf
        while self.measure() < TIMED:
            self._steps *= 2
        self.best = math.inf

    def measure(self) -> float:
        """Run once and return how long it took, s."""
        self._scratch.copy_from(self._state)
        began = perf_counter()
        self._scene.step(self._scratch, out=self._scratch, steps=self._steps)
        took = perf_counter() - began
        self.best = min(self.best, 1e6 * took / self._steps / self._state.shape[0])
        return took


def _calls(scene: Scene, k: int) -> tuple[str, ...]:
    effect = scene.effects[k]
    how = "tree" if (k, effect) in scene.parts.treed else "direct"
    within = f" within {effect.reach:g} m" if effect.reach else ""
    more = {"neighbour query": within, "all others": f" ({how})"}
    return tuple(what + more.get(what, "") for what in effect.calls_for())


def _work(scene: Scene, state: State) -> dict[str, float]:
    after = scene.step(state)
    return {what: (after.counted(what) - state.counted(what)) / state.shape[0] for what in WORK}


def _shares(scene: Scene, state: State) -> tuple[tuple[str, str, float], ...]:
    """Return the mean share of each wish, while it is one, over INSTANTS of a run from a state on."""
    if not any(effect.wishes for effect in scene.effects):
        return ()
    grants, found = Grants(scene), []
    for _ in range(INSTANTS):
        found.append(grants.at(state))
        state = scene.run(state, BETWEEN)
    rows = []
    for one in zip(*found, strict=True):
        share, asked = np.stack([g.share for g in one]), np.stack([g.asked for g in one])
        for k, name in enumerate(one[0].names):
            mean = float(share[..., k][asked[..., k]].mean()) if asked[..., k].any() else math.nan
            rows.append((f"effects[{one[0].effect}]", name, mean))
    return tuple(rows)


def _left_out(scene: Scene) -> tuple[str, ...]:
    asked = {what for effect in scene.effects for what in effect.calls_for()}
    asked |= {what for constraint in scene.constraints for what in constraint.calls_for()}
    others = sorted(EFFECTS.keys() - {effect.kind for effect in scene.parts.effects})
    lines = []
    if "neighbour query" not in asked:
        lines.append("neighbour query: no effect asks who is near whom")
    if "obstacles" not in asked:
        lines.append(f"pass over obstacles ({len(scene.obstacles)}): no effect asks for them")
    if not scene.constraints:
        lines.append("collisions, rods: no constraint is listed; bodies pass through each other and through obstacles")
    if not scene.population:
        lines.append("births and deaths: nothing in its population")
    if others:
        lines.append(f"effects that are not listed: {', '.join(others)}")
    return tuple(lines)
