"""Fluctuations: random kicks, such as those of a fluid's molecules."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import scale
from flockenv.physics.effects.effect import Effect, Me

__all__ = ["Fluctuation"]


@law
def fluctuation(p: Any, me: Me, seconds: float, gauss: Vec) -> Vec:
    """Return dv = s / m sqrt(dt) xi."""
    return scale(gauss, p.strength * np.sqrt(seconds) / me.mass)


class Fluctuation(Effect):
    """White noise: m dv = s dW, a kick (s / m) sqrt(dt) xi per step, xi normal in each direction.

    The kick grows with the root of the step, so that statistics after a time T do not depend on dt: alone,
    var v = (s/m)^2 T and var x = (s/m)^2 T^3 / 3 per direction; with Drag of rate c, var v = s^2 / (2 c m) in the long
    run (Langevin 1908), which is k T / m at s^2 = 2 c k T; at the end of a step, just after the kick, var v is larger
    by a fraction c dt / m. A kick is a function of (seed, world, step, agent, index of the effect in the scene), drawn
    once per step however often a method evaluates forces.

    Limits: the noise is white: a single path depends on dt, and only the statistics do not. Alone it heats agents
    without bound. It has no correlation in space: near agents get independent kicks.
    """

    kind: Literal["fluctuation"] = "fluctuation"
    strength: float = Field(ge=0, description="s, N s^(1/2), momentum of the kicks per root of time")
    kick_law: ClassVar[Law | None] = fluctuation
    strengths: ClassVar[tuple[str, ...]] = ("strength",)
