"""Hard cases of discs that hit: bouncing balls, bullets, a cradle, mass ratios, a gas far away, fifty in one place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockenv.geometry.shapes import Block, HalfSpace, Shape, Wall
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.integrators import Integrator
from flockenv.scene import Scene
from flockenv.studies.stress.solids import Floats, G, Response, batch, cases_by_response, disc_scene, overlap
from flockenv.studies.trial_log import Value

__all__ = ["IMPACTS"]

R = 0.1
PHASES = 16
FLOOR = HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0))


# --- N05, N06: a ball on a floor --------------------------------------------------------------------------------------


def drop_balls(
    method: Integrator, response: Response, dt: float, e: float, steps: int
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Return heights and velocities of sixteen balls after each step, (K, 16), and their starting heights, (16,) m.

    Their starts are spread over one step's path, so that each hits the floor at another phase of the step. Heights
    are those of the lowest point.
    """
    pull = (0.0, -G)
    scene = disc_scene(method, response, dt, count=PHASES, pull=pull, obstacles=(FLOOR,), restitution=e, agents=False)
    begin = 1 + np.arange(PHASES) / PHASES * dt * math.sqrt(2 * G)
    state = batch(scene, np.stack([0 * begin, begin + R], axis=1)[None], 0.0)
    y, v = np.empty((steps, PHASES)), np.empty((steps, PHASES))
    for k in range(steps):
        state = scene.step(state, out=state)
        y[k], v[k] = state.pos[0, :, 1] - R, state.vel[0, :, 1]
    return y, v, begin


def apexes(y: Floats) -> Floats:
    """Return the top of each flight of one ball from its heights (K,), m.

    The top of the parabola through the highest of its points and the two beside it: exact for any method, since it
    does not read velocities (flockenv/geometry/space.py).
    """
    k = 1 + np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:]))
    bend, slope = y[k - 1] - 2 * y[k] + y[k + 1], (y[k + 1] - y[k - 1]) / 2
    return np.asarray(y[k] - slope**2 / (2 * bend))


def bouncing(method: Integrator, response: Response) -> Value:
    """Bounce balls, e = .8: tops must be e^2n h, n <= 4, rest begin at 4.0637 s and last, none be below the floor."""
    tops, total, low, moving = 0.0, 0.0, 0.0, 0.0
    for dt in (0.02,) if method.solves else (0.001, 0.005, 0.02):
        y, v, begin = drop_balls(method, response, dt, 0.8, round(5.0 / dt))
        low = min(low, float(y.min()))
        for ball in range(PHASES):
            found = apexes(y[:, ball])[:4]
            expected = begin[ball] * 0.64 ** np.arange(1, 5)
            tops = max(tops, float(np.abs(found / expected[: len(found)] - 1).max()) if len(found) == 4 else math.inf)
            still = (np.abs(v[:, ball]) <= 1e-9) & (y[:, ball] <= 1e-6)
            rest = (len(still) - int(still[::-1].argmin()) + 1) * dt if still[-1] else math.inf
            total = max(total, abs(rest / (9 * math.sqrt(2 * begin[ball] / G)) - 1))
            moving = max(moving, float(np.abs(v[-1, ball])))
    holds = tops <= 0.02 and total <= 0.02 and low >= -1e-9 and moving <= 1e-9
    note = f"tops off by {tops:.2%}, total time by {total:.2%} at worst, lowest {low:.1g} m, then {moving:.1g} m/s"
    return Value(max(tops, total), holds, note)


