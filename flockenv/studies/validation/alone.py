"""Cases of people that walk alone: speed in a corridor, and in a rotated one; speeds by age.

Names and bounds are those of RiMEA, NIST TN 1822 and JuPedSim's tests (Juelich).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from flockenv.model.distribution import Spread
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Course, Journey, Stage
from flockenv.scene import Scene
from flockenv.studies.trial_log import Case, Value
from flockenv.studies.validation.walk import Floats, Scenes, lane, people, run_walk, scene_of, wall

__all__ = ["ALONE", "SCENES", "corridor", "crossing_time"]

TABLE = ((0.58, 1.61), (1.41, 1.54), (0.68, 1.41), (0.46, 0.76))
"""m/s, from and to: below 30 years, 30 to 50, above, and the handicapped (RiMEA 7, by Weidmann's table)."""

AGES = (13, 13, 12, 12)
"""Number of people in each age group."""


def corridor(name: str, speed: float, *, length: float, degrees: float = 0.0, moving: bool = False) -> Scene:
    """Return one person in a corridor 2 m wide that walks along it from x = 0, first at rest or at its speed."""
    turn = np.exp(1j * np.radians(degrees))

    def rotate(x: float, y: float) -> tuple[float, float]:
        at = complex(x, y) * turn
        return at.real, at.imag

    begin = (0.0, 0.0)
    spawn = Spawn(low=begin, high=begin, speed=(speed, speed) if moving else (0.0, 0.0), heading=rotate(1.0, 0.0))
    one = people(name, 1, begin, begin, desired_speed=speed, spawn=spawn)
    walls = tuple(wall(*(rotate(*vertex) for vertex in side.vertices)) for side in lane(length + 10, 2.0, -5.0))
    return scene_of(name, [one], [Course(direction=rotate(1.0, 0.0))], obstacles=walls)


def gated_lane(name: str) -> Scene:
    """Return one person in a corridor that passes four gates, one after another."""
    begin = (0.0, 0.0)
    spawn = Spawn(low=begin, high=begin, speed=(1.0, 1.0), heading=(1.0, 0.0))
    one = people(name, 1, begin, begin, desired_speed=1.0, spawn=spawn)
    gates = tuple(Stage(ends=((x, -0.8), (x, 0.8))) for x in (2.5, 5.0, 7.5, 10.0))
    return scene_of(name, [one], [Journey(stages=gates, then="leave")], obstacles=lane(20, 2.0, -5.0))


def spaced_groups(name: str, spreads: Sequence[Spread], counts: Sequence[int]) -> Scene:
    """Return groups that walk along x, each person 20 m from all others."""
    groups, done = [], 0.0
    for spread, count in zip(spreads, counts, strict=True):
        spawn = Spawn(low=(0.0, done), high=(20.0, done + 20.0 * count), spacing=20.0)
        groups.append(people(name, count, (0, 0), (1, 1), desired_speed=spread, spawn=spawn))
        done += 20.0 * count
    walls = (wall((-500, -100), (500, -100)),)
    return scene_of(name, groups, [Course(direction=(1, 0))], obstacles=walls)


SCENES: Scenes = {
    "rimea 1": {"": partial(corridor, speed=1.33, length=40)},
    "nist 2.1": {"": partial(corridor, speed=1.0, length=60)},
    "juelich 2": {
        "straight": partial(corridor, speed=1.0, length=10, moving=True),
        "turned": partial(corridor, speed=1.0, length=10, degrees=45.0, moving=True),
    },
    "juelich 6": {"": gated_lane},
    "rimea 7": {"": partial(spaced_groups, spreads=[Spread(low=a, high=b) for a, b in TABLE], counts=AGES)},
    "nist 2.4": {
        f"seed {seed}": partial(spaced_groups, spreads=[Spread(mean=1.2, sd=0.2, seed=seed)], counts=(50,))
        for seed in (0, 1)
    },
}
"""Builders of scenes from a preset's name, by case and by the variant of the scene."""


def crossing_time(time: Floats, along: Floats, distance: float) -> float:
    """Return the time at which `along` first reaches a distance, s, between instants (T,); NaN if never."""
    if not (along >= distance).any():
        return float("nan")
    k = int((along >= distance).argmax())
    if k == 0:
        return float(time[0])
    share = (distance - along[k - 1]) / (along[k] - along[k - 1])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))


