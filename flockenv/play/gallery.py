"""Gallery: the scenes and tasks that ship with flockenv, with pictures, to be opened in the playground.

Pictures are in the folder `pictures` beside this file. To draw them anew: python -m flockenv.play.gallery [NAME ...]
"""

from __future__ import annotations

import functools
import io
import itertools
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from flockenv.core.bundled import bundled_scenes
from flockenv.core.errors import nearest, printable
from flockenv.players import trained_task
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS, Task

if TYPE_CHECKING:
    from flockenv.model.snapshot import Snapshot

__all__ = ["Entry", "description_of", "entries", "read_entry", "text_of"]

PICTURES = files("flockenv.play").joinpath("pictures")

WIDTH = 420
"""Width of a picture, pixels."""

TASK_SEED = 9
"""Seed of the tasks' pictures: with it Pursuit ends far from the walls, which pictures of 4:3 cut off."""

MOST_SENTENCES = 3
"""Sentences about a scene whose file says nothing."""

FIRST_NAMES = ("boids", "crowd_room", "fish", "cloth", "galaxy", "vicsek", "fireworks")
"""Scenes that come first, each within its family."""

FAMILIES = {
    "Crowds": {"driving", "line_up", "way", "routes", "journey", "follow_way", "unaligned_avoidance", "heuristics"},
    "Flocks": {"alignment", "cohesion", "vicsek", "boids"},
    "Solids and cloth": {
        "springs",
        "membrane",
        "elastic",
        "collisions",
        "face_collisions",
        "rigid_bodies",
        "rods",
        "slide",
        "contact",
    },
    "Particles and fields": set(),
}
"""Families of scenes, each with kinds of which one makes a scene one of that family; the first that fits counts."""

LISTED = ("Flocks", "Tasks", "Crowds", "Solids and cloth", "Particles and fields")
"""Families in the order in which they are shown."""


@dataclass(frozen=True)
class Entry:
    """A scene or task that can be opened."""

    name: str
    title: str
    description: str  # some sentences
    kind: str  # scene or task
    family: str
    picture: bytes | None  # PNG


@functools.cache
def entries() -> tuple[Entry, ...]:
    """Return all scenes and tasks that ship, by family."""
    order = [*FIRST_NAMES, *sorted(set(bundled_scenes()) - set(FIRST_NAMES))]
    scenes = [_scene_entry(name) for name in order if name in bundled_scenes()]
    tasks = [_task_entry(name, task) for name, task in TASKS.items()]
    return tuple(sorted([*scenes, *tasks], key=lambda entry: LISTED.index(entry.family)))


def read_entry(name: str) -> Scene | Task:
    """Return a scene or task by its name in the gallery; raise ValueError, with the nearest name, for another one."""
    if name in TASKS:
        return trained_task(name)
    return load_scene(text_of(name))


def text_of(name: str) -> str:
    """Return the YAML of a scene that ships; raise ValueError, with the nearest name, for another one."""
    if name not in bundled_scenes():
        known = (*bundled_scenes(), *TASKS)
        raise ValueError(f"open = {printable(name)}: unknown{nearest(name, known) or ';'} allowed: {', '.join(known)}")
    return bundled_scenes()[name].read_text(encoding="utf-8")


def _scene_entry(name: str) -> Entry:
    text = text_of(name)
    kinds = set(re.findall(r"kind: (\w+)|preset: \w*", text)) | ({"driving"} if "preset:" in text else set())
    family = next(family for family, own in FAMILIES.items() if own & kinds or not own)
    return Entry(name, _title(name), description_of(text), "scene", family, _picture(name))


def _task_entry(name: str, task: type[Task]) -> Entry:
    text = " ".join((task.__doc__ or "").split("\n\n")[0].split())
    return Entry(name, _title(name), text, "task", "Tasks", _picture(name))


def _title(name: str) -> str:
    title = name.replace("_", " ").capitalize()
    return title.replace("3d", " 3-D").replace("nav", "navigation")


def description_of(text: str) -> str:
    """Return some sentences about a scene: those at the beginning of its file, or else its first rules."""
    return _comment(text) or _words(text)


def _comment(text: str) -> str:
    """Return the sentences at the beginning of a scene's file, without those about commands; "" without one."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    words = [line.lstrip("# ") for line in lines if "yaml-language-server" not in line]
    whole = " ".join(re.sub(r"(?:^| {2,})(?:flockenv|python) .*", "", line) for line in words).strip()
    sentences = re.split(r"(?<=[.!?]) +(?=[A-Z])", whole)
    return " ".join(each for each in sentences if each.endswith((".", "!", "?")) and "flockenv " not in each)


def _words(text: str) -> str:
    """Return what the rules of a scene say, a few sentences."""
    from flockenv.play.sentences import sentences_of

    said = [each.text for each in sentences_of(load_scene(text)) if each.path.startswith(("groups", "effects"))]
    return " ".join(said[:MOST_SENTENCES])


def _picture(name: str) -> bytes | None:
    path = PICTURES.joinpath(f"{name}.png")
    return path.read_bytes() if path.is_file() else None


# --- drawing pictures -------------------------------------------------------------------------------------------------


def _films(name: str) -> Iterator[Snapshot]:
    """Yield the last moments of a scene or task, the last one at the end."""
    from flockenv.play.scene_lane import SceneLane
    from flockenv.play.task_lane import TaskLane

    if name in TASKS:
        lane: SceneLane | TaskLane = TaskLane(trained_task(name), "rules", TASK_SEED)
        ticks = 60
    else:
        text = text_of(name)
        lane = SceneLane(load_scene(text), 1)
        seconds = re.search(r"--duration ([\d.]+)", text)
        ticks = round(0.4 * float(seconds[1] if seconds else 10.0) / lane.interval)
    lane.step(max(ticks - 24 * max(1, ticks // 200), 1))
    for _ in range(24):
        yield lane.snapshot()
        lane.step(max(1, ticks // 200))
    yield lane.snapshot()


def _draw(snapshots: Sequence[Snapshot], all_trails: bool) -> bytes:
    """Return the last snapshot as PNG, without caption and margin; all_trails: also of agents without a look."""
    from PIL import Image

    from flockenv.render.picture import draw
    from flockenv.render.view import view_of

    view = view_of(snapshots[-1], WIDTH, 1)
    pixels = draw(snapshots[-1], size=WIDTH, scale=3, trails=snapshots[:-1], all_trails=all_trails)
    inside = pixels[round(view.top) : round(view.bottom), round(view.left) : round(view.right)]
    out = io.BytesIO()
    Image.fromarray(inside).quantize(64).save(out, "PNG", optimize=True)
    return out.getvalue()


def _make(names: Sequence[str]) -> None:
    """Draw the pictures of some scenes and tasks."""
    for name in names:
        (Path(str(PICTURES)) / f"{name}.png").write_bytes(_draw(list(_films(name)), name in TASKS))
        print(name, flush=True)  # noqa: T201  # a command of developers


if __name__ == "__main__":
    _make(sys.argv[1:] or [*bundled_scenes(), *TASKS])
