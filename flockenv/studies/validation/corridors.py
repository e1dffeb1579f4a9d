"""Cases of endless corridors: the fundamental diagram, in two and in one dimension, and lanes.

Each lies along the middle of a torus that is so wide that no force reaches around it.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from flockenv.geometry.cell_list import FEWEST_AGENTS
from flockenv.geometry.shapes import Wall
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Course
from flockenv.scene import Scene
from flockenv.studies.measures import (
    above_null,
    classical_density,
    lanes,
    single_file_speed,
    speed_in_area,
    weidmann_speed,
)
from flockenv.studies.trial_log import Case, Value
from flockenv.studies.validation.walk import (
    SHAKEN,
    STEPS,
    Floats,
    Scenes,
    empty_group,
    filling_grid,
    people,
    run_walk,
    scene_of,
    wall,
)

__all__ = ["CORRIDORS", "SCENES", "endless", "start_on_grid"]

EDGE = 32.0
"""m, size of the torus across the corridor, and least length of one: the largest radius of a preset is 15 m."""

WIDTH = 4.0
ROOMY = 0.8
"""m^2 per agent; if each has less, cells fill the corridor from wall to wall."""

DENSITIES = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
ALONG = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75)
"""1/m^2, and 1/m in single file."""

DENSE = {"helbing_farkas_vicsek_2000": 0.001}
"""s, one step if bodies overlap from the start: those of 2000 are .6 m across, so that 3 per m^2 cover .85 of it."""

SECONDS, DROPPED = 30.0, 12.0
LANE_SEEDS, LANE_SECONDS, LANE_LAST = 20, 60.0, 20.0
EACH_WAY = 48


def endless(
    name: str, counts: tuple[int, int], length: float = EDGE, width: float = WIDTH,
    directions: tuple[int, int] = (1, -1), dense: bool = False,
) -> Scene:  # fmt: skip
    """Return two groups in an endless corridor, each with its direction; dense: with bodies that overlap.

    Each begins in a half of its own; `start_on_grid` mixes them.
    """
    middle, half = EDGE / 2, length / 2
    groups = []
    for k, count in enumerate(counts):
        file = half / count  # length per person in single file
        roomy = half * width / count > ROOMY
        beside = (0.3 if roomy else 0.0) if width > 1 else (width - file) / 2  # m, from the walls to where cells begin
        low, high = (k * half, middle - width / 2 + beside), ((k + 1) * half, middle + width / 2 - beside)
        begin = {}
        if width <= 1:
            begin = {"spawn": Spawn(low=low, high=high, spacing=file, wider=dense, jitter=SHAKEN if dense else 0.0)}
        elif not roomy:
            begin = {"spawn": filling_grid(count, low, high, people(name, count, low, high).widest)}
        groups.append(people(name, count, low, high, **begin))
    if sum(counts) < FEWEST_AGENTS:  # small and large crowds then share a kernel
        groups.append(empty_group(name, (half, middle), FEWEST_AGENTS - sum(counts)))
    aims = [Course(group=k, direction=(direction, 0)) for k, direction in enumerate(directions)]
    return scene_of(
        name, groups, aims, space=Torus(size=(length, EDGE)), obstacles=_side_walls(length, middle, width),
        dt=(DENSE if dense else STEPS).get(name, 0.02),
    )  # fmt: skip


def _side_walls(length: float, middle: float, width: float) -> tuple[Wall, ...]:
    """Return both walls, in thirds: on a torus a shape may not be longer than half of it."""
    cuts = np.linspace(0.0, length, 4)
    return tuple(
        wall((float(a), middle + side * width / 2), (float(b), middle + side * width / 2))
        for side in (-1, 1)
        for a, b in pairwise(cuts)
    )


def start_on_grid(scene: Scene, length: float, width: float, worlds: int = 1, seed: int = 0) -> State:
    """Return a start at rest on a grid that fills the corridor; each world has a permutation of its own."""
    count = sum(scene.living)
    rows = max(1, round(np.sqrt(count * width / length)))
    columns = -(-count // rows)
    k = np.arange(count)
    x = (k // rows + 0.5) * length / columns
    y = EDGE / 2 - width / 2 + (k % rows + 0.5) * width / rows
    begin = scene.start(seed, worlds)
    grid, pos = np.stack([x, y], axis=1), np.array(begin.pos)
    for b in range(worlds):
        rng = np.random.default_rng([seed, b])
        pos[b, :count] = grid[rng.permutation(count)] + rng.uniform(-0.02, 0.02, (count, 2))
    return begin.with_motion(pos, np.zeros_like(pos))


def _one_way_crowd(name: str, density: float) -> Scene:
    """Return a crowd of some density, 1/m^2, with one direction of walking."""
    count = max(100, round(density * EDGE * WIDTH))
    return endless(name, (count // 2, count - count // 2), count / (density * WIDTH), WIDTH, (1, 1), density > 2)


def _single_file(name: str, density: float) -> Scene:
    """Return people in single file, `density` of them per m."""
    count = round(density * EDGE)
    return endless(name, (count // 2, count - count // 2), EDGE, 0.8, (1, 1), density > 1.25)


SCENES: Scenes = {
    "rimea 4": {f"{density:g} per m2": partial(_one_way_crowd, density=density) for density in DENSITIES},
    "rimea 16": {f"{density:g} per m": partial(_single_file, density=density) for density in ALONG},
    "lanes": {"": partial(endless, counts=(EACH_WAY, EACH_WAY))},
}
"""Builders of scenes from a preset's name, by case and by the variant of the scene."""


