"""Hard cases of one body: oscillators, orbits, tracers, stiff drag.

All share one set of laws, so that each method compiles one kernel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from flockenv.geometry.space import Box
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Attraction, Carried, Drag, Gravity, Swing, Tether, Uniform, Vortex, WallRepulsion
from flockenv.physics.integrators import Adaptive, Integrator
from flockenv.scene import Group, Scene
from flockenv.scene.stability import amplification, limit
from flockenv.studies.stress.setup import collect_step_warnings, start_with
from flockenv.studies.trial_log import Case, Value

__all__ = ["BODIES"]

Floats = NDArray[np.float64]

ONE = (Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1))),)
O2 = (0.0, 0.0)
W = 2 * math.pi


def one_body_scene(
    method: Integrator, dt: float, *, stiffness: float = 0.0, damping: float = 0.0, swing: float = 0.0,
    push: float = 0.0, period: float = 1.0, gravity: float = 0.0, drag: float = 0.0, orbit: float = 0.0,
) -> Scene:  # fmt: skip
    """Return the scene of one body of 1 kg under some of these forces, about the origin."""
    effects = (
        Tether(centre=O2, stiffness=stiffness, damping=damping), Swing(centre=O2, strength=swing),
        Uniform(strength=(push, 0.0), period=period), Gravity(acceleration=(0.0, -gravity)), Drag(rate=drag),
        Attraction(centre=O2, strength=orbit, softening=0.0),
    )  # fmt: skip
    return Scene(groups=ONE, effects=effects, integrator=method, dt=dt)


def end_state(scene: Scene, pos: Any, vel: Any, steps: int) -> tuple[Floats, Floats]:
    """Return position and velocity of the one body after some steps, (2,) each."""
    end = scene.run(start_with(scene, [pos], [vel]), steps)
    return np.asarray(end.pos[0, 0]), np.asarray(end.vel[0, 0])


# --- N01: energy -----------------------------------------------------------------------------------------------------

PRINTED: dict[str, Callable[[float, int], tuple[float, float]]] = {
    "explicit_euler": lambda y, n: ((1 + y * y) ** n,) * 2,
    "implicit_euler": lambda y, n: ((1 + y * y) ** -n,) * 2,
    "midpoint": lambda y, n: ((1 + y**4 / 4) ** n,) * 2,
    "heun": lambda y, n: ((1 + y**4 / 4) ** n,) * 2,
    "rk4": lambda y, n: ((1 - y**6 / 72 + y**8 / 576) ** n,) * 2,
    "semi_implicit_euler": lambda y, n: (1 / (1 + y / 2), 1 / (1 - y / 2)),
    "velocity_verlet": lambda y, n: (1 - y * y / 4, 1.0),
    "implicit_midpoint": lambda y, n: (1.0, 1.0),
}
"""Lower and upper bound of E_n / E_0 of an oscillator that begins at rest, for y = h w after n steps, by method."""


def oscillator(method: Integrator) -> Value:
    """Compare the energy after 100 periods of 100 steps with the method's formula, or with its amplification matrix."""
    y, steps = W / 100, 10_000
    x, v = end_state(one_body_scene(method, 0.01, stiffness=W * W), (1.0, 0.0), O2, steps)
    found = float(v @ v + W * W * x @ x) / W**2
    if method.kind in PRINTED:
        low, high = PRINTED[method.kind](y, steps)
    elif method.adaptive:
        low = high = 1.0
    else:
        end = np.linalg.matrix_power(amplification(method, np.array([y]), 0.0)[0], steps) @ (1.0, 0.0)
        low = high = float(end[1] ** 2 + y * y * end[0] ** 2) / y**2
    off = max(low - found, found - high, 0.0) / low
    return Value(found, off <= 1e-3, f"E/E0 = {found:.6g}, expected {_range(low, high)}")


def _range(low: float, high: float) -> str:
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


# --- N02: orders -----------------------------------------------------------------------------------------------------


def _slope(make: Callable[[float], Scene], end: Floats, begin: tuple[Any, Any], seconds: float) -> float:
    """Return the measured order over five halvings, of position and velocity together; NaN where all is rounding."""
    counts = [20 * 2**k for k in range(6)]
    errors = []
    for n in counts:
        x, v = end_state(make(seconds / n), *begin, n)
        errors.append(float(np.linalg.norm(np.concatenate([x, v]) - end)))
    kept = np.array(errors) > 1e-11
    if kept.sum() < 4:
        return math.nan
    return float(np.polyfit(np.log(seconds / np.array(counts))[kept], np.log(np.array(errors)[kept]), 1)[0])


