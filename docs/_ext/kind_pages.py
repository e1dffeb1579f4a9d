"""Pages of behaviours, effects, methods, constraints and presets: formula, picture, source, limits, fields, scenes."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from docstrings import field_rows, first_sentence, markdown, table, without_limits
from limits import limits, limits_of_preset, link
from pictures import demos
from scene_pages import Use, uses

from flockenv.behaviours import BEHAVIOURS
from flockenv.physics.constraints import CONSTRAINTS
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.physics.effects.effect import LAWS
from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene.presets import PRESETS, Model

__all__ = ["pages"]

Kinds = Mapping[str, type[Any]]

REGISTRIES: dict[str, tuple[str, Kinds]] = {
    "behaviours": ("Behaviours", BEHAVIOURS),
    "effects": ("Effects", {kind: effect for kind, effect in EFFECTS.items() if kind not in BEHAVIOURS}),
    "methods": ("Integration methods", INTEGRATORS),
    "constraints": ("Constraints", CONSTRAINTS),
}

ABOUT = {
    "behaviours": "Effects whose force is a steering force. List them under `effects` of a scene, or under "
    "`behaviours` of a [steer](../effects/steer.md) effect, whose arbitration combines them. [All on one "
    "page](../../behaviours.md).",
    "effects": "Forces, fields, media, bonds and inner states: what a scene lists under `effects`. What it does not "
    "list is not computed.",
    "methods": "`integrator` of a scene. [Accuracy](../../accuracy.md) compares their errors and costs, "
    "[numerics](../../numerics.md) their stability.",
    "constraints": "What holds at the end of every step: `constraints` of a scene.",
    "presets": "Published models of pedestrians. `{preset: NAME}` under `effects` of a scene stands for their effects "
    "([social forces](../../social_forces.md)).",
}
"""What the overview of each folder says first."""


def pages(docs: Path) -> dict[str, str]:
    """Return a page for each kind and preset, and an overview of each registry."""
    used = uses(docs)
    made: dict[str, str] = {}
    for folder, (title, kinds) in REGISTRIES.items():
        texts = {kind: first_sentence(each.__doc__) for kind, each in kinds.items()}
        made[f"{folder}/index"] = _overview(title, ABOUT[folder], texts)
        for kind, model in kinds.items():
            made[f"{folder}/{kind}"] = _kind_page(docs, folder, kind, model, used.get(kind, []))
    sources = {name: model.source for name, model in PRESETS.items()}
    made["presets/index"] = _overview("Presets", ABOUT["presets"], sources)
    for name, preset in PRESETS.items():
        made[f"presets/{name}"] = _preset_page(name, preset, used.get(name, []))
    return made


def _overview(title: str, about: str, texts: Mapping[str, str]) -> str:
    rows = [(f"[{name}]({name}.md)", text) for name, text in texts.items()]
    entries = "\n".join(texts)
    return (
        f"# {title}\n\n{about}\n\n{table(('kind', 'what it does'), rows)}\n\n```{{toctree}}\n:hidden:\n{entries}\n```\n"
    )


def _kind_page(docs: Path, folder: str, kind: str, model: type[Any], used: list[Use]) -> str:
    parts = [f"# {kind}", *_picture(docs, folder, kind, used)]
    parts += [markdown(without_limits(model.__doc__)[0]), *_laws(model), *_method(model), *limits(model)]
    parts += _fields(model)
    parts += _used(used)
    if demo := getattr(model, "demo", None) or demos().get(kind, (0, None))[1]:
        parts += ["## Its scene in the picture", f"```yaml\n{demo.strip()}\n```"]
    return "\n\n".join([*parts, _origin(model)]) + "\n"


STILLS = ("docs/scenes", "flockenv/play/pictures")
"""Folders with a picture of each scene and task."""


def _picture(docs: Path, folder: str, kind: str, used: list[Use]) -> list[str]:
    """Return the picture of a kind: its own, one that pictures.py draws, or that of the simplest scene that uses it."""
    if (docs / folder / f"{kind}.png").exists():
        return [f"![Trajectories under {kind}](../../{folder}/{kind}.png)"]
    if folder == "methods":
        return [f"![Error of {kind} for a harmonic oscillator, and its order](../pictures/{kind}.png)"]
    if kind in demos():
        return [f"![Trajectories under {kind}](../pictures/{kind}.png)"]
    page = docs / "generated" / folder
    for use in used:
        for still in (docs.parent / place / f"{use.name}.png" for place in STILLS):
            if still.exists():
                picture = f"![The scene {use.name}]({os.path.relpath(still, page)})"
                return [picture, f"A scene that uses it: {use.link()}."]
    return []


def _laws(model: type[Any]) -> list[str]:
    """Return the section with the formulas: the docstrings of the laws."""
    found = {name: getattr(model, name, None) for name in LAWS}
    rows = [
        (f"`{name}`", " ".join(markdown(law.__doc__).split("\n\n")[0].split()))
        for name, law in found.items()
        if law is not None and law.__doc__
    ]
    return ["## Laws", table(("law", "formula"), rows)] if rows else []


def _method(model: type[Any]) -> list[str]:
    """Return the properties of an integration method."""
    if not hasattr(model, "order_with_drag"):
        return []
    rows = [
        ("order, forces of position", str(model.order)),
        ("order, forces of velocity also", str(model.order_with_drag)),
        (
            "evaluations of the force per step" + (", at least" if model.adaptive else ""),
            str(model.evaluations or "as many as its equations take"),
        ),
        ("chooses its own substeps", "yes" if model.adaptive else "no"),
        ("integrates linear drag exactly", "yes" if model.splits_drag else "no"),
        ("solves equations", "yes" if model.solves else "no"),
    ]
    return ["## Properties", table(("property", ""), rows)]


def _fields(model: type[Any]) -> list[str]:
    rows = [(f"`{name}`", *(_cell(cell) for cell in rest)) for name, *rest in field_rows(model)]
    return (
        ["## Fields", table(("field", "unit", "values", "default", "meaning"), rows)] if rows else ["It has no fields."]
    )


def _cell(text: str) -> str:
    return markdown(text).replace("\n", " ")


def _used(used: list[Use]) -> list[str]:
    return ["## Used by", ", ".join(use.link() for use in used) + "."] if used else []


def _origin(model: type[Any]) -> str:
    """Return where the class is: its module, and the first paragraph of that module's docstring."""
    about = inspect.getdoc(sys.modules[model.__module__]) or ""
    family = " ".join(about.split("\n\n")[0].split())
    package = ".".join(model.__module__.split(".")[:-1])
    return f"Class `{model.__name__}` of `{package}`, in `{model.__module__}`: {markdown(family)}"


