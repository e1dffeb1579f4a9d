"""What arbitration granted: for every `Steer` of a scene, what each behaviour wished for, and what it was given.

found = granted(scene, state)[0]
found.mean_share()  # {"avoid_obstacles": 1.0, "wander": 0.27}

Wishes come from the scene's own kernel, in which one behaviour after another is heard alone; shares from the very law
by which the scene reconciles them, in a loop over agents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from flockenv.behaviours.reconciliation import reconcile
from flockenv.behaviours.steer import Steer
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import zero
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.steering.arbitration import Shares, Wishes

__all__ = ["Granted", "Grants", "granted"]

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
