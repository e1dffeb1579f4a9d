"""Cases of doors, bottlenecks and rooms: times of evacuation, and flows.

Names and bounds are those of RiMEA, NIST TN 1822 and JuPedSim's tests, with flows of measured bottlenecks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from flockenv.model.state import State
from flockenv.physics.integrators import DormandPrince, Integrator, SemiImplicitEuler
from flockenv.scene import Scene
from flockenv.studies.measures import Crossings, above_null, bursts, classical_density, crossings, flow
from flockenv.studies.trial_log import Case, Value
from flockenv.studies.validation.rooms import (
    bottleneck,
    corner,
    counterflow,
    door_between,
    is_empty,
    many_rooms,
    public_room,
    room,
    straight_corridor,
)
from flockenv.studies.validation.walk import Floats, Scenes, Walk, run_walk

__all__ = ["DATA", "DOORS", "SCENES", "WIDTHS"]

DATA = {0.8: (1.29, 1.46), 1.0: (1.71, 2.02), 1.2: (2.03, 2.36)}
"""1/s, from and to, by the width of a long bottleneck, m: three experiments (JuPedSim's validation, test 13)."""

WIDTHS = tuple(DATA)
SEEDS = 3
NERVOUS = "helbing_farkas_vicsek_2000"
FASTER = (1.0, 1.5, 2.0, 3.0, 5.0)
"""m/s, desired speeds of people that leave a room."""

FASTER_SEEDS = 20
BURST_SEEDS = 20


AGAINST = (0, 10, 50, 100)
"""Numbers of people that walk against 100 (NIST 2.8)."""


def _room_of_2000(name: str, speed: float) -> Scene:
    return room(name, 200, (15.0, 15.0), 1.0, speed, dt=0.0025)


def _shut_room(name: str, method: Integrator, dt: float) -> Scene:
    return room(name, 200, (15.0, 15.0), 0.0, 1.5, integrator=method, dt=dt)


SCENES: Scenes = {
    "rimea 6": {"": lambda name: corner(name, 20, 2.0, 10.0, 8.0)},
    "rimea 15": {
        "short": lambda name: straight_corridor(name, 100, 4.0, 36.0, 16.0),
        "corner": lambda name: corner(name, 100, 4.0, 18.0, 16.0),
        "long": lambda name: straight_corridor(name, 100, 4.0, 44.0, 16.0),
    },
    "rimea 9": {f"{doors} doors": partial(public_room, count=1000, doors=doors) for doors in (4, 2)},
    "rimea 12": {f"{width:g} m": partial(bottleneck, width=width) for width in WIDTHS},
    "nist 2.8": {f"against {back}": partial(counterflow, there=100, back=back) for back in AGAINST},
    "nist 3.1": {"": many_rooms},
    "nist 5.1": {"": lambda name: room(name, 100, (10.0, 6.0), 1.0)},
    "bursts": {"": lambda name: door_between(name, 48, 1.0)},
    "faster is slower": {f"{speed:g} m per s": partial(_room_of_2000, speed=speed) for speed in FASTER},
    "pressed fixed": {"": partial(_shut_room, method=SemiImplicitEuler(), dt=0.005)},
    "pressed adaptive": {"": partial(_shut_room, method=DormandPrince(), dt=0.01)},
}
"""Builders of scenes from a preset's name, by case and by the variant of the scene."""


def _door_crossings(run: Walk, x: float, half: float, world: int = 0) -> Crossings:
    """Return the crossings of x between y = -half and half; forward is to the right."""
    return crossings(run.time, run.pos[:, world], [(x, -half), (x, half)], run.alive[:, world])


def _density(run: Walk, corners: Sequence[tuple[float, float]], world: int = 0) -> Floats:
    """Return people per m^2 between two corners, (T,), means over five instants."""
    (a, b), (c, d) = corners
    found = classical_density(run.pos[:, world], [(a, b), (c, b), (c, d), (a, d)], run.alive[:, world])
    return np.convolve(found, np.full(5, 0.2), "valid")


def _time_until_out(run: Walk, world: int = 0, share: float = 1.0) -> float:
    """Return the time at which all were out, s, or a share of all; NaN if some of those are still in."""
    gone = np.sort(run.leaving_times(world)[run.alive[0, world]])  # NaN come last
    return float(gone[math.ceil(share * len(gone)) - 1])


def _count_wall_crossings(scene: Scene, run: Walk) -> int:
    """Return how many paths from one instant to the next cross a wall."""
    many = 0
    for shape in scene.shapes:
        vertices: Any = getattr(shape, "vertices", ())
        for a, b in pairwise(vertices):
            for world in range(run.pos.shape[1]):
                many += len(crossings(run.time, run.pos[:, world], [a, b], run.alive[:, world]).time)
    return many


# --- around corners ---------------------------------------------------------------------------------------------------


def rimea_6(name: str) -> Value:
    """Measure the time of 20 people around a left corner: less than 60 s, and no path may cross a wall."""
    scene = SCENES["rimea 6"][""](name)
    run = run_walk(scene, 90, until=is_empty)
    took, through = _time_until_out(run), _count_wall_crossings(scene, run)
    late = int(run.alive[-1].sum())
    note = f"{through} times through a wall" + (f"; {late} of 20 stuck" if late else "")
    return Value(took, took < 60 and through == 0, note)


def rimea_15(name: str) -> Value:
    """Compare a crowd's time around a corner with those along corridors as long as its inner and its outer path."""
    times, note = [], ""
    for what, built in SCENES["rimea 15"].items():
        run = run_walk(built(name), 150, until=is_empty)
        inside = int(run.alive[-1].sum())
        times.append(_time_until_out(run))
        note += f"{what} {times[-1]:.1f} s, " if not inside else f"{what}: {inside} of 100 stuck, "
    short, around, long = times
    return Value(around, short <= around <= long, note.rstrip(", "))


# --- out of rooms -----------------------------------------------------------------------------------------------------


def rimea_9(name: str) -> Value:
    """Compare the evacuation times of 1000 people from a public room by two doors and by four."""
    times, most, note = [], [], ""
    for (doors, built), longest in zip(SCENES["rimea 9"].items(), (400.0, 800.0), strict=True):
        run = run_walk(built(name), longest, every=0.5, until=is_empty)
        times.append(_time_until_out(run))
        most.append(_time_until_out(run, share=0.95))
        inside = int(run.alive[-1].sum())
        note += f"{doors} {times[-1]:.1f} s; " if not inside else f"{doors}: {inside} stuck; "
    ratio, of_most = times[1] / times[0], most[1] / most[0]
    if np.isfinite(of_most):
        note += f"until 95 % are out {most[0]:.1f} and {most[1]:.1f} s, ratio {of_most:.2f}"
    return Value(ratio, 1.6 <= ratio <= 2.4, note.rstrip("; "))


def rimea_12(name: str) -> Value:
    """Compare flows of 150 people through a passage of 5 m, .8, 1.0 and 1.2 m wide, with measured ones."""
    found, jams, notes, through = [], True, [], 0
    for width, built in zip(WIDTHS, SCENES["rimea 12"].values(), strict=True):
        scene = built(name)
        run = run_walk(scene, 300, worlds=SEEDS, until=is_empty)
        entry, leave, ahead, behind = [], [], [], []
        for b in range(SEEDS):
            entry.append(flow(_door_crossings(run, 2.5, width / 2, b), width, run.time[-1]).passing)
            leave.append(flow(_door_crossings(run, 15.0, width / 2, b), width, run.time[-1]).passing)
            ahead.append(float(np.median(_density(run, ((-2.0, -1.0), (0.0, 1.0)), b)[50:300])))
            behind.append(float(np.median(_density(run, ((13.0, -1.0), (15.0, 1.0)), b)[50:300])))
        found.append(float(np.nan_to_num(np.median(entry))))  # without passages the flow is 0
        jams &= bool(np.median(ahead) > np.median(behind) and np.median(entry) - np.median(leave) >= -0.05)
        stuck, through = int(run.alive[-1].sum()), through + _count_wall_crossings(scene, run)
        notes.append(
            f"w = {width:g}: J = {found[-1]:.2f} ({min(entry):.2f}-{max(entry):.2f}), exit {np.median(leave):.2f} /s, "
            f"density before {np.median(ahead):.1f}, before the exit {np.median(behind):.1f} /m2"
            + (f", {stuck} stuck of {SEEDS} x 150" if stuck else "")
        )
    grows = found[0] < found[1] < found[2]
    notes.append("grows" if grows else "does not grow")
    notes.append("jam before the bottleneck alone" if jams else "jams elsewhere")
    notes.append(f"{through} times through a wall")
    off = [_excess_over(j, DATA[w]) for j, w in zip(found, WIDTHS, strict=True)]
    worst = max(off, key=abs)
    series = {"width": list(WIDTHS), "flow": found}
    return Value(worst, grows and jams and not through and abs(worst) <= 0.15, "; ".join(notes), series)


def _excess_over(flow_: float, band: tuple[float, float]) -> float:
    """Return the excess of a flow over a band as a share of its edge, negative below it; 0 within."""
    low, high = band
    return flow_ / low - 1 if flow_ < low else max(0.0, flow_ / high - 1)


def nist_3_1(name: str) -> Value:
    """Measure the share of 23 people, in 12 rooms with two exits, that leave by their assigned exit, %."""
    scene = SCENES["nist 3.1"][""](name)
    run = run_walk(scene, 120, until=is_empty)
    right = np.zeros(23)
    for k in range(23):
        here = np.flatnonzero(run.alive[:, 0, k])[-1]
        right[k] = run.alive[-1, 0, k] == 0 and (run.pos[here, 0, k, 0] > 12) == (k < 15)
    share, inside = 100 * float(right.mean()), int(run.alive[-1].sum())
    note = f"the last after {_time_until_out(run):.1f} s" if not inside else f"{inside} stuck"
    wrong = 23 - inside - int(right.sum())
    return Value(
        share,
        share == 100,
        f"{note}; {wrong} by the other exit; {_count_wall_crossings(scene, run)} times through a wall",
    )


def nist_5(name: str) -> tuple[Walk, float]:
    """Run 100 people out of a room by a door of 1 m; return the run, and the time it took, s.

    The room is 10 x 6 m: 8 x 5 m, NIST's and IMO's, has no room for 100 bodies .7 m across.
    """
    run = run_walk(SCENES["nist 5.1"][""](name), 200, until=is_empty)
    return run, _time_until_out(run)


def _outcome_text(run: Walk, took: float) -> str:
    """Return, as text, the time at which all were out, or the number of people still in."""
    return f"out after {took:.1f} s" if np.isfinite(took) else f"{int(run.alive[-1].sum())} stuck"


def nist_5_1(name: str) -> Value:
    """Compare the largest density before the door with that beyond it."""
    run, took = nist_5(name)
    peaks = [float(_density(run, corners).max()) for corners in (((-1.5, -1.0), (0.0, 1.0)), ((0.0, -0.5), (2.0, 0.5)))]
    note = f"at the door {peaks[0]:.1f}, beyond it {peaks[1]:.1f} per m^2; {_outcome_text(run, took)}"
    return Value(peaks[0] / peaks[1] if peaks[1] else np.inf, peaks[0] > peaks[1], note)


def nist_5_2(name: str) -> Value:
    """Measure the specific flow through a door of 1 m."""
    run, took = nist_5(name)
    found = flow(_door_crossings(run, 0.0, 0.5), 1.0, run.time[-1])
    verdict = "not above" if found.passing <= 1.33 else "above"
    return Value(found.passing, None, f"{verdict} IMO's 1.33 /(m s); {_outcome_text(run, took)}")


# --- two directions ---------------------------------------------------------------------------------------------------


def nist_2_8(name: str) -> Value:
    """Count how many of 100 people get through a corridor against 0, 10, 50 and 100 others."""
    done, last = [], []
    for built in SCENES["nist 2.8"].values():
        run = run_walk(built(name), 400, every=0.5, until=is_empty)
        gone = run.leaving_times()[:100]
        done.append(int(np.isfinite(gone).sum()))
        last.append(float(np.nanmax(gone)) if done[-1] else float("nan"))
    falls = all(a >= b for a, b in pairwise(done))
    note = ", ".join(f"{n} in {t:.0f} s" if n else "0" for n, t in zip(done, last, strict=True))
    return Value(done[-1], falls, f"against 0, 10, 50, 100: {note}")


def door_bursts(name: str) -> Value:
    """Test whether bursts of 48 people per direction at a door of 1 m are longer than by chance, over 20 seeds."""
    scene = SCENES["bursts"][""](name)
    run = run_walk(scene, 120, worlds=BURST_SEEDS, every=0.2, until=is_empty)
    found, nulls, through, stuck = [], [], 0, 0
    for b in range(BURST_SEEDS):
        crossed = _door_crossings(run, 0.0, 0.5, b)
        through += len(crossed.time)
        stuck += int(run.alive[-1, b].sum())
        both = [crossed.time[crossed.sign == s] for s in (-1, 1)]
        until = min((t[-1] for t in both), default=0.0) if all(len(t) for t in both) else 0.0
        one = bursts(crossed.sign[crossed.time <= until])
        found.append(one.length)
        nulls.append(one.null_length)
    note = f"{stuck} of {BURST_SEEDS * 96} still there after {run.time[-1]:.0f} s"
    if np.isfinite(nulls).sum() < 5:
        return Value(np.nan, False, f"too few crossings both ways for a null: {through}; {note}")
    above = above_null(found, nulls)
    note = (
        f"bursts of {np.nanmean(found):.2f}, by chance {np.nanmean(nulls):.2f}; 95 % of the excess {above.low:.2f} to "
        f"{above.high:.2f}; {note}"
    )
    return Value(above.excess, above.low > 0, note)


# --- the room of 2000 -------------------------------------------------------------------------------------------------


def faster_is_slower(name: str) -> Value:
    """Measure the evacuation time of 200 people from 15 x 15 m by a door of 1 m, by desired speed."""
    medians, lows, highs, stuck = [], [], [], 0
    for built in SCENES["faster is slower"].values():
        run = run_walk(built(name), 300, worlds=FASTER_SEEDS, every=0.5, until=is_empty)
        times = np.array([_time_until_out(run, b) for b in range(FASTER_SEEDS)])
        stuck += int(np.isnan(times).sum())
        times = np.where(np.isnan(times), run.time[-1], times)
        medians.append(float(np.median(times)))
        lows.append(float(np.quantile(times, 0.25)))
        highs.append(float(np.quantile(times, 0.75)))
    best = FASTER[int(np.argmin(medians))]
    note = ", ".join(f"{v:g} m/s {t:.0f} s" for v, t in zip(FASTER, medians, strict=True))
    note += f"; medians of {FASTER_SEEDS} seeds, {stuck} runs with stuck people"
    series = {"speed": list(FASTER), "time": medians, "low": lows, "high": highs}
    return Value(best, None, note, series)


def push_against_door(how: str) -> Callable[[str], Value]:
    """Return the trial of 200 people that push against a shut door for ten minutes: all numbers stay finite."""

    def trial(name: str) -> Value:
        scene = SCENES[f"pressed {how}"][""](name)
        state, dt = scene.start(0), scene.dt
        for _ in range(10):
            state = scene.step(state, steps=round(60 / dt))
        inside = int(((state.pos[0, :200, 0] < 0) & state.alive[0, :200]).sum())
        note = (
            f"{scene.integrator.kind}, steps of {dt:g} s: fastest {_fastest(state):.2f} m/s, {inside} of 200 still in"
        )
        return Value(float(state.time[0]), bool(np.isfinite(state.x).all()), note)

    return trial


def _fastest(state: State) -> float:
    return float(np.linalg.norm(state.vel[state.alive], axis=-1).max())


DOORS = (
    Case("rimea 6", "20 people around a corner (NIST 2.3), s", "< 60 s, no wall crossed", rimea_6),
    Case("rimea 15", "100 people around a corner, s", "short <= corner <= long", rimea_15),
    Case("rimea 9", "1000 people, two doors against four", "1.6-2.4", rimea_9),
    Case(
        "rimea 12",
        "flow through .8, 1.0, 1.2 m: off the data by",
        "grows; within 15 %; jam before it alone; no wall crossed",
        rimea_12,
    ),
    Case("nist 2.8", "counterflow: of 100 against 100 through", "the fewer the more come against", nist_2_8),
    Case("nist 3.1", "23 people, 12 rooms: by the assigned exit, %", "100 %", nist_3_1),
    Case("nist 5.1", "density at a door against that beyond it", "> 1", nist_5_1),
    Case("nist 5.2", "flow by a door of 1 m, /(m s)", "against IMO's 1.33", nist_5_2),
    Case("bursts", "48 + 48 through a door: bursts above a coin's", "> 0 with 95 %, 20 seeds", door_bursts),
    Case("faster is slower", "200 people, door of 1 m: quickest at, m/s", "reported", faster_is_slower, (NERVOUS,)),
    Case(
        "pressed fixed",
        "200 people, shut door, semi-implicit: finite for, s",
        "600 s",
        push_against_door("fixed"),
        (NERVOUS,),
    ),
    Case(
        "pressed adaptive",
        "200 people, shut door, Dormand-Prince: finite for, s",
        "600 s",
        push_against_door("adaptive"),
        (NERVOUS,),
    ),
)
