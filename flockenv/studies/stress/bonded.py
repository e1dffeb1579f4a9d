"""Hard cases of bonds: stiff cloths, a hanging chain, one far from the origin, jellies inside out, spun or dropped."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import HalfSpace
from flockenv.model.networks import Cloth, Jelly, Network, Rope
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import AltitudeSprings, Elastic, Gravity, Springs
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.studies.stress.setup import energy_of_a_fall
from flockenv.studies.trial_log import Case, Value

__all__ = ["BONDED"]

G = 9.81
FRAME = 1 / 60  # s


def hanging_scene(
    method: Integrator, network: Network, stiffness: float, dt: float, each: float, damping: float
) -> Scene:
    """Return a network in 3-D under gravity: one set of laws for all cases of this file."""
    effects = (Springs(stiffness=stiffness, damping=damping), Gravity(acceleration=(0.0, 0.0, -G)))
    group = Group(network=network, mass=each)
    return Scene(dimension=3, groups=(group,), effects=effects, integrator=method, dt=dt)


def cloth(stiffness: float, steps: int = 20) -> Callable[[Integrator], Value]:
    """Return the trial of a square metre of cloth, 20 x 20, that swings down from its edge at 60 frames a second."""

    def trial(method: Integrator) -> Value:
        sheet = Cloth(cells=(19, 19), edges=((1, 0, 0), (0, 1, 0)), pinned=("top",))
        scene = hanging_scene(method, sheet, stiffness, FRAME, each=1 / 400, damping=0.0)
        state, most = energy_of_a_fall(scene, steps)
        newton, linear = state.count_of("newton_iterations"), state.count_of("linear_iterations")
        note = f"energy at most {most:.3g} of the work of gravity"
        if newton:
            note += f"; {newton / steps:.3g} iterations of Newton's method and {linear / steps:.3g} solves a step"
        if state.count_of("substeps"):
            note += f"; {state.count_of('substeps') / steps:.4g} steps of its own in each"
        return Value(most, most <= 1.05, note)

    return trial


def chain(method: Integrator) -> Value:
    """Check that a damped chain of ten links comes to rest at N L + (m g / k) N (N + 1) / 2 = 1.1348875 m."""
    rope = Rope(links=10, length=1.0, direction=(0, 0, -1), pinned=("start",))
    dt, steps = (0.05, 400) if method.solves else (0.004, 8000)
    scene = hanging_scene(method, rope, 400.0, dt, each=0.1, damping=2.0)
    end = scene.run(scene.start(0), steps)
    long = float(-end.pos[0, -1, 2])
    return Value(long, abs(long - 1.1348875) <= 1e-4, f"{long:.7f} m")


def far_away(method: Integrator) -> Value:
    """Compare a swinging chain at 0, 1e4 and 1e7 m from the origin, in float64."""
    found = []
    for offset in (0.0, 1e4, 1e7):
        start, direction = (offset, -offset, offset), (1.0, 0.0, 0.2)
        rope = Rope(links=10, length=1.0, start=start, direction=direction, pinned=("start",))
        scene = hanging_scene(method, rope, 400.0, 0.004, each=0.1, damping=0.5)
        end = scene.run(scene.start(0), 100)
        found.append(end.pos[0] - np.array(start))
    off = max(float(np.abs(other - found[0]).max()) for other in found[1:])
    return Value(off, off <= 1e-6, f"{off:.2g} m apart")


def jelly_scene(method: Integrator, young: float, beta: float) -> Scene:
    """Return a cubic metre of 40 corotated tetrahedra, 2.7 kg, free in space; implicit methods take long steps."""
    effects = (Elastic(young=young, strain="corotated", beta=beta),)
    group = Group(network=Jelly(cells=(2, 2, 2), sides=(1, 1, 1)), mass=0.1)
    return Scene(dimension=3, groups=(group,), effects=effects, integrator=method, dt=0.01 if method.solves else 1e-3)


def _volumes(scene: Scene, state: State) -> NDArray[np.float64]:
    """Return the volume of each tetrahedron over that at rest; negative if it is inside out."""
    network = scene.groups[0].network
    assert network is not None
    corners = [points[network.elements(3)] for points in (state.pos[0], network.rest_points(3))]
    now, rest = (np.linalg.det(each[:, 1:] - each[:, :1]) for each in corners)
    return np.asarray(now / rest)


def inside_out(method: Integrator) -> Value:
    """Check that a jelly whose particles begin at their mirror images has its volume again after 4 s."""
    scene = jelly_scene(method, young=1e3, beta=0.01)
    start = scene.start(0)
    shaken = start.pos * (1, 1, -1) + 0.01 * np.random.default_rng(4).normal(size=start.shape)
    end = scene.run(start.with_motion(shaken, start.vel), round(4.0 / scene.dt))
    found = _volumes(scene, end)
    off = float(np.abs(found - 1).max())
    return Value(off, off <= 0.01, f"{int((found < 0).sum())} of {len(found)} tetrahedra inside out")


def spinning(method: Integrator) -> Value:
    """Check that the volume of a jelly changes by at most 1 % while it turns ten times, once a second."""
    scene = jelly_scene(method, young=1e4, beta=0.002)
    start = scene.start(0)
    x = start.pos - start.pos.mean(axis=1, keepdims=True)
    vel = 2 * np.pi * np.stack([-x[..., 1], x[..., 0], np.zeros_like(x[..., 0])], axis=-1)
    state, off = start.with_motion(start.pos, vel), 0.0
    for _ in range(20):
        state = scene.run(state, round(0.5 / scene.dt))
        off = max(off, abs(float(_volumes(scene, state).mean()) - 1))
    return Value(off, off <= 0.01, f"volume within {100 * off:.2g} %")


def dropped(method: Integrator) -> Value:
    """Check that a jelly of altitude springs, dropped from 1 m, has no tetrahedron inside out after 3 s.

    Springs along edges alone leave a third of them so under semi-implicit Euler.
    """
    springs = Springs(stiffness=40.0, damping=0.1), AltitudeSprings(stiffness=40.0, damping=0.1)
    net = Jelly(cells=(3, 3, 3), sides=(0.9, 0.9, 0.9), origin=(0.0, 0.0, 1.0))
    scene = Scene(
        dimension=3, groups=(Group(network=net, mass=0.05),), effects=(*springs, Gravity(acceleration=(0, 0, -G))),
        obstacles=(HalfSpace(point=(0, 0, 0), direction=(0, 0, 1)),), integrator=method, dt=2e-3,
        constraints=(Collisions(agents=False, restitution=0.0, friction=0.5),),
    )  # fmt: skip
    found = _volumes(scene, scene.run(scene.start(0), 1500))
    least = float(found.min())
    return Value(least, least >= 0.8, f"volumes {least:.3g} to {found.max():.3g} of those at rest")


BONDED = (
    *(
        Case(f"N14 {power}", f"cloth, k = 1e{power} N/m", "E <= 1.05 work, or refused", cloth(10.0**power))
        for power in range(3, 9)
    ),
    Case("N15", "hanging chain at rest", "1.1348875 m +- 1e-4", chain),
    Case("N43", "jelly that starts inside out", "volumes within 1 %", inside_out),
    Case("N44", "jelly that spins, 10 turns", "volume within 1 %", spinning),
    Case("N55", "jelly of altitude springs, falls 1 m", "volumes >= 80 %", dropped),
    Case("N17", "chain at 0, 1e4, 1e7 m", "1e-6 m", far_away),
)