def orders(method: Integrator) -> Value:
    """Measure the order of convergence on four problems: damped, forced, a pendulum, a projectile with drag."""
    if method.adaptive:
        method = method.model_copy(update={"tolerance": 1e30})  # it accepts its step at any error
    zeta, seconds = 0.1, 0.7
    wd = W * math.sqrt(1 - zeta**2)

    def damped(t: float) -> tuple[float, float]:
        decay, b = math.exp(-zeta * W * t), zeta * W / wd
        x = decay * (math.cos(wd * t) + b * math.sin(wd * t))
        return x, -decay * (wd + b * zeta * W) * math.sin(wd * t)

    x, v = damped(seconds)
    found = {
        "damped": _slope(
            lambda dt: one_body_scene(method, dt, stiffness=W * W, damping=2 * zeta * W),
            np.array([x, 0, v, 0]), ((1.0, 0.0), O2), seconds,
        ),
        "forced": _slope(
            lambda dt: one_body_scene(method, dt, stiffness=9.0, push=1.0, period=math.pi),
            np.array([
                (math.cos(2 * 1.7) - math.cos(3 * 1.7)) / 5, 0,
                (3 * math.sin(3 * 1.7) - 2 * math.sin(2 * 1.7)) / 5, 0,
            ]), (O2, O2), 1.7,
        ),
        "pendulum": _slope(
            lambda dt: one_body_scene(method, dt, swing=9.81), _pendulum(1.3), ((1.0, 0.0), O2), 1.3
        ),
        "projectile": _slope(
            lambda dt: one_body_scene(method, dt, gravity=9.81, drag=0.2), _projectile(1.3, 0.2), (O2, (10.0, 15.0)),
            1.3,
        ),
    }  # fmt: skip
    off = max((abs(s - method.order_with_drag) for s in found.values() if s == s), default=0.0)
    shown = ", ".join(f"{name} {s:.2f}" if s == s else f"{name} exact" for name, s in found.items())
    return Value(off, off <= 0.2, f"declared {method.order_with_drag}; {shown}")


