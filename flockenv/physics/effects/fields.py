"""Fields: a vector at every place, which pushes agents (a force) or is the velocity of the medium that they are in.

Uniform, source, sink and vortex, whose magnitude is W = Phi / (Phi / Phi_max + r^2): Phi / r^2 far away, at most
Phi_max near the centre, and the zero vector in the centre itself, where no direction is. Wind is a uniform medium with
gusts. All of them may swing in time, as cos(2 pi t / period + phase).

A medium alone moves nobody. There are two models of what it does: `Drag` (and `QuadraticDrag`) pulls an agent's own
velocity towards the medium's, so that the agent has inertia and lags behind; `Carried` moves an agent with the medium
at once, beside its own velocity, which it does not change: a speck of dust, a passive tracer. With both an agent is
carried, and its own velocity, which is then relative to the medium already, is dragged towards the medium's once more:
rarely what is meant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.jit.decorators import OPTIONS, Law, Vec, law, like
from flockenv.maths.vectors import add, dot, lateral, scale, sub, unit
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Vector

__all__ = ["Carried", "Sink", "Source", "Uniform", "Vortex", "Wind"]

Floats = NDArray[np.float64]


def swing(p: Any, me: Me) -> float:
    """Return cos(2 pi t / period + phase); 1, and no code, for a field without a period."""
    return float(np.cos(2 * np.pi * me.time / p.period + p.phase)) if hasattr(p, "period") else 1.0


@overload(swing, jit_options=OPTIONS)
def _swing(p, me):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    if "period" in p.fields:
        return lambda p, me: np.cos(like(me.time, 2 * np.pi) * me.time / p.period + p.phase)
    return lambda p, me: like(me.time, 1.0)


@law
def _magnitude(p: Any, me: Me, square: float) -> float:
    """W = Phi / (|Phi| / Phi_max + r^2) at this time; 0 in the centre."""
    o = like(square, 0.0)
    return p.strength / (abs(p.strength) / p.maximum + square) * swing(p, me) if square > o else o


@law
def uniform(p: Any, me: Me) -> Vec:
    """The same vector everywhere."""
    return scale(p.strength, swing(p, me))


@law
def source(p: Any, me: Me) -> Vec:
    """W away from the centre."""
    away = sub(me.pos, p.centre)
    return scale(unit(away), _magnitude(p, me, dot(away, away)))


@law
def sink(p: Any, me: Me) -> Vec:
    """W towards the centre."""
    towards = sub(p.centre, me.pos)
    return scale(unit(towards), _magnitude(p, me, dot(towards, towards)))


@law
def _turn(p: Any, away: Vec) -> Vec:
    """Return the vector of length r across the way from the centre, or from the axis, counterclockwise."""
    if len(away) == 2:
        return (-away[1], away[0])
    else:
        a = unit(p.axis)
        r = lateral(away, a)
        return (a[1] * r[2] - a[2] * r[1], a[2] * r[0] - a[0] * r[2], a[0] * r[1] - a[1] * r[0])


@law
def vortex(p: Any, me: Me) -> Vec:
    """W around the centre or the axis."""
    across = _turn(p, sub(me.pos, p.centre))
    return scale(unit(across), _magnitude(p, me, dot(across, across)))


@law
def wind(p: Any, me: Me) -> Vec:
    """U."""
    return p.velocity  # type: ignore[no-any-return]


@law
def gusty_wind(p: Any, me: Me) -> Vec:
    """U + G (1 - cos) / 2."""
    return add(p.velocity, scale(p.gust, like(me.time, 0.5) - like(me.time, 0.5) * swing(p, me)))


@law
def carried(p: Any, me: Me) -> Vec:
    """x' = v + share u."""
    return scale(me.medium, p.share)


class _Timed(Effect):
    """What may swing in time; without a period nothing of that is compiled."""

    period: float | None = Field(default=None, gt=0, description="s, of the swing in time; none = it is steady")
    phase: float = Field(default=0.0, description="radians, of the swing at time 0")

    @model_validator(mode="after")
    def _phase_of_something(self) -> Self:
        if self.period is None and self.phase != 0.0:
            raise ValueError(f"phase = {self.phase:g}: only with a period")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """The numbers of the law; those of the swing if there is one."""
        given = super().parameters()
        return given if self.period is not None else {name: given[name] for name in given if name != "phase"}


class _Field(_Timed):
    """What pushes agents or moves the medium, as `acts` says: one law for both."""

    formula: ClassVar[Law]
    acts: Literal["force", "medium"] = Field(
        default="force", description="what it is: a force, N, or a velocity of the medium, m/s"
    )
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    @property
    def own_law(self) -> Law | None:  # type: ignore[override]  # its law fills one of two slots
        """The law, if it is a force."""
        return self.formula if self.acts == "force" else None

    @property
    def medium_law(self) -> Law | None:  # type: ignore[override]
        """The law, if it moves the medium."""
        return self.formula if self.acts == "medium" else None

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats | None:
        """Sum over all agents, (B,) J; none for a medium, for what swings in time, and for what has no potential."""
        steady = self.acts == "force" and self.period is None
        each = self._energy(np.asarray(state.pos, np.float64), offset) if steady else None
        return None if each is None else np.asarray(each.sum(axis=1))

    def _energy(self, pos: Floats, offset: Any) -> Floats | None:
        """Return the potential energy of the steady force, of agents at (B, N, D) m, (B, N) J."""
        return None