def _distances_walked(scene: Scene, seconds: float, degrees: float = 0.0) -> tuple[Floats, Floats]:
    """Return times (T,), s, and distances walked along the corridor, (T,) m."""
    run = run_walk(scene, seconds)
    direction = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    return run.time, run.pos[:, 0, 0] @ direction


def rimea_1(name: str) -> Value:
    """Measure the time for 40 m at 1.33 m/s, from rest."""
    took = crossing_time(*_distances_walked(SCENES["rimea 1"][""](name), 60), 40.0)
    return Value(took, 26.0 <= took <= 34.0, f"{took:.2f} s")


def nist_2_1(name: str) -> Value:
    """Measure the speed over 40 m, after 10 m."""
    time, along = _distances_walked(SCENES["nist 2.1"][""](name), 70)
    speed = 40.0 / (crossing_time(time, along, 50.0) - crossing_time(time, along, 10.0))
    return Value(speed, abs(speed - 1.0) <= 0.05, f"{speed:.4f} m/s")


def turned_corridor(name: str) -> Value:
    """Measure the time for 10 m at 1 m/s in a corridor at 45 degrees, and in one along x."""
    built = SCENES["juelich 2"]
    took = [
        crossing_time(*_distances_walked(built[how](name), 15, a), 10.0)
        for how, a in (("straight", 0.0), ("turned", 45.0))
    ]
    off = abs(took[1] - 10.0)
    return Value(off, off <= 0.1, f"{took[1]:.4f} s; not turned {took[0]:.4f} s, difference {took[1] - took[0]:.1g} s")


def way_points(name: str) -> Value:
    """Measure the time for 10 m at 1 m/s through four gates in order, with an initial speed of 1 m/s."""
    took = crossing_time(*_distances_walked(SCENES["juelich 6"][""](name), 15), 10.0)
    return Value(took, abs(took - 10.0) <= 0.1, f"{took:.3f} s")


def _free_speeds(scene: Scene) -> Floats:
    """Return the speed of each person after 6 s, m/s."""
    end = scene.run(scene.start(0), round(6 / scene.dt))
    return np.asarray(np.linalg.norm(end.vel[0], axis=1))


def rimea_7(name: str) -> Value:
    """Measure how far speeds of 50 adults are outside the ranges of their ages."""
    found = np.split(_free_speeds(SCENES["rimea 7"][""](name)), np.cumsum(AGES)[:-1])
    off = max(max(a - v.min(), v.max() - b, 0.0) for v, (a, b) in zip(found, TABLE, strict=True))
    ranges = ", ".join(f"{v.min():.2f}-{v.max():.2f}" for v in found)
    return Value(off, off <= 0.03, f"m/s by age: {ranges}")


def nist_2_4(name: str) -> Value:
    """Test whether walking speeds of 100 people with desired speeds of N(1.2, .2) m/s are normal."""
    from scipy.stats import kstest  # imported here: it looks for torch, and takes half a second

    speeds = np.concatenate([_free_speeds(built(name)) for built in SCENES["nist 2.4"].values()])
    p = float(kstest(speeds, "norm", args=(1.2, 0.2)).pvalue)
    return Value(p, p > 0.05, f"mean {speeds.mean():.3f}, deviation {speeds.std(ddof=1):.3f} m/s")


ALONE = (
    Case("rimea 1", "40 m of corridor at 1.33 m/s, s", "26-34 s", rimea_1),
    Case("nist 2.1", "speed in a corridor, at 1 m/s", "1.00 +- .05 m/s", nist_2_1),
    Case("juelich 2", "10 m at 1 m/s, turned by 45 degrees: off by, s", "<= .1 s", turned_corridor),
    Case("juelich 6", "10 m at 1 m/s by four way-points, s", "10 +- .1 s", way_points),
    Case("rimea 7", "50 adults by age: beyond the table by, m/s", "<= .03 m/s", rimea_7),
    Case("nist 2.4", "100 speeds of N(1.2, .2): p of Kolmogorov-Smirnov", "> .05", nist_2_4),
)
