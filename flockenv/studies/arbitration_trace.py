"""Trace of arbitration: for every `Steer` of a scene, the force of each behaviour and the share granted to it.

shares = arbitration_shares(scene, state)[0]
shares.mean_share()  # {"avoid_obstacles": 1.0, "wander": 0.27}

The steering force of each behaviour comes from the scene's own kernel, run with one behaviour at a time; shares come
from the law by which the scene reconciles them, in a loop over agents.
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
from flockenv.steering.arbitration import Forces, Shares

__all__ = ["Grants", "SteerShares", "arbitration_shares"]

Reals = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class SteerShares:
    """Shares that one `Steer` effect granted at one instant. B worlds, N agents, K behaviours in order of priority."""

    steer: Steer
    effect: int  # its index in scene.effects
    requested: Reals  # (B, N, K, D) N, steering forces; 0 for agents that are dead or not steered
    share: Reals  # (B, N, K) of each steering force, 0 to 1; 0 if that force is 0
    force: Reals  # (B, N, D) N, their combination, before it is bounded together with a drive

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the behaviours, (K,): their kinds, numbered if there are several of one kind."""
        kinds = [behaviour.kind for behaviour in self.steer.behaviours]
        return tuple(
            kind if kinds.count(kind) == 1 else f"{kind} {kinds[: k + 1].count(kind)}" for k, kind in enumerate(kinds)
        )

    @property
    def is_active(self) -> NDArray[np.bool_]:
        """True where a behaviour's steering force is not 0, (B, N, K)."""
        return np.asarray((self.requested != 0).any(axis=-1))

    @property
    def is_cut(self) -> NDArray[np.bool_]:
        """True where a steering force was not granted in full, (B, N, K)."""
        return self.is_active & (self.share < 1)

    def mean_share(self) -> dict[str, float]:
        """Return the mean share of each behaviour over agents in which its force is not 0; NaN without such agents."""
        active = self.is_active
        return {
            name: float(self.share[..., k][active[..., k]].mean()) if active[..., k].any() else float("nan")
            for k, name in enumerate(self.names)
        }


class _OneBehaviour(Steer):
    """The same behaviours with only one of them active; its force is not bounded by max_force."""

    kind: str  # type: ignore[assignment]  # without a default it is not registered: no scene in YAML has it
    which: int
    steering: ClassVar[bool] = False

    @property
    def steer_law(self) -> Law:
        """The law that returns the force of one behaviour."""
        return force_of_one

    def parameters(self) -> dict[str, float | Vec]:
        """Return the index of the active behaviour."""
        return {"which": float(self.which)}


@law
def force_of_one(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the force of behaviour `which`, and no other."""
    total = zero(forces[0])
    for k in range(len(forces)):
        if like(p.which, k) == p.which:
            total = forces[k]
    return total, (p.which,)


class Grants:
    """Shares granted by the `Steer` effects of a scene, at any number of states; its kernels are built once."""

    def __init__(self, scene: Scene) -> None:
        """Build the kernels of a scene with any number of `Steer` effects."""
        self.scene = scene
        # behaviours may read a medium, an aim or inner states; effects with a force of their own are left out
        media = tuple(e for e in scene.effects if e.own_law is None and (e.medium_law or e.aim_law or e.keeps))
        self._scenes = {
            k: [scene.with_effects(*media, _only_behaviour(effect, j)) for j in range(len(effect.behaviours))]
            for k, effect in enumerate(scene.effects)
            if isinstance(effect, Steer)
        }

    def at(self, state: State) -> tuple[SteerShares, ...]:
        """Return the shares that each `Steer` grants in this state, by effect; the state stays as it is."""
        return tuple(self._shares_of(state, k) for k in self._scenes)

    def _shares_of(self, state: State, which: int) -> SteerShares:
        """Return the shares that effect `which` grants."""
        steer, body = self.scene.effects[which], self.scene.body
        assert isinstance(steer, Steer)
        counted = state.copy()  # a copy, as acceleration() changes work counters
        mass = np.where(np.isfinite(body.mass), body.mass, 0)[:, None]
        requested = np.stack([scene.acceleration(counted) * mass for scene in self._scenes[which]], axis=2)
        b, n, d = state.shape
        force, share = reconcile(
            steer.arbitration, requested.reshape(b * n, -1, d), max_force=np.tile(body.max_force, b),
            time=np.repeat(state.time, n), key=np.repeat(state.key, n), who=np.arange(b * n) % n,
            heading=state.heading.reshape(b * n, d), dtype=self.scene.dtype,
            inner={name: self.scene.inner(state, name).ravel() for name in self.scene.parts.inner},
        )  # fmt: skip
        share = np.where((requested != 0).any(axis=-1), share.reshape(requested.shape[:-1]), 0)
        return SteerShares(steer, which, requested, share, force.reshape(state.shape))


def _only_behaviour(steer: Steer, which: int) -> _OneBehaviour:
    """Return an effect in which one of the behaviours is active."""
    return _OneBehaviour(
        kind="one_behaviour", behaviours=steer.behaviours, arbitration=steer.arbitration, group=steer.group, which=which
    )


def arbitration_shares(scene: Scene, state: State) -> tuple[SteerShares, ...]:
    """Return the shares that each `Steer` of a scene grants, in the order of its effects; the state stays as it is.

    The budget is max_force, whatever else drives the agents. `Grants(scene).at(state)` is faster for repeated calls.
    """
    return Grants(scene).at(state)