def _preset_page(name: str, model: Model, used: list[Use]) -> str:
    symbols = table(
        ("symbol of the paper", "value"), [(f"`{key}`", _cell(value)) for key, value in model.symbols.items()]
    )
    effects = (*model.behaviours(False, None), *model.bodies)
    calls = "\n".join(map(repr, effects))
    people = "\n".join(f"{key}: {value!r}" for key, value in model.people.items())
    picture = f"![Two streams of four under {name}](../pictures/{name}.png)"
    parts = [f"# {name}", picture, _cell(model.source) + ".", "## Formulas"]
    parts.append(table(("force", "formula"), [(link(each.kind), _cell(_formula(each))) for each in effects]))
    parts += ["## Values", symbols]
    if model.note:
        parts.append(f"Note: {_cell(model.note)}.")
    parts += limits_of_preset(model)
    parts += [
        "## Effects that it stands for", f"```python\n{calls}\n```",
        "## Pedestrians", f"```python\n{people}\n```",
        "## Use", f"```yaml\neffects:\n  - {{preset: {name}}}\n```", *_used(used),
        "## Its scene in the picture", f"```yaml\n{demos()[name][1].strip()}\n```",
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _formula(effect: Effect) -> str:
    """Return the paragraph of an effect's docstring with its formula, and the next one, which explains its letters."""
    paragraphs = without_limits(type(effect).__doc__)[0].split("\n\n")
    first = next(k for k, text in enumerate(paragraphs) if re.search(r"\bF = ", text))
    return " ".join(paragraphs[first : first + 2])
