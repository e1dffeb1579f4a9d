"""The gallery of behaviours: a page that describes each, with the trajectories of its own small scene.

Its content comes from the behaviour classes: docstring, fields, `demo`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from flockenv.behaviours import BEHAVIOURS
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.physics.effects.effect import Effect
from flockenv.render.gif import write_png
from flockenv.render.picture import draw
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.trajectory import Trajectory, record

__all__ = ["page", "run_demo", "write_gallery"]

SIZE = 360
"""Width of a picture, pixels."""

COLOURS = 64
"""Colours of a picture."""

INSTANTS = 160
"""Approximate number of instants at which a drawn trajectory is sampled."""


def run_demo(behaviour: type[Effect]) -> Trajectory:
    """Return the run of a behaviour's demo scene; ValueError if it has none, or the run stops early."""
    kind = behaviour.model_fields["kind"].default
    if behaviour.demo is None:
        raise ValueError(f"{kind}: has no demo, a small scene that shows it, as YAML")
    scene = load_scene(behaviour.demo)
    steps = round(behaviour.demo_time / scene.dt)
    run = record(scene, 0, steps, max(1, steps // INSTANTS))
    if run.stopped == "interrupted":
        raise KeyboardInterrupt
    if run.stopped:
        raise ValueError(f"{kind}: its demo stops: {run.stopped}")
    return run


def families(behaviours: Mapping[str, type[Effect]]) -> dict[str, list[type[Effect]]]:
    """Return behaviours grouped by module, keyed by the first paragraph of the module's docstring."""
    found: dict[str, list[type[Effect]]] = {}
    for behaviour in behaviours.values():
        text = inspect.getdoc(sys.modules[behaviour.__module__]) or behaviour.__module__
        found.setdefault(_first_paragraph(text), []).append(behaviour)
    return found


def page(behaviours: Mapping[str, type[Effect]], pictures: str) -> str:
    """Return the page, as Markdown that shows `pictures`/KIND.png beside each behaviour."""
    lines = [
        "# Behaviours",
        "",
        "This page shows each behaviour in a small scene; paths fade towards the past. To use one, list it under",
        "`effects` of a scene, or under `behaviours` of a `steer` effect, whose arbitration combines several.",
        "The texts are the docstrings and fields of the classes. `flockenv gallery --out docs/behaviours.md --force`",
        "draws and writes this page.",
        "",
    ]
    for title, members in families(behaviours).items():
        lines += [f"## {title.rstrip('.')}", ""]
        for behaviour in members:
            lines += _entry_lines(behaviour, pictures)
    return "\n".join(lines)


def write_gallery(
    path: Path, behaviours: Mapping[str, type[Effect]] = BEHAVIOURS, progress: Callable[[int], None] = lambda done: None
) -> int:
    """Write the page, and a picture of each behaviour into a folder beside it; return the number of behaviours."""
    folder = path.with_suffix("")
    with new_folder(folder):
        for done, (kind, behaviour) in enumerate(behaviours.items()):
            progress(done)
            snapshots = list(run_demo(behaviour).snapshots())
            write_png(folder / f"{kind}.png", draw(snapshots[-1], SIZE, 3, snapshots), COLOURS)
    with replace_file(path) as file:
        file.write(page(behaviours, folder.name).encode())
    return len(behaviours)


def _entry_lines(behaviour: type[Effect], pictures: str) -> list[str]:
    """Return the lines of the page about one behaviour."""
    kind = behaviour.model_fields["kind"].default
    fields = [
        f"| `{name}` | {field.description or ''} | {'' if field.is_required() else _default_text(field.default)} |"
        for name, field in behaviour.model_fields.items()
        if name != "kind"
    ]
    return [
        f"### {kind}", "",
        f'<img src="{pictures}/{kind}.png" width="{SIZE}" alt="Trajectories under {kind}">', "",
        inspect.getdoc(behaviour) or "", "",
        "| | | default |", "| --- | --- | --- |", *fields, "",
        "<details><summary>its scene</summary>", "",
        "```yaml", (behaviour.demo or "").strip(), "```", "",
        "</details>", "",
    ]  # fmt: skip


def _default_text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else "none" if value is None else str(value)


def _first_paragraph(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split())
