"""Slide: particles that move along a line or in a plane, for any method."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.jit.decorators import kernel, like
from flockenv.jit.section import entry
from flockenv.maths.approximations import round_half_even
from flockenv.model.network import Name, Particle
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.constraints.constraint import Constraint, Settler
from flockenv.physics.constraints.rods import wrap_position

__all__ = ["Slide", "hold_slides"]

Direction = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]


@kernel
def hold_slides(
    x0: Any, x: Any, v: Any, alive: Any, agent: Any, projection: Any, period: Any, by: Any, first: int, end: int
) -> tuple[int, int]:
    """Project the steps and velocities of agents in worlds [first, end), in place.

    Returns the first (world, agent) that is not finite, or -1s. period: (D,) m, edges of a torus; 0 = not periodic.
    by: scratch memory, (2, D).
    """
    world, sliding, d = -1, -1, projection.shape[0]
    for b in range(first, end):
        for k in range(agent.shape[0]):
            i = agent[k]
            if alive[b, i]:
                for a in range(d):
                    by[0, a], by[1, a] = like(by[0, 0], 0.0), like(by[0, 0], 0.0)
                    for c in range(d):
                        off = x[c, b, i] - x0[c, b, i]
                        if period[c] > 0:
                            off -= period[c] * round_half_even(off / period[c])
                        by[0, a] += projection[a, c] * off
                        by[1, a] += projection[a, c] * v[c, b, i]
                for a in range(d):
                    x[a, b, i], v[a, b, i] = x0[a, b, i] + by[0, a], by[1, a]
                if not wrap_position(x, v, b, i, period) and world < 0:
                    world, sliding = b, i
    return world, sliding


class Slide(Constraint):
    """Particles of a network that move along one direction (on a line) or two (in a plane), as curtain rings do.

    Each step is projected onto the directions, from where it began, and so is the velocity: a force across them does no
    work. Linearly implicit methods solve their equations with the constraint (Baraff and Witkin 1998, section 5.1).

    x' = x0 + P (x - x0), v' = P v, with the projection P onto the directions and the position x0 before the step.

    Limits: the directions do not turn, and there is no friction and no end of the rail. A later constraint, such as
    `collisions`, may move a particle off it.
    """

    kind: Literal["slide"] = "slide"
    group: int = Field(default=0, ge=0, description="index of the group whose network it constrains")
    particles: tuple[Particle | Name, ...] = Field(
        min_length=1, description="names of places of the network, or indices of its particles"
    )
    along: tuple[Direction, ...] = Field(
        min_length=1, max_length=2, description="one direction, or two that span a plane; of any length"
    )

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        """Raise ValueError if a direction has no length, or two are parallel or of different dimensions."""
        for k, direction in enumerate(self.along):
            if not (np.linalg.norm(direction) > 0 and np.isfinite(direction).all()):
                raise ValueError(f"along[{k}] = {direction}: must have a finite length above 0")
            if len(direction) != len(self.along[0]):
                raise ValueError(
                    f"along[{k}] = {direction} has {len(direction)} numbers, along[0] has {len(self.along[0])}"
                )
        units = [np.array(each) / np.linalg.norm(each) for each in self.along]
        if np.linalg.matrix_rank(np.array(units), tol=1e-9) < len(units):
            raise ValueError(f"along = {self.along}: they are parallel; give one of them for a line")
        return self

    def projection(self) -> NDArray[np.float64]:
        """Return the matrix that projects onto the directions, (D, D)."""
        axes, _ = np.linalg.qr(np.array(self.along).T)
        return np.asarray(axes @ axes.T)

    def agents(self, scene: SceneView) -> NDArray[np.int64]:
        """Return the indices of the particles in a scene, ascending; raise ValueError if there are none such."""
        if self.group >= len(scene.groups):
            raise ValueError(f"group = {self.group}: there are {len(scene.groups)} groups, counted from 0")
        network = scene.groups[self.group].network
        if network is None:
            raise ValueError(f"group = {self.group}: has no network; give groups[{self.group}].network")
        return np.asarray(scene.starts[self.group] + network.particles("particles", self.particles), np.int64)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError for an unknown particle, one of a constraint before, or directions of another dimension."""
        if len(self.along[0]) != scene.dimension:
            raise ValueError(
                f"along[0] = {self.along[0]}: has {len(self.along[0])} numbers, but dimension = {scene.dimension}"
            )
        if len(self.along) == scene.dimension:
            raise ValueError(f"along: {len(self.along)} directions in {scene.dimension} dimensions leave nothing fixed")
        mine = self.agents(scene)
        for k, other in enumerate(scene.constraints):
            if other is self:
                break
            if isinstance(other, Slide) and len(both := np.intersect1d(mine, other.agents(scene))):
                raise ValueError(f"particles: agent {both[0]} slides along constraints[{k}] already")

    def settler(self, scene: SceneView) -> Settler:
        """Return a function that projects a step, with scratch memory of its own."""
        agents = self.agents(scene)
        agents = agents[np.isfinite(scene.body.mass[agents])]
        d, real, space = scene.dimension, np.dtype(scene.dtype).type, scene.space
        projection = np.ascontiguousarray(self.projection(), real)
        period = np.array(space.extent(d) if space.periodic else (0.0,) * d, real)
        by, hold = np.zeros((2, d), real), entry(hold_slides)

        def settle(x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
            world, agent = hold(x0, state.x, state.v, state.alive, agents, projection, period, by, first, end)
            return int(world), int(agent)

        return settle
