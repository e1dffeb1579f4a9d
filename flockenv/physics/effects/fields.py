"""Fields: a vector at every point, which is a force on agents or the velocity of the medium around them.

Uniform, source, sink and vortex, whose magnitude is W = Phi / (Phi / Phi_max + r^2): Phi / r^2 far away, at most
Phi_max near the centre, and the zero vector at the centre itself, which has no direction. Wind is a uniform medium with
gusts. All of them may oscillate in time, as cos(2 pi t / period + phase).

A medium alone moves no agent. Two effects couple agents to it: `Drag` (and `QuadraticDrag`) pulls an agent's own
velocity towards the medium's, so that the agent has inertia and lags behind; `Carried` adds the medium's velocity to
the agent's own, which stays unchanged, as for dust or a passive tracer. With both, an agent is carried, and its own
velocity, already relative to the medium, is also dragged towards the medium's, which is rarely intended.
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


def oscillation(p: Any, me: Me) -> float:
    """Return cos(2 pi t / period + phase); 1 for a field without a period."""
    return float(np.cos(2 * np.pi * me.time / p.period + p.phase)) if hasattr(p, "period") else 1.0


@overload(oscillation, jit_options=OPTIONS)
def _oscillation(p, me):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    if "period" in p.fields:
        return lambda p, me: np.cos(like(me.time, 2 * np.pi) * me.time / p.period + p.phase)
    return lambda p, me: like(me.time, 1.0)


@law
def _magnitude(p: Any, me: Me, square: float) -> float:
    """Return W = Phi / (|Phi| / Phi_max + r^2) at this time; 0 at the centre."""
    o = like(square, 0.0)
    return p.strength / (abs(p.strength) / p.maximum + square) * oscillation(p, me) if square > o else o


@law
def uniform(p: Any, me: Me) -> Vec:
    """Return the same vector everywhere."""
    return scale(p.strength, oscillation(p, me))


@law
def source(p: Any, me: Me) -> Vec:
    """Return W away from the centre."""
    away = sub(me.pos, p.centre)
    return scale(unit(away), _magnitude(p, me, dot(away, away)))


@law
def sink(p: Any, me: Me) -> Vec:
    """Return W towards the centre."""
    towards = sub(p.centre, me.pos)
    return scale(unit(towards), _magnitude(p, me, dot(towards, towards)))


@law
def _perpendicular(p: Any, away: Vec) -> Vec:
    """Return the vector of length r perpendicular to the offset from the centre or axis, counterclockwise."""
    if len(away) == 2:
        return (-away[1], away[0])
    else:
        a = unit(p.axis)
        r = lateral(away, a)
        return (a[1] * r[2] - a[2] * r[1], a[2] * r[0] - a[0] * r[2], a[0] * r[1] - a[1] * r[0])


@law
def vortex(p: Any, me: Me) -> Vec:
    """Return W around the centre or the axis."""
    across = _perpendicular(p, sub(me.pos, p.centre))
    return scale(unit(across), _magnitude(p, me, dot(across, across)))


@law
def wind(p: Any, me: Me) -> Vec:
    """Return U, the velocity of the wind."""
    return p.velocity  # type: ignore[no-any-return]


@law
def gusty_wind(p: Any, me: Me) -> Vec:
    """Return U + G (1 - cos(2 pi t / period + phase)) / 2."""
    return add(p.velocity, scale(p.gust, like(me.time, 0.5) - like(me.time, 0.5) * oscillation(p, me)))


@law
def carry_velocity(p: Any, me: Me) -> Vec:
    """Return share u, the flow that is added to the agent's own velocity."""
    return scale(me.medium, p.share)