def elastic(method: Integrator, response: Response) -> Value:
    """Bounce balls 100 times, e = 1: no top may exceed 1.01 h; with impacts located in time each must be h to 1e-6.

    20 bounces for methods that solve equations. h is the top of the parabola on which the method's first step begins:
    off by half a step's fall for methods of first order.
    """
    most, least, few, low = 0.0, math.inf, 1000, 0.0
    for dt, seconds in ((0.02, 20.0),) if method.solves else ((0.005, 10.0), (0.02, 96.0)):
        y, _, begin = drop_balls(method, response, dt, 1.0, round(seconds / dt))
        low = min(low, float(y.min()))
        for ball in range(PHASES):
            start = begin[ball], y[0, ball], y[1, ball]
            slope, bend = (start[2] - start[0]) / 2, start[0] - 2 * start[1] + start[2]
            found = apexes(y[:, ball]) / (start[1] - slope**2 / (2 * bend))
            few = min(few, len(found)) if dt == 0.02 else few
            most, least = max(most, float(found.max(initial=0.0))), min(least, float(found.min(initial=math.inf)))
    note = f"tops {least:.7f} to {most:.7f} of h, at least {few} of them in {seconds:g} s, lowest {low:.1g} m"
    holds = most <= 1.01 and few > 0
    if response in ("earliest", "back_up"):
        holds &= abs(most - 1) <= 1e-6 and abs(least - 1) <= 1e-6 and few >= (20 if method.solves else 100)
    return Value(most, holds, note)


# --- N07: bullets -----------------------------------------------------------------------------------------------------

SPEED, FRAME = 200.0, 1 / 60
ANGLES = np.radians((-70.0, -50.0, -30.0, -10.0, 10.0, 30.0, 50.0, 70.0))
HALF = 10.0
"""m, half the inside of the square of the corners."""


def bullets(method: Integrator, response: Response) -> Value:
    """Shoot discs of R = .1 m at 200 m/s, 3.3 m a step: count those through each target, of 16 phases x 8 angles."""
    wall = Wall(vertices=((0.0, -400.0), (0.0, 400.0)), radius=0.05)
    room = Block(centre=(0.0, 0.0), size=(2 * HALF, 2 * HALF), hollow=True)
    coming = wall.model_copy(update={"velocity": (-50.0, 0.0)})
    found = {
        "wall": _count_passes(method, response, wall, 0.0),
        "moving wall": _count_passes(method, response, coming, -50.0),
        "corner": _count_escapes(method, response, room),
        "head-on": _count_missed_pairs(method, response),
    }
    note = ", ".join(f"{name} {count}" for name, count in found.items())
    return Value(sum(found.values()), not any(found.values()), f"through, of 128 each: {note}")


def _shots() -> tuple[Floats, Floats]:
    """Return phase, in steps, and direction of 128 shots."""
    phase, angle = np.meshgrid(np.arange(PHASES) / PHASES, ANGLES)
    return phase.ravel(), np.stack([np.cos(angle.ravel()), np.sin(angle.ravel())], axis=1)


def _count_passes(method: Integrator, response: Response, wall: Shape, speed: float) -> int:
    """Return the number of discs that pass a wall that starts at x = 0 and moves at `speed`, m/s."""
    phase, direction = _shots()
    scene = disc_scene(method, response, FRAME, count=len(phase), obstacles=(wall,), restitution=0.5, agents=False)
    begin = -direction * (SPEED * FRAME * (1.5 + phase[:, None])) - (0.5, 0.0)
    state = batch(scene, begin[None], (SPEED * direction)[None])
    through = np.zeros(len(phase), bool)
    for k in range(30):
        state = scene.step(state, out=state)
        through |= state.pos[0, :, 0] > speed * (k + 1) * FRAME
    return int(through.sum())


def _count_escapes(method: Integrator, response: Response, room: Block) -> int:
    """Return the number of discs that leave a square, shot at and near its corner."""
    phase, _ = _shots()
    scene = disc_scene(method, response, FRAME, count=len(phase), obstacles=(room,), restitution=1.0, agents=False)
    angle = np.arctan2(HALF, HALF) + np.repeat(np.linspace(-0.05, 0.05, len(ANGLES)), PHASES)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    state = batch(scene, (-direction * phase[:, None] * SPEED * FRAME)[None], (SPEED * direction)[None])
    out = np.zeros(len(phase), bool)
    for _ in range(30):
        state = scene.step(state, out=state)
        out |= (np.abs(state.pos[0]) > HALF).any(axis=1)
    return int(out.sum())


