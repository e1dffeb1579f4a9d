"""Pages of the scenes in configs/: what each shows, its picture, and its file; and what uses a kind."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from flockenv.scene.presets import ALIASES
from flockenv.scene.scene import Scene
from flockenv.tasks import TASKS

__all__ = ["Use", "pages", "uses"]

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


class Use(NamedTuple):
    """A scene or task that uses a kind."""

    name: str
    page: str  # from a page in a folder of docs/generated/
    kinds: int  # number of kinds that it uses

    def link(self) -> str:
        """Return a link to its page."""
        return f"[{self.name}]({self.page})"


def uses(docs: Path) -> dict[str, list[Use]]:
    """Return the scenes and tasks that use an effect, method, constraint or preset, by its name; simple ones first."""
    found: dict[str, list[Use]] = {}

    def add(name: str, page: str, kinds: dict[str, None]) -> None:
        for kind in kinds:
            found.setdefault(kind, []).append(Use(name, page, len(kinds)))

    for folder, page in NAMES.items():
        for path in sorted((docs.parent / "configs" / folder).glob("*.yaml")):
            anchor = re.sub(r"[^\w-]", "", path.stem)
            kinds = dict.fromkeys(_kinds(yaml.safe_load(path.read_text(encoding="utf-8"))))
            add(path.stem, f"../{page}.md#{anchor}", kinds)
    for name, task in TASKS.items():
        add(name, f"../environments/{name}.md", dict.fromkeys(_kinds_of_scene(task().scene)))
    return {kind: sorted(each, key=lambda use: use.kinds) for kind, each in found.items()}


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
