"""Scenes of solid discs for hard cases: one set of laws, Gravity alone, so that each method compiles one kernel.

Each case has one response (flockenv/physics/constraints/collisions.py); the other axis of the table is the method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import Shape
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.studies.trial_log import Case, Value

__all__ = ["RESPONSES", "Floats", "G", "Response", "batch", "cases_by_response", "disc_scene", "overlap"]

Floats = NDArray[np.float64]
Response = Literal["earliest", "back_up", "impulses", "project"]
RESPONSES: tuple[Response, ...] = get_args(Response)
G = 9.81  # m/s^2
HERE = Spawn(low=(0, 0), high=(1, 1))


def disc_scene(
    method: Integrator, response: Response, dt: float, *, masses: Sequence[float] = (1.0,), count: int = 0,
    radius: float = 0.1, pull: tuple[float, float] = (0.0, 0.0), obstacles: Sequence[Shape] = (), **rules: Any,
) -> Scene:  # fmt: skip
    """Return discs of these masses, or `count` of the first, under a constant pull, m/s^2, with these obstacles."""
    groups = [Group(count=count or 1, mass=mass, radius=radius, spawn=HERE) for mass in masses]
    return Scene(
        groups=tuple(groups), effects=(Gravity(acceleration=pull),), obstacles=tuple(obstacles), integrator=method,
        constraints=(Collisions(response=response, **rules),), dt=dt,
    )  # fmt: skip


def batch(scene: Scene, pos: Any, vel: Any) -> State:
    """Return the start of many worlds, pos and vel (B, N, D) or broadcast to that, m and m/s."""
    shape = np.broadcast_shapes(np.shape(pos), np.shape(vel), (1, scene.agents, scene.dimension))
    state = scene.start(0, worlds=shape[0])
    return state.with_motion(np.broadcast_to(pos, shape).astype(float), np.broadcast_to(vel, shape).astype(float))


def overlap(pos: Floats, radius: float) -> float:
    """Return the deepest overlap of two discs of (N, 2), m; 0 if none overlap."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(pos).query_pairs(2 * radius, output_type="ndarray")
    if not len(pairs):
        return 0.0
    return float(2 * radius - np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1).min())


def cases_by_response(
    name: str, title: str, bound: str, trial: Callable[[Integrator, Response], Value],
    responses: Sequence[Response] = RESPONSES, methods: Sequence[str] = (),
) -> tuple[Case, ...]:  # fmt: skip
    """Return a case for each response."""

    def under(response: Response) -> Callable[[Integrator], Value]:
        return lambda method: trial(method, response)

    return tuple(Case(f"{name} {each}", title, bound, under(each), tuple(methods)) for each in responses)
