"""What arbitration granted: for every `Steer` of a scene, what each behaviour wished for, and what it was given.

found = granted(scene, state)[0]
found.mean_share()  # {"avoid_obstacles": 1.0, "wander": 0.27}

Wishes come from the scene's own kernel, in which one behaviour after another is heard alone; shares from the very law
by which the scene reconciles them, in a loop over agents.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.behaviours.steer import Steer
from flockenv.jit.decorators import Law, Vec, kernel, law, like
from flockenv.jit.section import entry_of, record, several, vector
from flockenv.maths.vectors import zero
from flockenv.model.state import State
from flockenv.physics.effects.effect import Me
from flockenv.scene import Scene
from flockenv.steering.arbitration import Arbitration, Shares, Wishes

__all__ = ["Granted", "Grants", "granted", "reconcile"]

Reals = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Granted:
    """What one `Steer` effect granted at one instant. B worlds, N agents, K behaviours in order of priority."""

    steer: Steer
    effect: int  # its place in scene.effects
    wish: Reals  # (B, N, K, D) N; 0 for whom it does not steer, and for the dead
    share: Reals  # (B, N, K) of each wish, 0 to 1; 0 where nothing was wished for
    force: Reals  # (B, N, D) N, what came of them, before it is bounded together with a drive

    @property
    def names(self) -> tuple[str, ...]:
        """What the behaviours are called, (K,): their kinds, numbered where there are several of one."""
        kinds = [behaviour.kind for behaviour in self.steer.behaviours]
        return tuple(
            kind if kinds.count(kind) == 1 else f"{kind} {kinds[: k + 1].count(kind)}" for k, kind in enumerate(kinds)
        )

    @property
    def asked(self) -> NDArray[np.bool_]:
        """Who wished for something, (B, N, K)."""
        return np.asarray((self.wish != 0).any(axis=-1))

    @property
    def cut(self) -> NDArray[np.bool_]:
        """Whose wish was not granted in full, (B, N, K)."""
        return self.asked & (self.share < 1)

    def mean_share(self) -> dict[str, float]:
        """Return the mean share of each behaviour among those agents in whom it wished for something; NaN if nobody."""
        asked = self.asked
        return {
            name: float(self.share[..., k][asked[..., k]].mean()) if asked[..., k].any() else float("nan")
            for k, name in enumerate(self.names)
        }


class _Heard(Steer):
    """The same behaviours, of whom one is heard; what it wishes for is not bounded by max_force."""

    kind: str  # type: ignore[assignment]  # without a default it is not registered: no scene in YAML has it
    which: int
    steering: ClassVar[bool] = False

    @property
    def steer_law(self) -> Law:
        """One of them."""
        return heard

    def parameters(self) -> dict[str, float | Vec]:
        """Whom to hear."""
        return {"which": float(self.which)}


@law
def heard(p: Any, me: Any, wishes: Wishes) -> tuple[Vec, Shares]:
    """One wish and no other."""
    total = zero(wishes[0])
    for k in range(len(wishes)):
        if like(p.which, k) == p.which:
            total = wishes[k]
    return total, (p.which,)


class Grants:
    """Asks a scene again and again what its `Steer` effects grant; what that takes is made once."""

    def __init__(self, scene: Scene) -> None:
        """scene: with any number of Steer effects."""
        self.scene = scene
        # a behaviour may read the medium; one that pushes, too, is no behaviour's business
        media = tuple(e for e in scene.effects if e.own_law is None and (e.medium_law or e.aim_law or e.keeps))
        self._heard = {
            k: [scene.with_effects(*media, _heard_alone(effect, j)) for j in range(len(effect.behaviours))]
            for k, effect in enumerate(scene.effects)
            if isinstance(effect, Steer)
        }

    def at(self, state: State) -> tuple[Granted, ...]:
        """Return what each of them grants at this instant, in the order of the effects; nothing moves."""
        return tuple(self._one(state, k) for k in self._heard)

    def _one(self, state: State, which: int) -> Granted:
        """Return what one of them grants."""
        steer, body = self.scene.effects[which], self.scene.body
        assert isinstance(steer, Steer)
        counted = state.copy()  # what is counted is the scene's
        mass = np.where(np.isfinite(body.mass), body.mass, 0)[:, None]
        wish = np.stack([scene.acceleration(counted) * mass for scene in self._heard[which]], axis=2)
        b, n, d = state.shape
        force, share = reconcile(
            steer.arbitration, wish.reshape(b * n, -1, d), max_force=np.tile(body.max_force, b),
            time=np.repeat(state.time, n), key=np.repeat(state.key, n), who=np.arange(b * n) % n,
            heading=state.heading.reshape(b * n, d), dtype=self.scene.dtype,
            inner={name: self.scene.inner(state, name).ravel() for name in self.scene.parts.inner},
        )  # fmt: skip
        share = np.where((wish != 0).any(axis=-1), share.reshape(wish.shape[:-1]), 0)
        return Granted(steer, which, wish, share, force.reshape(state.shape))


def _heard_alone(steer: Steer, which: int) -> _Heard:
    """Return an effect that hears one of the behaviours."""
    return _Heard(
        kind="heard", behaviours=steer.behaviours, arbitration=steer.arbitration, group=steer.group, which=which
    )


def granted(scene: Scene, state: State) -> tuple[Granted, ...]:
    """Return what each `Steer` of a scene grants at this instant, in the order of its effects; nothing moves.

    The budget is max_force, whatever else the agents are driven to do. `Grants(scene).at(state)` is the same for who
    asks more than once.
    """
    return Grants(scene).at(state)


def reconcile(
    arbitration: Arbitration, wishes: ArrayLike, max_force: ArrayLike, time: ArrayLike = 0.0, key: ArrayLike = 0,
    who: ArrayLike = 0, heading: ArrayLike | None = None, dtype: Any = np.float64,
    inner: Mapping[str, ArrayLike] | None = None,
) -> tuple[Reals, Reals]:  # fmt: skip
    """Return the force, (R, D) N, and the share of each wish, (R, K), that an arbitration makes of wishes (R, K, D) N.

    The other arguments are (R,), or one number for all: N, s, the key of the world, which agent; heading (R, D); what
    goes on inside by name, each (R,), if the arbitration asks for it.
    """
    asked = np.ascontiguousarray(wishes, dtype)
    if asked.ndim != 3 or asked.shape[1] < 1 or asked.shape[2] not in (2, 3):
        raise ValueError(f"wishes has shape {asked.shape}, expected (R, K, D) with K >= 1 and D = 2 or 3")
    rows, count, dimension = asked.shape
    real = asked.dtype.type
    ahead = np.zeros((rows, dimension)) if heading is None else heading
    numbers = arbitration.parameters(count)
    force, share = np.empty((rows, dimension), dtype), np.empty((rows, count), dtype)
    recalled = {name: (inner or {})[name] for name in arbitration.recalls}
    kept = np.array([np.broadcast_to(x, rows) for x in recalled.values()], dtype).reshape(-1, rows).T
    given = {k: tuple(map(real, v)) if isinstance(v, tuple) else real(v) for k, v in numbers.items()}
    p = record(tuple(given))(*(given or {"nothing": real(0)}).values())
    _over_rows(arbitration.law, count, dimension, tuple(recalled))(
        p, asked, *(np.ascontiguousarray(np.broadcast_to(x, rows), kind) for x, kind in
                 ((max_force, dtype), (time, dtype), (key, np.uint64), (who, dtype))),
        np.ascontiguousarray(np.broadcast_to(ahead, (rows, dimension)), dtype), np.ascontiguousarray(kept), force,
        share,
    )  # fmt: skip
    return force, share


@kernel
def _number(numbers: Any, k: int) -> float:
    return numbers[k]  # type: ignore[no-any-return]


@entry_of
def _over_rows(law: Law, count: int, dimension: int, recalled: tuple[str, ...]) -> Callable[..., None]:
    """Make the loop of one arbitration over rows."""
    direction, wish = vector(dimension), kernel(lambda wishes, k: direction(wishes[k], 0))
    wishes_of, kept_of = several(count, wish), several(max(len(recalled), 1), _number)
    inner_of, recalls = record(recalled), bool(recalled)

    def over_rows(
        p: Any,
        wishes: Any,
        max_force: Any,
        time: Any,
        key: Any,
        who: Any,
        heading: Any,
        kept: Any,
        force: Any,
        share: Any,
    ) -> None:
        o = max_force.dtype.type(0)
        for r in range(wishes.shape[0]):
            h = direction(heading[r], 0)
            inner = inner_of(*kept_of(kept[r], 0)) if recalls else ()
            me = Me(who[r], h, h, h, o, o, o, max_force[r], h, time[r], h, key[r], h, o, inner)
            f, s = law(p, me, wishes_of(wishes[r], 0))
            for j in range(dimension):
                force[r, j] = f[j]
            for k in range(count):
                share[r, k] = s[k]

    return over_rows