def rimea_4(name: str) -> Value:
    """Measure the fundamental diagram at .5 to 3 people per m^2, all in one direction, in the last 18 of 30 s."""
    cloud: dict[str, list[float]] = {"density": [], "speed": []}
    means = []
    for built in SCENES["rimea 4"].values():
        scene = built(name)
        length = scene.space.extent(2)[0]
        run = run_walk(scene, SECONDS, every=1.0, begin=start_on_grid(scene, length, WIDTH))
        late = run.time > DROPPED
        pos, vel = run.pos[late, 0], run.vel[late, 0]
        means.append(float(vel[..., 0].mean()))
        for k in range(3):
            area = _area(length * (k + 0.5) / 3)
            cloud["density"] += classical_density(pos[::4], area).tolist()
            cloud["speed"] += speed_in_area(pos[::4], vel[::4], area, along=(1, 0)).tolist()
    rho, v = np.array(DENSITIES), np.array(means)
    off = v - weidmann_speed(rho)
    falls = bool((np.diff(v) < 0).all())
    worst = float(off[np.abs(off).argmax()])
    note = (
        f"v = {_number_list(v)} m/s at {_number_list(rho)} per m^2; {'falls' if falls else 'does not fall everywhere'}"
    )
    series = {**cloud, "densities": rho.tolist(), "speeds": v.tolist()}
    return Value(worst, falls and abs(worst) <= 0.25, note, series)


def _area(x: float) -> list[tuple[float, float]]:
    """Return the corners of 4 x 4 m of corridor."""
    low, high = EDGE / 2 - WIDTH / 2, EDGE / 2 + WIDTH / 2
    return [(x - 2, low), (x + 2, low), (x + 2, high), (x - 2, high)]


def rimea_16(name: str) -> Value:
    """Measure the fundamental diagram of single file: a corridor .8 m wide, with .5 to 1.75 people per m."""
    means = []
    for built in SCENES["rimea 16"].values():
        scene = built(name)
        count = sum(scene.living)
        run = run_walk(scene, SECONDS, every=1.0, begin=start_on_grid(scene, EDGE, 0.8 / 4))
        means.append(float(run.vel[run.time > DROPPED, 0, :count, 0].mean()))
    rho, v = np.array(ALONG), np.array(means)
    off = v - np.minimum(single_file_speed(rho), 1.34)
    worst = float(off[np.abs(off).argmax()])
    falls = bool((np.diff(v) < 0).all())
    note = f"v = {_number_list(v)} m/s at {_number_list(rho)} per m; {'falls' if falls else 'does not fall everywhere'}"
    return Value(worst, falls and abs(worst) <= 0.25, note, {"densities": rho.tolist(), "speeds": v.tolist()})


def _number_list(values: Floats) -> str:
    return ", ".join(f"{x:.2f}" for x in values)


def lanes_of(name: str) -> Value:
    """Measure the lane order of 48 people per direction in 4 m of width above its permutation null, over 20 seeds."""
    scene = SCENES["lanes"][""](name)
    run = run_walk(
        scene, LANE_SECONDS, worlds=LANE_SEEDS, every=1.0, begin=start_on_grid(scene, EDGE, WIDTH, LANE_SEEDS)
    )
    late = run.time > LANE_SECONDS - LANE_LAST
    direction = np.repeat([1.0, -1.0], EACH_WAY)
    low, high = EDGE / 2 - WIDTH / 2, EDGE / 2 + WIDTH / 2
    found = [lanes(run.pos[late, b, :, 1], direction, low, high, deals=100) for b in range(LANE_SEEDS)]
    above = above_null([f.order for f in found], [f.null for f in found])
    speed = float((run.vel[late][..., 0] * direction).mean())
    note = (
        f"order {np.mean([f.order for f in found]):.3f}, null {np.mean([f.null for f in found]):.3f}; 95 % of the "
        f"excess {above.low:.3f} to {above.high:.3f}; p < .05 in {sum(f.p < 0.05 for f in found)} of {LANE_SEEDS}; "
        f"{speed:.2f} m/s forward"
    )
    x, y = run.pos[-5:, 0].reshape(-1, 2).T.round(2).tolist()
    series: dict[str, Any] = {"x": x, "y": y}
    return Value(above.excess, above.low > 0, note, series)


CORRIDORS = (
    Case("rimea 4", "fundamental diagram: furthest from Weidmann, m/s", "falls; within .25 for .5-3 /m2", rimea_4),
    Case("rimea 16", "single file: furthest from Seyfried 2005, m/s", "falls; within .25", rimea_16),
    Case("lanes", "48 + 48 in a corridor: order above its null", "> 0 with 95 %, 20 seeds", lanes_of),
)