class _Timed(Effect):
    """Base class of effects that may oscillate in time; without a period the oscillation is not compiled."""

    period: float | None = Field(default=None, gt=0, description="s, of the oscillation in time (default: steady)")
    phase: float = Field(default=0.0, description="radians, of the oscillation at time 0")

    @model_validator(mode="after")
    def _check_phase(self) -> Self:
        """Raise ValueError if a phase is given without a period."""
        if self.period is None and self.phase != 0.0:
            raise ValueError(f"phase = {self.phase:g}: needs a period")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return the parameters of the law; those of the oscillation only with a period."""
        given = super().parameters()
        return given if self.period is not None else {name: given[name] for name in given if name != "phase"}


class _Field(_Timed):
    """Base class of fields that are a force or a velocity of the medium, as `acts` selects."""

    formula: ClassVar[Law]
    """(p, me) -> the vector at the position of the agent `me`, with the parameters `p` of the field."""
    acts: Literal["force", "medium"] = Field(
        default="force", description="as a force, N, or as a velocity of the medium, m/s"
    )
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    @property
    def own_law(self) -> Law | None:  # type: ignore[override]  # its law fills one of two slots
        """The law if the field is a force, else None."""
        return self.formula if self.acts == "force" else None

    @property
    def medium_law(self) -> Law | None:  # type: ignore[override]
        """The law if the field is a velocity of the medium, else None."""
        return self.formula if self.acts == "medium" else None

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats | None:
        """Return the sum over all agents, (B,) J; None for a medium, an oscillation, or without a potential."""
        steady = self.acts == "force" and self.period is None
        each = self._energy(np.asarray(state.pos, np.float64), offset) if steady else None
        return None if each is None else np.asarray(each.sum(axis=1))

    def _energy(self, pos: Floats, offset: Any) -> Floats | None:
        """Return the potential energy of agents at `pos` (B, N, D) m in the steady force, (B, N) J."""
        return None


class _Central(_Field):
    """Base class of fields whose magnitude falls with the distance from a centre (on a torus, its nearest image)."""

    centre: Vector = Field(description="m, the centre")
    maximum: float = Field(gt=0, description="Phi_max, N as a force, m/s as a medium: limit near the centre")
    places: ClassVar[tuple[str, ...]] = ("centre",)

    def _arctan(self, pos: Floats, offset: Any) -> Floats:
        """Return Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max, J: the potential energy in a sink."""
        soft = np.sqrt(self.strength / self.maximum)  # type: ignore[attr-defined]  # subclasses that have it call this
        r = np.linalg.norm(offset(self.centre, pos), axis=-1)
        return np.asarray(self.maximum * soft * np.arctan2(r, soft))


class Uniform(_Field):
    """A uniform field; as a force it does work F . (x - x0), independent of the mass (for gravity see `Gravity`).

    It is W = `strength`, with a period W cos(2 pi t / period + phase). The field is ours.

    Limits: it is the same everywhere and acts on every agent alike: walls do not shield from it, and as a force it
    accelerates light agents more.
    """

    kind: Literal["uniform"] = "uniform"
    strength: Vector = Field(description="N as a force, m/s as a medium, per axis")
    formula: ClassVar[Law] = uniform

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """Return -F . x."""
        return np.asarray(-pos @ np.array(self.strength))


class Source(_Central):
    """A field away from a centre, of magnitude W = Phi / (Phi / Phi_max + r^2).

    As a steady force it conserves m v^2 / 2 - Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max.

    The bound near the centre is ours.

    Limits: it falls as 1 / r^2 in the plane also, so as a medium it is the flow of an incompressible fluid only in
    space. It acts through obstacles.
    """

    kind: Literal["source"] = "source"
    strength: float = Field(ge=0, description="Phi, N m^2 as a force, m^3/s as a medium")
    formula: ClassVar[Law] = source

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """Return minus the energy in a sink."""
        return -self._arctan(pos, offset)


class Sink(_Central):
    """A field towards a centre, of magnitude W = Phi / (Phi / Phi_max + r^2): a reversed source.

    As a steady force it conserves m v^2 / 2 + Phi / sqrt(a) arctan(r / sqrt(a)), a = Phi / Phi_max.

    The bound near the centre is ours.

    Limits: it falls as 1 / r^2 in the plane also, so as a medium it is the flow of an incompressible fluid only in
    space. It acts through obstacles, and its direction reverses at the centre, about which agents swing.
    """

    kind: Literal["sink"] = "sink"
    strength: float = Field(ge=0, description="Phi, N m^2 as a force, m^3/s as a medium")
    formula: ClassVar[Law] = sink

    def _energy(self, pos: Floats, offset: Any) -> Floats:
        """Return the energy: 0 at the centre, at most pi / 2 Phi / sqrt(a)."""
        return self._arctan(pos, offset)


class Vortex(_Central):
    """A counterclockwise field around a centre, in 3-D around an axis, W = Phi / (|Phi| / Phi_max + r^2).

    As a medium it carries agents in circles, one turn in 2 pi r / W. As a force it conserves no energy: it does work
    2 pi r W in every turn.

    The profile is ours.

    Limits: a force around a centre has no potential: without drag agents gain energy in every turn and spiral outwards.
    The profile is not that of a free vortex, which falls as 1 / r.
    """

    kind: Literal["vortex"] = "vortex"
    strength: float = Field(description="Phi, N m^2 as a force, m^3/s as a medium; negative: clockwise")
    axis: Vector | None = Field(default=None, description="direction of the axis, only in 3-D (default: the z axis)")
    formula: ClassVar[Law] = vortex

    @model_validator(mode="after")
    def _check_axis(self) -> Self:
        """Raise ValueError if an axis is given in 2-D, or has no length."""
        if self.axis is not None and (len(self.axis) != 3 or not any(self.axis)):
            raise ValueError(f"axis = {self.axis}: must be three numbers, not all 0, or None for the z axis")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return the parameters of the law: with an axis in 3-D, without one in 2-D."""
        given = super().parameters()
        return given if len(self.centre) == 2 else {"axis": (0.0, 0.0, 1.0), **given}