class _Central(_Field):
    """Fields whose magnitude falls with the distance from a centre, on a torus from its nearest image."""

    centre: Vector = Field(description="m")
    maximum: float = Field(gt=0, description="Phi_max, N as a force, m/s as a medium: what it is near the centre")
    places: ClassVar[tuple[str, ...]] = ("centre",)

    def _arctan(self, pos: Floats, offset: Any) -> Floats:
        """Return Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max, J: the potential energy in a sink."""
        soft = np.sqrt(self.strength / self.maximum)  # type: ignore[attr-defined]  # whoever has it calls this
        r = np.linalg.norm(offset(self.centre, pos), axis=-1)
        return np.asarray(self.maximum * soft * np.arctan2(r, soft))


class Uniform(_Field):
    """The same everywhere. As a force it does work F . (x - x0), whatever the mass: for gravity see `Gravity`."""

    kind: Literal["uniform"] = "uniform"
    strength: Vector = Field(description="N as a force, m/s as a medium, per axis")
    formula: ClassVar[Law] = uniform

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """-F . x."""
        return np.asarray(-pos @ np.array(self.strength))


class Source(_Central):
    """Away from a centre, W = Phi / (Phi / Phi_max + r^2).

    As a steady force it conserves m v^2 / 2 - Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max.
    """

    kind: Literal["source"] = "source"
    strength: float = Field(ge=0, description="Phi, N m^2 as a force, m^3/s as a medium")
    formula: ClassVar[Law] = source

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """What a sink has, and the other sign."""
        return -self._arctan(pos, offset)


class Sink(_Central):
    """Towards a centre, W = Phi / (Phi / Phi_max + r^2): a source backwards.

    As a steady force it conserves m v^2 / 2 + Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max.
    """

    kind: Literal["sink"] = "sink"
    strength: float = Field(ge=0, description="Phi, N m^2 as a force, m^3/s as a medium")
    formula: ClassVar[Law] = sink

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """0 in the centre, and at most pi / 2 Phi / sqrt(a)."""
        return self._arctan(pos, offset)


class Vortex(_Central):
    """Around a centre, in space around an axis through it, counterclockwise: W = Phi / (|Phi| / Phi_max + r^2).

    As a medium it carries around in circles, once in 2 pi r / W. As a force it has no energy that it would conserve: it
    does work 2 pi r W in every turn.
    """

    kind: Literal["vortex"] = "vortex"
    strength: float = Field(description="Phi, N m^2 as a force, m^3/s as a medium; negative: clockwise")
    axis: Vector | None = Field(default=None, description="its direction, in 3-D alone; none = the z axis")
    formula: ClassVar[Law] = vortex

    @model_validator(mode="after")
    def _axis_in_space(self) -> Self:
        if self.axis is not None and (len(self.axis) != 3 or not any(self.axis)):
            raise ValueError(f"axis = {self.axis}: a direction of three numbers, not all 0, or none for the z axis")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """The numbers of the law: an axis in space, and none in the plane."""
        given = super().parameters()
        return given if len(self.centre) == 2 else {"axis": (0.0, 0.0, 1.0), **given}


class Wind(_Timed):
    """A medium that moves with the same velocity everywhere: U, and in gusts up to U + G.

    u = U + G (1 - cos(2 pi t / period + phase)) / 2: one after another, the gusts of the shape "one minus cosine" that
    aircraft are certified for (CS-25.341).
    """

    kind: Literal["wind"] = "wind"
    velocity: Vector = Field(description="U, m/s")
    gust: Vector | None = Field(default=None, description="G, m/s, what a gust adds at its height; none = no gusts")
    strengths: ClassVar[tuple[str, ...]] = ("velocity", "gust")

    @model_validator(mode="after")
    def _gusts_come_and_go(self) -> Self:
        if (self.gust is None) != (self.period is None):
            raise ValueError("gust and period go together: give both or neither")
        return self

    @property
    def medium_law(self) -> Law | None:  # type: ignore[override]  # gusts are compiled only if there are some
        """With gusts or without."""
        return wind if self.gust is None else gusty_wind


class Carried(Effect):
    """Agents are carried by the medium, beside their own velocity: x' = v + share u; at rest they are tracers of it.

    Not the same as `Drag`, a force that pulls v towards u and takes its time m / c: carried is the limit without
    inertia. v stays what the agent itself does, and max_speed bounds the sum.
    """

    kind: Literal["carried"] = "carried"
    share: float = Field(default=1.0, ge=0, le=1, description="of the medium's velocity; less than 1: they slip")
    flow_law: ClassVar[Law | None] = carried
    strengths: ClassVar[tuple[str, ...]] = ("share",)
