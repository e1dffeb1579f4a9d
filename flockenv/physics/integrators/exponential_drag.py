"""Linear drag treated exactly, all other forces to order 2: an exponential Runge-Kutta method."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like, shared
from flockenv.physics.integrators.integrator import Integrator, Method, Provided, carry

__all__ = ["ExponentialDrag", "phi_functions"]

INVERSE_FACTORIALS = (
    1 / 355687428096000, 1 / 20922789888000, 1 / 1307674368000, 1 / 87178291200, 1 / 6227020800, 1 / 479001600,
    1 / 39916800, 1 / 3628800, 1 / 362880, 1 / 40320, 1 / 5040, 1 / 720, 1 / 120, 1 / 24, 1 / 6,
)  # fmt: skip
"""1/17! to 1/3!: z^k / (k + 3)! sums up to phi3(z), to the last digit for |z| <= 1."""


@shared
def phi_functions(z: float) -> tuple[float, float, float, float]:
    """Return exp z and phi1, phi2, phi3 for z <= 0: phi1 = (exp z - 1) / z, phi_(k+1) = (phi_k - 1/k!) / z, 1/k! at 0.

    They are computed from phi3 down near 0, where the quotients would lose digits, and from phi1 up elsewhere.
    """
    o, e, half = like(z, 0.0), like(z, 1.0), like(z, 0.5)
    near = z >= -e
    small, large = (z if near else o), (-e if near else z)
    third = o
    for term in INVERSE_FACTORIALS:
        third = third * small + like(z, term)
    second = half + small * third
    first = e + small * second
    far_first = np.expm1(large) / large
    far_second = (far_first - e) / large
    far_third = (far_second - half) / large
    if near:
        return e + small * first, first, second, third
    return np.exp(large), far_first, far_second, far_third


def advance(provided: Provided) -> Method:
    """Return the function `advance`, ETD2RK of Cox and Matthews (2002).

    A step is the exact flow of x' = v, v' = -k v + a, with a constant at first, then linear in t.

    The correction, a1 - a0 times h^2 phi3 and h phi2, is split: -a0 after the first evaluation, +a1 after the second.
    """
    acceleration, damping = provided.acceleration, provided.damping

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        a, x, v, rate, half = stages[0], stages[1], stages[2], stages[3], like(dt, 0.5) * dt
        damping(context, rate, first, end)
        for i in range(np.uint64(first), np.uint64(end)):
            x[i], v[i] = pos[i], vel[i]
        for stage in range(2):
            acceleration(context, x, v, time if stage == 0 else time + dt, a)
            for i in range(np.uint64(first), np.uint64(end)):
                decay, one, two, three = phi_functions(-rate[i] * dt)
                if stage == 0:
                    x[i] = pos[i] + dt * (one * v[i] + dt * two * a[i])
                    v[i] = decay * v[i] + dt * one * a[i]
                    pos[i] = carry(x[i] - dt * dt * three * a[i], half, flow, i)
                    vel[i] = v[i] - dt * two * a[i]
                    x[i] = carry(x[i], dt, flow, i)
                else:
                    pos[i] = carry(pos[i] + dt * dt * three * a[i], half, flow, i)
                    vel[i] += dt * two * a[i]

    return advance


class ExponentialDrag(Integrator):
    """Linear drag exactly at any dt, other forces to order 2, two evaluations; oscillations lose (h omega)^4 / 12.

    With z = -h c / m and the other accelerations a: y = x + h phi1(z) v + h^2 phi2(z) a, w = exp(z) v + h phi1(z) a,
    then x' = y + h^2 phi3(z) (b - a), v' = w + h phi2(z) (b - a) with b = a(y, w, t + h). ETD2RK of Cox and Matthews
    2002.

    Limits: only the linear drag of a `drag` effect is exact: damping within other forces, of springs or behaviours, is
    explicit.
    """

    kind: Literal["exponential_drag"] = "exponential_drag"
    order: ClassVar[int] = 2
    order_with_drag: ClassVar[int] = 2
    stages: ClassVar[int] = 4
    evaluations: ClassVar[int] = 2
    splits_drag: ClassVar[bool] = True