class Wind(_Timed):
    """A medium that moves with the same velocity everywhere: U, and in gusts up to U + G.

    u = U + G (1 - cos(2 pi t / period + phase)) / 2: successive gusts of the "one minus cosine" shape for which
    aircraft are certified (CS-25.341).

    The model is ours.

    Limits: it is the same everywhere at one time: obstacles cast no lee, and agents do not slow it down.
    """

    kind: Literal["wind"] = "wind"
    sentence: ClassVar[str] = "Wind of {velocity}[, in gusts up to {gust} more]"
    velocity: Vector = Field(description="U, m/s, of the medium between gusts")
    gust: Vector | None = Field(default=None, description="G, m/s, added at the peak of a gust (default: no gusts)")
    strengths: ClassVar[tuple[str, ...]] = ("velocity", "gust")

    @model_validator(mode="after")
    def _check_gusts(self) -> Self:
        """Raise ValueError if only one of gust and period is given."""
        if (self.gust is None) != (self.period is None):
            raise ValueError("gust and period go together: give both or neither")
        return self

    @property
    def medium_law(self) -> Law | None:  # type: ignore[override]  # gusts are compiled only if there are some
        """The law with gusts, or the one without."""
        return wind if self.gust is None else gusty_wind


class Carried(Effect):
    """Agents are carried by the medium, in addition to their own velocity: x' = v + share u; at rest they are tracers.

    Unlike `Drag`, a force that pulls v towards u with time constant m / c, this is the limit without inertia. v stays
    the agent's own velocity, and max_speed bounds the sum.

    The model is ours.

    Limits: agents do not act back on the medium, and obstacles do not divert it: it carries agents into walls, which
    need `collisions`.
    """

    kind: Literal["carried"] = "carried"
    share: float = Field(default=1.0, ge=0, le=1, description="fraction of the medium's velocity; below 1 agents slip")
    flow_law: ClassVar[Law | None] = carry_velocity
    strengths: ClassVar[tuple[str, ...]] = ("share",)
