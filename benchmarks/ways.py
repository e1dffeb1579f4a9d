"""The cost of floor fields, and a picture of the choice of doors: `python -m benchmarks.ways --picture docs/ways.png`.

Measured: building a scene of 1,000 people in a building of 60 x 60 m with 120 walls on grids of 0.2 and 0.1 m; and
the cost of a step if they walk to the nearest of two doors, and if they choose the quickest.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np

from flockenv.behaviours import Driving, LineUp, Separation
from flockenv.behaviours.steer import Steer
from flockenv.geometry.eikonal import ground
from flockenv.geometry.shapes import Wall
from flockenv.geometry.space import Box
from flockenv.model.appearance import Appearance
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Door, Routes, Way
from flockenv.render import draw, write_png
from flockenv.scene import Group, Scene

EXITS = (Door(ends=((59.0, 4.0), (59.0, 6.0))), Door(ends=((1.0, 54.0), (1.0, 56.0))))
COLOURS = ("#d55e00", "#0072b2", "#52637a")


def building(effect: Way | Routes) -> Scene:
    """Return 6 x 6 rooms of 10 m, each with a door of 1.2 m to the right and to the top."""
    walls: list[Wall] = []
    for x in range(0, 60, 10):
        for y in range(0, 60, 10):
            if x < 50:
                walls += [_wall((x + 10, y), (x + 10, y + 4.4)), _wall((x + 10, y + 5.6), (x + 10, y + 10))]
            if y < 50:
                walls += [_wall((x, y + 10), (x + 4.4, y + 10)), _wall((x + 5.6, y + 10), (x + 10, y + 10))]
    people = Group(count=1000, radius=0.2, mass=70, desired_speed=1.3, spawn=Spawn(low=(1, 1), high=(59, 59)))
    return Scene(
        space=Box(size=(60, 60)), groups=(people,), obstacles=tuple(walls), effects=(effect, Driving()), dt=0.02
    )


def _wall(start: tuple[float, float], end: tuple[float, float]) -> Wall:
    return Wall(vertices=(start, end), radius=0.1)


def room() -> Scene:
    """Return 120 people in the left half of a room of 16 x 8 m, with a door of 1 m on the left, one of 2 m right."""
    left, right = ((0.0, 3.5), (0.0, 4.5)), ((16.0, 3.0), (16.0, 5.0))
    walls = (
        Wall(vertices=(left[0], (0, 0), (16, 0), right[0]), radius=0.1),
        Wall(vertices=(left[1], (0, 8), (16, 8), right[1]), radius=0.1),
    )
    people = Group(
        count=120, radius=0.2, mass=70, desired_speed=1.3, max_force=1500,
        spawn=Spawn(low=(1, 0.5), high=(9, 7.5), spacing=0.6, jitter=0.1),
    )  # fmt: skip
    routes = Routes(doors=(Door(ends=left), Door(ends=right)), spacing=0.1)
    steer = Steer(behaviours=(LineUp(margin=0.05), Separation(weight=60, radius=0.6)))
    return Scene(groups=(people,), obstacles=walls, effects=(routes, steer), dt=0.02)


def picture(path: Path, seconds: float = 3.0) -> None:
    """Draw the room, each agent in the colour of the door that it walks to."""
    scene = room()
    state = scene.run(scene.start(1), round(seconds / scene.dt))
    door = np.array(scene.inner(state, "door")[0]).astype(np.int32)
    looks = tuple(Appearance(form="disc", colours=(colour,)) for colour in COLOURS)
    write_png(path, draw(dataclasses.replace(scene.snapshot(state), looks=looks, look=door), 900, 3))
    print(f"{path}: {(door == 0).sum()} head for the left door, {(door == 1).sum()} for the right one, "
          f"{(door == 2).sum()} are out")  # fmt: skip


def main() -> None:
    """Measure, or draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path, help="draw the room instead of measuring")
    given = parser.parse_args()
    if given.picture:
        picture(given.picture)
        return
    building(Way(targets=EXITS[:1], spacing=0.5)).start(0)  # compiled before anything is measured
    for spacing in (0.2, 0.1):
        ground.cache_clear()
        begin = time.perf_counter()
        building(Way(targets=EXITS, spacing=spacing))
        print(f"building a scene, grid of {spacing:g} m: {time.perf_counter() - begin:.2f} s")
    for effect in (Way(targets=EXITS, spacing=0.2), Routes(doors=EXITS, spacing=0.2)):
        scene = building(effect)
        state = scene.step(scene.start(0))
        times = []
        for _ in range(7):
            begin = time.perf_counter()
            scene.step(state, steps=50)
            times.append((time.perf_counter() - begin) / 50 * 1e6)
        print(f"{effect.kind} and driving, 1,000 people: {min(times):.0f} us a step, at best of 7")


if __name__ == "__main__":
    main()
