"""Pages of the scenes in configs/: what each shows, its picture, and its file; and what uses a kind."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from flockenv.scene.presets import ALIASES
from flockenv.scene.scene import Scene
from flockenv.tasks import TASKS

__all__ = ["pages", "uses"]

FOLDERS = {
    "scenes": (
        "Shipped scenes",
        "Scene files in configs/scenes. `flockenv run FILE` simulates one, `flockenv play FILE` shows it live.",
    ),
    "crowds": (
        "Crowd scenes",
        "Scene files in configs/crowds: what `flockenv validate` plays ([validation](../crowds.md)).",
    ),
}
NAMES = {"scenes": "scenes", "crowds": "crowd_scenes"}
LISTS = ("effects", "behaviours", "constraints")


def pages(docs: Path) -> dict[str, str]:
    """Return the page of each folder of scenes."""
    return {NAMES[folder]: _page(docs, folder, *text) for folder, text in FOLDERS.items()}


def _page(docs: Path, folder: str, title: str, about: str) -> str:
    parts = [f"# {title}", about]
    for path in sorted((docs.parent / "configs" / folder).glob("*.yaml")):
        picture = docs / folder / f"{path.stem}.png"
        parts += [f"## {path.stem}", _comment(path.read_text(encoding="utf-8"))]
        if picture.exists():
            parts.append(f"![{path.stem}](../{folder}/{path.stem}.png)")
        parts.append(f"```{{literalinclude}} ../../configs/{folder}/{path.name}\n:language: yaml\n```")
    return "\n\n".join(parts) + "\n"


def _comment(text: str) -> str:
    """Return the comment at the beginning of a scene file, without the line for editors, as Markdown."""
    lines = re.match(r"(?:#.*\n)*", text)[0].splitlines()  # type: ignore[index]  # it matches always
    words = " ".join(line.lstrip("# ") for line in lines if "yaml-language-server" not in line)
    return re.sub(r"([*_<])", r"\\\1", re.sub(r"\s+flockenv [a-z]+ (configs/|-).*", "", words)) or "A scene."


def uses(docs: Path) -> dict[str, list[str]]:
    """Return links to the scenes and tasks that use an effect, method, constraint or preset, by its name."""
    found: dict[str, list[str]] = {}
    for folder, page in NAMES.items():
        for path in sorted((docs.parent / "configs" / folder).glob("*.yaml")):
            anchor = re.sub(r"[^\w-]", "", path.stem)
            for kind in dict.fromkeys(_kinds(yaml.safe_load(path.read_text(encoding="utf-8")))):
                found.setdefault(kind, []).append(f"[{path.stem}](../{page}.md#{anchor})")
    for name, task in TASKS.items():
        for kind in dict.fromkeys(_kinds_of_scene(task().scene)):
            found.setdefault(kind, []).append(f"[{name}](../environments/{name}.md)")
    return found


def _kinds(block: Any) -> Iterator[str]:
    """Yield the kinds that a block of a file names, also those within others."""
    if isinstance(block, dict):
        method = block.get("integrator")
        if isinstance(method, dict) and "kind" in method:
            yield method["kind"]
        for name in LISTS:
            for item in block.get(name) or ():
                if isinstance(item, dict):
                    yield (
                        item["kind"] if "kind" in item else ALIASES.get(item.get("preset", ""), item.get("preset", ""))
                    )
        for inner in block.values():
            yield from _kinds(inner)
    elif isinstance(block, list):
        for inner in block:
            yield from _kinds(inner)


def _kinds_of_scene(scene: Scene) -> Iterator[str]:
    yield scene.integrator.kind
    for part in (*scene.parts.effects, *scene.constraints):
        yield part.kind
