"""Linearly implicit Euler: the forces of an implicit step, to first order in the change of velocity; one solve."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.model.state import Floats
from flockenv.physics.integrators.implicit_euler import advance
from flockenv.physics.integrators.integrator import Integrator

__all__ = ["LinearlyImplicitEuler", "advance"]


class LinearlyImplicitEuler(Integrator):
    """Linearly implicit Euler, order 1 (Baraff and Witkin 1998): linear solves for a step, x' = x + h (v + dv).

    (M - h dF/dv - h^2 dF/dx) dv = h (F + h dF/dx v), by conjugate gradients with symmetric Gauss-Seidel (Eisenstat
    1981) as preconditioner. The derivatives are those of springs, membranes, bending and linear drag; other forces are
    taken at the beginning of the step, as in semi-implicit Euler, and limit dt as they do there. Particles held in
    place keep their velocity exactly, those of a `slide` constraint keep to its line or plane within the solve. After
    the solve, parts that nothing holds are moved as a whole, so that they keep their momentum to rounding; the pieces
    of a torn sheet count as one part. They lose angular momentum: the method damps rotation, and what the solve leaves
    in its residual adds to that.

    With `linearisations: 2` or more the forces are linearised again about the end that the last solve has found: these
    are Newton's iterations for implicit Euler. Other forces are also evaluated again, at that end, which is stable up
    to about half the dt. A link that turns by an angle in a step is too long after one solve, and much less so after
    two: a stiff sheet without damping stores less energy, and at some stiffnesses long steps are more accurate
    (docs/numerics.md).

    With `strain`, a step in which some triangle or spring changes its length by more than that share of its rest
    length is made again as two halves, and these likewise (section 6 there, but without a step size that lasts): a
    sheet that is hit hard gets short steps as long as it needs them. Limits, constraints and space act once per step,
    at its end.

    In a scene with `collisions` the contacts with obstacles are part of the equations (section 5 there): a particle
    that touches one, and does not bounce, keeps to its surface within the solve, and its neighbours move accordingly
    in the same step. Contacts that would pull are released, and friction is Coulomb's; each change is another solve.
    Impacts that bounce, and whatever the linear equations miss, are left to `collisions` after the solve.

    Limits: forces without a `derivative` are no part of the equations. It damps fast motion, as implicit Euler does,
    and threads do not share a world.
    """

    kind: Literal["linearly_implicit_euler"] = "linearly_implicit_euler"
    tolerance: float = Field(
        default=1e-3, ge=1e-14, le=0.1, description="residual of the linear equations, relative to that of dv = 0"
    )
    most: int = Field(
        default=10_000, ge=1, description="largest number of iterations in a step; a world that needs more diverges"
    )
    linearisations: int = Field(
        default=1,
        ge=1,
        le=100,
        exclude_if=lambda linearisations: linearisations == 1,
        description="linear solves in a step, each about the end that the last one has found",
    )
    strain: float = Field(
        default=0.0,
        ge=0,
        exclude_if=lambda strain: strain == 0,
        description="largest change of strain, of a spring or a triangle, in one solve; a step with more is halved; "
        "0: not limited",
    )
    halvings: int = Field(
        default=8,
        ge=0,
        le=20,
        exclude_if=lambda halvings: halvings == 8,
        description="how often a step is halved at most; a world that needs more diverges",
    )
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    stages: ClassVar[int] = 2
    evaluations: ClassVar[int] = 0  # one, which is counted where it is made
    solves: ClassVar[bool] = True
    linearises: ClassVar[bool] = True

    def _step(
        self, law: Any, context: Any, x: Floats, v: Floats, flow: Any, time: float, dt: float, stages: Floats
    ) -> None:
        """Advance one world under laws that are Python functions, without known derivatives: explicitly."""
        law(context, x, v, time, stages[0])
        for _ in range(self.linearisations - 1):
            later = v + dt * stages[0]
            law(context, x + dt * (later + flow if len(flow) else later), later, time + dt, stages[0])
        v += dt * stages[0]
        x += dt * (v + flow if len(flow) else v)