def _count_missed_pairs(method: Integrator, response: Response) -> int:
    """Return the number of pairs, head-on at 400 m/s, that pass each other."""
    scene = disc_scene(method, response, FRAME, masses=(1.0, 1.0), restitution=0.5)
    phase, direction = _shots()
    far = direction * (SPEED * FRAME * (1.5 + phase[:, None]))
    state = batch(scene, np.stack([-far, far], axis=1), np.stack([SPEED * direction, -SPEED * direction], axis=1))
    for _ in range(30):
        state = scene.step(state, out=state)
    apart = ((state.pos[:, 1] - state.pos[:, 0]) * direction).sum(axis=1)
    return int((apart <= 0).sum())


# --- N08, P24: chains and mass ratios ---------------------------------------------------------------------------------

CHAINS: tuple[tuple[Sequence[float], Sequence[float], Sequence[float]], ...] = (
    ((1, 1, 1, 1, 1), (1, 0, 0, 0, 0), (0, 0, 0, 0, 1)),
    ((1, 1, 1, 1, 1), (1, 1, 0, 0, 0), (0, 0, 0, 1, 1)),
    ((1, 2, 1), (1, 0, 0), (-1 / 3, 2 / 9, 8 / 9)),
)
"""Masses in kg, velocities before and after in m/s."""


def cradle(method: Integrator, response: Response) -> Value:
    """Hit elastic chains with gaps of R / 20, numbered from either end, at two steps; check energy and momentum."""
    worst, kept = 0.0, 0.0
    for masses, before, after in CHAINS:
        for turned in (1, -1):
            for dt in (0.001, 0.1):
                m = np.array(masses[::turned], float)
                scene = disc_scene(method, response, dt, masses=m.tolist(), restitution=1.0)
                x = np.arange(len(m)) * 2.05 * R
                pos = np.stack([x[::turned], 0 * x], axis=1)
                vel = np.stack([np.array(before[::turned], float), 0 * x], axis=1)
                end = scene.run(batch(scene, pos[None], vel[None]), max(round(0.1 / dt), 5)).vel[0]
                off = np.abs(end - np.stack([np.array(after[::turned], float), 0 * x], axis=1)).max()
                energy = abs(m @ (end**2).sum(axis=1) / (m @ vel[:, 0] ** 2) - 1)
                worst = max(worst, float(off))
                kept = max(kept, float(energy), abs(float(m @ end[:, 0] / (m @ vel[:, 0]) - 1)))
    note = f"velocities off by {worst:.1g} m/s, energy and momentum by {kept:.1g} of theirs"
    return Value(worst, worst <= 1e-12 and kept <= 1e-12, note)


def uneven(method: Integrator, response: Response) -> Value:
    """Collide 1 kg and 1e3 ... 1e12 kg, either moving, elastically; check energy, and momentum in units of m2 v."""
    energy, momentum = 0.0, 0.0
    for heavy in (1e3, 1e6, 1e9, 1e12):
        for v1, v2 in ((1.0, 0.0), (0.0, -1.0)):
            scene = disc_scene(method, response, 0.01, masses=(1.0, heavy), restitution=1.0)
            m, v = np.array([1.0, heavy]), np.array([[v1, 0.0], [v2, 0.0]])
            end = scene.run(batch(scene, [[[0.0, 0.0], [0.3, 0.0]]], v[None]), 40).vel[0]
            start = m @ v[:, 0] ** 2
            energy = max(energy, abs(float(m @ (end**2).sum(axis=1) / start) - 1))
            momentum = max(momentum, abs(float(m @ end[:, 0] - m @ v[:, 0])) / heavy)
            energy = max(energy, 0.0 if end[0, 0] < end[1, 0] else 1.0)  # they part
    note = f"energy off by {energy:.1g}, momentum by {momentum:.1g} m2 v"
    return Value(energy, energy <= 1e-12 and momentum <= 1e-15, note)


# --- P28: fifty in one place ------------------------------------------------------------------------------------------


