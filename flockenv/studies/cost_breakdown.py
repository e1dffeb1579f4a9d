"""Cost of a scene: the time of each effect, the computations it needs, and those that no effect needs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.model.state import WORK, State
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.scene import Scene
from flockenv.scene.stability import Suggestion, suggest_dt
from flockenv.studies.arbitration_trace import Grants

__all__ = ["Cost", "Explanation", "Row", "explain", "variants_of"]

ROUNDS = 15
INSTANTS, BETWEEN = 20, 10  # at which shares are measured, and the steps between two of them
TIMED = 0.01  # s per measurement: long against the clock, short against a change of the processor's speed


ONE_PROCESS = "An interval covers the rounds of this process; in another one a cost may differ by more."
REMARKS = {
    "level": "level: the interval contains 0.",
    "not measurable": "not measurable: the step took longer without the effect. Each variant of a step is compiled by "
    "itself, and the place of its code in memory changes its time by more than the effect costs.",
}


class Cost(NamedTuple):
    """A difference of measured times, us per step: the median over rounds and its 95 % interval."""

    median: float
    low: float  # lower end
    high: float  # upper end

    @classmethod
    def of(cls, differences: NDArray[np.float64]) -> Cost:
        """Return the median of the differences of each round, with the exact interval of order statistics."""
        from scipy.stats import quantile_test  # imported here: commands without timing do not need it

        interval = quantile_test(differences, p=0.5).confidence_interval(0.95)
        return cls(float(np.median(differences)), float(interval.low), float(interval.high))

    @property
    def remark(self) -> str:
        """A key of REMARKS if the time is not above 0 in nearly all rounds, else ""."""
        if self.low > 0:
            return ""
        return "level" if self.high >= 0 else "not measurable"

    def __str__(self) -> str:
        return f"{self.median:.3g} [{self.low:.3g}, {self.high:.3g}] {self.remark}".rstrip()


@dataclass(frozen=True)
class Row:
    """One row of the breakdown: an effect of a scene, what it needs, and what it costs."""

    effect: Effect
    calls_for: tuple[str, ...]  # computations that it needs, in words; empty = only the agent itself
    cost: Cost  # time saved without this effect; work shared with other effects is excluded

    @property
    def name(self) -> str:
        """Kind of the effect, and its fields that differ from their defaults."""
        usual = {name: f.get_default(call_default_factory=True) for name, f in type(self.effect).model_fields.items()}
        values = {name: getattr(self.effect, name) for name in usual if name != "kind"}
        return f"{self.effect.kind}({', '.join(f'{k}={v}' for k, v in values.items() if v != usual[k])})"


@dataclass(frozen=True)
class Explanation:
    """Cost of one step of one world, by effect."""

    scene: Scene  # whose step it is
    rows: tuple[Row, ...]  # an effect each
    step: float  # us, a whole step
    rest: float  # us, a step without any effect: integrator, limits, confinement, constraints, population
    shared: Cost  # not saved by removing any single effect: the neighbour query and the pass that several share
    work: dict[str, float]  # per step, see state.WORK
    left_out: tuple[str, ...]  # computations that are left out, one line each
    stable: Suggestion  # the largest stable step
    shares: tuple[tuple[str, str, float], ...] = ()  # of each Steer's behaviours: which, and the mean share granted

    @property
    def notes(self) -> list[str]:
        """What the intervals cover, and the meaning of the remarks on them, one sentence or two each."""
        remarks = {cost.remark for cost in (*(row.cost for row in self.rows), self.shared)}
        return [ONE_PROCESS, *(text for remark, text in REMARKS.items() if remark in remarks)]

    @property
    def remaining_parts(self) -> str:
        """Parts of a step that remain without any effect, in words."""
        scene = self.scene
        parts = [scene.integrator.kind, "limits", scene.space.kind, *(each.kind for each in scene.constraints)]
        return ", ".join(parts + ["births and deaths"] * bool(scene.population))

    @property
    def largest_step(self) -> str:
        """The largest stable step, in words, next to the step of the scene."""
        found, chosen = self.stable, f"dt = {self.scene.dt:g} s"
        if found.dt == 0:
            return f"none is stable with {self.scene.integrator.kind} ({found.effect} at agent {found.agent}), {chosen}"
        if math.isfinite(found.dt):
            return f"{found.dt:.3g} s ({found.effect}, agent {found.agent}), {chosen}"
        if found.frequency or found.damping:
            return f"any is stable with {self.scene.integrator.kind}, {chosen}"
        return f"no effect limits dt; contacts between agents may; {chosen}"


def explain(
    scene: Scene, state: State | None = None, progress: Callable[[int], None] = lambda done: None
) -> Explanation:
    """Measure the cost of each effect, from a state on (default: the start with seed 0), leaving out one at a time.

    scene: whose effects are measured.

    All variants are timed in turn, ROUNDS times. A cost is the median over the rounds of the difference within a round,
    with its 95 % interval: a disturbance that lasts affects both variants. The interval does not cover differences
    between processes, nor the place of compiled code in memory: a cost may be below 0. `progress` is called with the
    number of variants that are ready; each may have to be compiled.
    """
    state = scene.start(0) if state is None else state
    effects = scene.effects
    timers = []
    for done, kept in enumerate(variants_of(scene)):
        progress(done)
        timers.append(_Timer(scene.with_effects(*kept), state))
    times = np.array([[timer.measure() for timer in timers] for _ in range(ROUNDS)])  # (rounds, variants) us
    full, bare = times[:, :1], times[:, -1]
    saved = full - times[:, 1:-1]
    rows = tuple(Row(effect, _requirements(scene, k), Cost.of(saved[:, k])) for k, effect in enumerate(effects))
    shared = Cost.of(full[:, 0] - bare - saved.sum(axis=1))
    return Explanation(
        scene, rows, float(np.median(full)), float(np.median(bare)), shared, _work_per_step(scene, state),
        _not_computed(scene), suggest_dt(scene), _shares(scene, state),
    )  # fmt: skip


def variants_of(scene: Scene) -> list[tuple[Effect, ...]]:
    """Return the lists of effects that are timed: all, all but one, for each of them, and none.

    scene: whose effects are left out in turn.
    """
    effects = scene.effects
    return [effects, *(effects[:k] + effects[k + 1 :] for k in range(len(effects))), ()]


class _Timer:
    """Timer of a scene's steps from one state on, enough at a time that the clock's resolution does not matter."""

    def __init__(self, scene: Scene, state: State) -> None:
        self._scene, self._state, self._scratch = scene, state, state.copy()
        self._steps = 1
        self.measure()  # compiles
        while self.measure() * self._steps * state.shape[0] < 1e6 * TIMED:
            self._steps *= 2

    def measure(self) -> float:
        """Run once and return the time per step of one world, us."""
        self._scratch.copy_from(self._state)
        began = perf_counter()
        self._scene.step(self._scratch, out=self._scratch, steps=self._steps)
        return 1e6 * (perf_counter() - began) / self._steps / self._state.shape[0]


def _requirements(scene: Scene, k: int) -> tuple[str, ...]:
    effect = scene.effects[k]
    how = "tree" if (k, effect) in scene.parts.tree_effects else "direct"
    within = f" within {effect.reach:g} m" if effect.reach else ""
    more = {"neighbour query": within, "all others": f" ({how})"}
    return tuple(what + more.get(what, "") for what in effect.calls_for())


def _work_per_step(scene: Scene, state: State) -> dict[str, float]:
    after = scene.step(state)
    return {what: (after.count_of(what) - state.count_of(what)) / state.shape[0] for what in WORK}


def _shares(scene: Scene, state: State) -> tuple[tuple[str, str, float], ...]:
    """Return the mean share granted to each behaviour while its force is not 0, over INSTANTS of a run from `state`."""
    if not any(effect.components for effect in scene.effects):
        return ()
    grants, found = Grants(scene), []
    for _ in range(INSTANTS):
        found.append(grants.at(state))
        state = scene.run(state, BETWEEN)
    rows = []
    for one in zip(*found, strict=True):
        share, active = np.stack([g.share for g in one]), np.stack([g.is_active for g in one])
        for k, name in enumerate(one[0].names):
            mean = float(share[..., k][active[..., k]].mean()) if active[..., k].any() else math.nan
            rows.append((f"effects[{one[0].effect}]", name, mean))
    return tuple(rows)


def _not_computed(scene: Scene) -> tuple[str, ...]:
    needed = {what for effect in scene.effects for what in effect.calls_for()}
    needed |= {what for constraint in scene.constraints for what in constraint.calls_for()}
    others = sorted(EFFECTS.keys() - {effect.kind for effect in scene.parts.effects})
    lines = []
    if "neighbour query" not in needed:
        lines.append("neighbour query: no effect needs neighbours")
    if "obstacles" not in needed:
        lines.append(f"pass over obstacles ({len(scene.obstacles)}): no effect needs them")
    if not scene.constraints:
        lines.append("collisions, rods: no constraint is listed; bodies pass through each other and through obstacles")
    if not scene.population:
        lines.append("births and deaths: the population is empty")
    if others:
        lines.append(f"effects that are not listed: {', '.join(others)}")
    return tuple(lines)