def _pendulum(seconds: float) -> Floats:
    """Return the pendulum's angle and rate, by scipy's DOP853."""
    law = lambda t, y: [y[1], -9.81 * math.sin(y[0])]  # noqa: E731
    x, v = solve_ivp(law, (0, seconds), [1.0, 0], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return np.array([x, 0, v, 0])


def _projectile(t: float, k: float) -> Floats:
    """Return position and velocity under linear drag, closed form."""
    left = math.exp(-k * t)
    return np.array([
        10 * (1 - left) / k, (15 + 9.81 / k) * (1 - left) / k - 9.81 * t / k,
        10 * left, (15 + 9.81 / k) * left - 9.81 / k,
    ])  # fmt: skip


# --- N03: the edge of stability --------------------------------------------------------------------------------------


def threshold(method: Integrator) -> Value:
    """Check that motion is bounded at .99 of the largest stable step for 100,000 steps, and that 1.01 is reported."""
    if not math.isfinite(limit(method, 0.0)):
        scene = one_body_scene(method, 1.0, stiffness=100.0**2)
        x, _ = end_state(scene, (1.0, 0.0), O2, 300)
        return Value(math.inf, abs(float(x[0])) <= 2.0, "no limit: bounded at h w = 100")
    notes = []
    for zeta in (0.0, 1.0):
        most = limit(method, zeta)
        if most < 0.1:
            notes.append(f"zeta = {zeta:g}: none")  # it grows with any step, but slowly: see N01
            continue
        inside = one_body_scene(method, 0.99 * most, stiffness=1.0, damping=2 * zeta)
        x, _ = end_state(inside, (1.0, 0.0), O2, 100_000)
        if not abs(float(x[0])) < 1e3:
            return Value(most, False, f"zeta = {zeta:g}: {x[0]:.3g} m at .99 of the limit {most:.4g}")
        with collect_step_warnings() as caught:
            outside = one_body_scene(method, 1.01 * most, stiffness=1.0, damping=2 * zeta)
            try:
                end_state(outside, (1.0, 0.0), O2, 400_000)
                return Value(most, False, f"zeta = {zeta:g}: not reported at 1.01 of the limit {most:.4g}")
            except SimulationDiverged as error:
                notes.append(f"zeta = {zeta:g}: {most:.4g}, reported after step {error.step}, warned: {bool(caught)}")
                if not caught:
                    return Value(most, False, notes[-1])
    return Value(limit(method, 0.0), True, "largest h w: " + "; ".join(notes))


# --- N04: an orbit ---------------------------------------------------------------------------------------------------

ORBIT = {
    "velocity_verlet": 4e-4, "rk4": 3e-7, "semi_implicit_euler": 2e-2, "linearly_implicit_euler": 2e-2,
    "midpoint": 3e-3, "dormand_prince": 1e-4, "adaptive_rk4": 1e-3,
}  # fmt: skip
"""Bounds of |dE/E| over 100 periods at 1,000 steps each; 1e-2 for other methods."""


def orbit(method: Integrator) -> Value:
    """Measure the energy error of a Kepler orbit, e = .6, 1,000 steps a period, for 100 periods (10 if implicit)."""
    periods = 10 if method.solves else 100
    scene = one_body_scene(method, 2 * math.pi / 1000, orbit=1.0)
    state = start_with(scene, [(0.4, 0.0)], [(0.0, 2.0)])
    energy, spin, before = 0.0, 0.0, _constants(state)
    for _ in range(20 * periods):
        state = scene.run(state, 50)
        now = _constants(state)
        energy = max(energy, abs(now[0] / before[0] - 1))
        spin = max(spin, abs(now[1] / before[1] - 1))
    keeps = method.kind not in ("semi_implicit_euler", "velocity_verlet") or spin <= 1e-12
    note = f"|dE/E| {energy:.2g}, |dL/L| {spin:.2g} over {periods} periods"
    return Value(energy, energy <= ORBIT.get(method.kind, 1e-2) and keeps, note)


def _constants(state: State) -> tuple[float, float]:
    """Return energy and angular momentum of the orbit."""
    x, v = state.pos[0, 0], state.vel[0, 0]
    return float(0.5 * v @ v - 1 / np.linalg.norm(x)), float(x[0] * v[1] - x[1] * v[0])


# --- N16: a tracer in a vortex ---------------------------------------------------------------------------------------

PHI, MOST, R = 2.0, 5.0, 1.2


def tracer(method: Integrator) -> Value:
    """Measure a tracer's distance from its circle after 10 turns of 200 steps in a vortex; Euler's by its recursion."""
    speed = PHI / (PHI / MOST + R * R)
    dt = 2 * math.pi * R / speed / 200
    effects = (Vortex(strength=PHI, centre=O2, maximum=MOST, acts="medium"), Carried())
    scene = Scene(groups=ONE, effects=effects, integrator=method, dt=dt)
    end = scene.run(start_with(scene, [(R, 0.0)], [O2]), 2000)
    radius = float(np.linalg.norm(end.pos[0, 0]))
    if method.order == 1 and not method.solves:
        square = R * R
        for _ in range(2000):
            square += (dt * PHI / (PHI / MOST + square)) ** 2
        off = abs(radius / math.sqrt(square) - 1)
        return Value(off, off <= 1e-10, f"r = {radius:.6g} m, as r^2 + h^2 W^2 says to {off:.1g}")
    off = abs(radius / R - 1)
    most = {1: 1.0, 2: 1e-2}.get(method.order, 1e-6 if not method.adaptive else 1e-3)
    return Value(off, off <= most, f"r = {radius:.9g} m of {R} m")


# --- N20: stiff drag -------------------------------------------------------------------------------------------------


def stiff_drag(share: float) -> Callable[[Integrator], Value]:
    """Return the trial of drag with h c / m = share: explicit methods warn or refuse beyond 2, others never reverse."""

    def trial(method: Integrator) -> Value:
        dt = 0.5
        with collect_step_warnings() as caught:
            scene = one_body_scene(method, dt, drag=share / dt)
            state, speeds = start_with(scene, [O2], [(10.0, 0.0)]), [10.0]
            for _ in range(50):
                state = scene.step(state)
                speeds.append(float(state.vel[0, 0, 0]))
        low, grows = min(speeds), bool(np.abs(speeds).max() > 10.0)
        note = f"least velocity {low:.3g} of 10 m/s" + ("; warned" if caught else "")
        if method.solves or method.splits_drag or method.adaptive:
            noise = 10 * method.tolerance if isinstance(method, Adaptive) else 1e-9  # of each of its steps
            falls = bool((np.diff(speeds) <= noise).all())
            return Value(low, low >= -1e-6 and falls, note)
        return Value(low, bool(caught) if grows else True, note)

    return trial


# --- N09: exactly in the centre --------------------------------------------------------------------------------------


def in_the_centre(method: Integrator) -> Value:
    """Check that a body at rest in the exact centre of an attraction, a spring or a vortex stays there."""
    x, v = end_state(one_body_scene(method, 0.05, stiffness=4.0, orbit=3.0), O2, O2, 100)
    effects = (Vortex(strength=PHI, centre=O2, maximum=MOST, acts="medium"), Carried())
    scene = Scene(groups=ONE, effects=effects, integrator=method, dt=0.05)
    end = scene.run(start_with(scene, [O2], [O2]), 100)
    far = float(np.abs(np.concatenate([x, v, end.pos[0, 0], end.vel[0, 0]])).max())
    return Value(far, far == 0.0, "stays where it is")


# --- N13: a pedestrian and a wall -------------------------------------------------------------------------------------


def approach(speed: float, tau: float, decay: float) -> Callable[[Integrator], Value]:
    """Return the trial of Kretz: an agent of 1 kg with desired speed `speed` comes to rest before a wall, A = 100 N.

    Near the wall the force of length B has the stiffness v0 / (tau B) for a mass of 1 kg, with a damping of 1 / tau. So
    the agent oscillates if and only if v0 tau / B > 1/4, at any step.
    """

    def trial(method: Integrator) -> Value:
        effects = (
            WallRepulsion(point=O2, normal=(-1.0, 0.0), strength=100.0, decay=decay),
            Uniform(strength=(speed / tau, 0.0)), Drag(rate=1 / tau),
        )  # fmt: skip
        scene = Scene(groups=ONE, effects=effects, integrator=method, dt=0.01)
        state, speeds = start_with(scene, [(-4.0, 0.0)], [(speed, 0.0)]), []
        for _ in range(500):
            state = scene.run(state, 4)
            speeds.append(float(state.vel[0, 0, 0]))
        turns = int((np.diff(np.sign([v for v in speeds if abs(v) > 1e-6])) != 0).sum())
        gap, rest = float(-state.pos[0, 0, 0]), decay * math.log(100.0 * tau / speed)
        swings = speed * tau / decay > 0.25
        holds = (turns >= 2) == swings and (swings or turns == 0) and abs(gap - rest) <= 1e-3
        return Value(abs(gap - rest), holds, f"{turns} turns, rests {gap:.5f} m before the wall of {rest:.5f}")

    return trial


# --- N05: a ball that bounces -----------------------------------------------------------------------------------------


def bounces(method: Integrator) -> Value:
    """Bounce a ball, e = .8, from 1 m at 16 phases of the step: it must rest after 4.0637 s, and never be below."""
    worst, low, moving = 0.0, 0.0, 0.0
    for dt in (0.005, 0.02):
        for phase in range(16):
            worst_here, low_here, moving_here = _bounce(method, dt, 1.0 + phase / 16 * 9.81 * dt * 0.45)
            worst, low, moving = max(worst, worst_here), min(low, low_here), max(moving, moving_here)
    note = f"total time off by {worst:.2%} at worst, lowest {low:.1g} m, then {moving:.1g} m/s"
    return Value(worst, worst <= 0.02 and low >= -1e-9 and moving == 0.0, note)


def _bounce(method: Integrator, dt: float, height: float) -> tuple[float, float, float]:
    """Return the error of the total time, s, the lowest point, m, and the final speed, m/s."""
    group = (Group(count=1, radius=0.0, spawn=Spawn(low=(0, 0), high=(1, 1))),)
    room = Box(size=(2.0, 50.0), restitution=0.8)
    scene = Scene(space=room, groups=group, effects=(Gravity(),), integrator=method, dt=dt)
    state, low, rest = start_with(scene, [(1.0, height)], [O2]), 0.0, math.inf
    expected = math.sqrt(2 * height / 9.81) * (1 + 0.8) / (1 - 0.8)
    for k in range(math.ceil(1.1 * expected / dt)):
        state = scene.step(state)
        low = min(low, float(state.pos[0, 0, 1]))
        still = state.vel[0, 0, 1] == 0 and state.pos[0, 0, 1] <= 1e-9
        rest = min(rest, (k + 1) * dt) if still else math.inf
    return abs(rest / expected - 1), low, float(np.abs(state.vel[0, 0, 1]))


BODIES = (
    Case("N01", "oscillator, 100 periods at 100 steps", "energy of the formula, 1e-3", oscillator),
    Case("N02", "order on four problems", "declared +- .2", orders),
    Case("N03", "edge of stability", "bounded at .99, reported at 1.01", threshold),
    Case("N04", "Kepler e = .6, 1,000 steps a period", "|dE/E|: Verlet 4e-4, RK4 3e-7, SE 2e-2, else 1e-2", orbit),
    Case("N05", "ball, e = .8, 16 phases", "4.064 s +- 2 %, then at rest, y >= 0", bounces),
    Case("N09 centre", "exactly in a centre of force", "stays", in_the_centre),
    Case("N13 swings", "wall, v0 tau / B = 5", ">= 2 turns, gap 1e-3 m", approach(0.8, 0.5, 0.08)),
    Case("N13 comes", "wall, v0 tau / B = .13", "no turn, gap 1e-3 m", approach(1.34, 0.05, 0.5)),
    Case("N16", "tracer in a vortex, 10 turns", "order 4: 1e-6; 2: 1e-2; Euler: its recursion, 1e-10", tracer),
    Case("N20 1.9", "drag, h c/m = 1.9", "explicit bounded, others never reverse", stiff_drag(1.9)),
    Case("N20 2.1", "drag, h c/m = 2.1", "explicit warned, others never reverse", stiff_drag(2.1)),
    Case("N20 10", "drag, h c/m = 10", "explicit refused, others never reverse", stiff_drag(10.0)),
)