def one_place(method: Integrator, response: Response) -> Value:
    """Start 50 discs in one place: they must part within 1 s, with no preferred direction, drift, or high speeds."""
    scene = disc_scene(method, response, 0.02, count=50)
    state, fast = batch(scene, np.zeros((1, 50, 2)), 0.0), 0.0
    for _ in range(50):
        state = scene.step(state, out=state)
        fast = max(fast, float(np.abs(state.vel).max()))
    pos = state.pos[0]
    deep, drift = overlap(pos, R) / R, float(np.abs(pos.mean(axis=0)).max())
    spread = np.linalg.eigvalsh(np.cov(pos.T))
    long = float(math.sqrt(spread[1] / max(spread[0], 1e-300)))
    momentum = float(np.abs(state.vel[0].sum(axis=0)).max())
    holds = deep <= 0.01 and drift <= 1e-12 and momentum <= 1e-12 and long <= 2 and fast <= 1.0
    note = (
        f"overlap {deep:.1%} of R, drift {drift:.1g} m, momentum {momentum:.1g} m/s, {long:.2f} times as long as wide, "
        f"at most {fast:.1g} m/s"
    )
    return Value(deep, holds, note)


# --- N17: far away ----------------------------------------------------------------------------------------------------


def gas(method: Integrator, response: Response, offset: float = 0.0, dtype: str = "float64") -> Scene:
    """Return 24 discs in a square room about (offset, -offset)."""
    room = Block(centre=(offset, -offset), size=(3.0, 3.0), hollow=True)
    scene = disc_scene(method, response, 0.01, count=24, obstacles=(room,), restitution=0.9)
    near = Spawn(low=(offset - 1, -offset - 1), high=(offset + 1, -offset + 1))
    groups = (scene.groups[0].model_copy(update={"spawn": near}),)
    given = {name: getattr(scene, name) for name in ("effects", "obstacles", "integrator", "constraints", "dt")}
    return Scene(groups=groups, dtype=dtype, **given)


def far_away(method: Integrator, response: Response) -> Value:
    """Compare a gas at 0, 1e4 and 1e7 m after .3 s, in float64; float32 must refuse the latter two (float_range.py)."""
    place = np.stack(np.meshgrid(np.linspace(-1.2, 1.2, 6), np.linspace(-1.2, 1.2, 4)), axis=-1).reshape(24, 2)
    rng = np.random.default_rng(0)
    place, vel = place + rng.uniform(-0.05, 0.05, place.shape), rng.normal(size=place.shape)
    ends: list[Floats] = []
    impacts = 0
    for offset in (0.0, 1e4, 1e7):
        scene = gas(method, response, offset)
        state: State = scene.run(batch(scene, place + np.array((offset, -offset)), vel), 30)
        ends.append(state.pos[0] - (offset, -offset))
        impacts = int(state.count_of("impacts"))
    off = max(float(np.abs(end - ends[0]).max()) for end in ends[1:])
    refused = 0
    for offset in (1e4 + 1, 1e7):
        try:
            gas(method, response, offset, "float32")
        except ValueError:
            refused += 1
    note = f"{off:.2g} m apart after .3 s and {impacts} impacts; float32 refused: {refused == 2}"
    return Value(off, off <= 1e-6 and refused == 2, note)


IMPACTS = (
    *cases_by_response("N05", "ball, e = .8, 16 phases", "tops 2 %, 4.064 s +- 2 %, then at rest, y >= 0", bouncing),
    *cases_by_response("N06", "elastic ball, 100 bounces", "top <= 1.01 h; in time: h +- 1e-6", elastic),
    *cases_by_response("N07", "bullets: wall, moving wall, corner, each other", "0 through, of 16 x 8 each", bullets),
    *cases_by_response("N08", "cradle; 1, 2, 1 kg; both orders", "velocities, energy, momentum 1e-12", cradle),
    *cases_by_response("N17", "a gas at 0, 1e4, 1e7 m", "1e-6 m; float32 refused", far_away),
    *cases_by_response("P24", "1 kg and 1e3 ... 1e12 kg", "energy 1e-12, momentum 1e-15 m2 v", uneven),
    *cases_by_response("P28", "50 discs in one place", "apart within 1 s, no drift, no direction", one_place),
)
