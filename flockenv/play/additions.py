"""Effects that can be added to a scene by one press, each with values that this scene accepts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from numpy.typing import NDArray
from pydantic.fields import FieldInfo

from flockenv.physics.effects import EFFECTS, Effect
from flockenv.play.lane import collected_warnings
from flockenv.play.record_paths import with_item
from flockenv.scene import Scene

__all__ = ["Addition", "additions_of"]

Addition = dict[str, Any]

PLACES = ("centre", "target", "point")
"""Names of fields that are a place, which is put into the middle of the world."""

OWN_VALUES = {"pressure": {"radius": 1.3}, "viscosity": {"radius": 2.4}, "surface_tension": {"radius": 2.4}}
"""Values of effects whose numbers must fit each other."""

WEAKER = (1.0, 0.1, 0.01, 1e-3, 1e-4)
"""Factors of an effect's strengths that are tried in turn if the time step is too long for it."""


def additions_of(scene: Scene) -> list[Addition]:
    """Return the effects that can be added to a scene as it is: path, value, title, description.

    Every one is tried: it takes some milliseconds for each kind of effect. An effect that needs more than the scene
    has, such as a network or desired speeds, is left out.
    """
    light = _without_floor_fields(scene)
    found = []
    for kind, model in sorted(EFFECTS.items()):
        value = next((each for each in _candidates(model, kind, scene) if _is_accepted(light, each)), None)
        if value is not None:
            text = " ".join((model.__doc__ or "").split("\n\n")[0].split())
            about = {"title": kind.replace("_", " "), "description": text.replace("`", "")}
            found.append({"path": "effects", "value": value, **about})
    return found


def _without_floor_fields(scene: Scene) -> Scene:
    """Return the scene without effects that take long to build and that no other effect depends on, if it can be."""
    with collected_warnings():
        try:
            return scene.with_effects(*(each for each in scene.effects if not each.tabled))
        except ValueError:
            return scene


def _is_accepted(scene: Scene, value: Addition) -> bool:
    with collected_warnings():
        try:
            with_item(scene, "effects", value)
        except ValueError:
            return False
    return True


def _candidates(model: type[Effect], kind: str, scene: Scene) -> Iterator[Addition]:
    """Yield the fields of an effect, with ever smaller strengths."""
    value: Addition = {"kind": kind}
    for name, field in model.model_fields.items():
        if name in OWN_VALUES.get(kind, {}):
            value[name] = OWN_VALUES[kind][name]
        elif field.is_required():
            value[name] = _vector(name, scene) if "tuple" in str(field.annotation) else _number(field.metadata)
        elif (fitting := _fitting(name, field, scene)) is not None:
            value[name] = fitting
    weighed = [name for name in model.strengths if isinstance(value.get(name), float)]
    for factor in WEAKER if weighed else (1.0,):
        yield {name: each * factor if name in weighed else each for name, each in value.items()}


def _vector(name: str, scene: Scene) -> list[float]:
    """Return a place in the world, a corner of it, or a unit vector along x."""
    low, high = _region(scene)
    if name in PLACES:
        return [float(x) for x in (low + high) / 2]
    if name in ("low", "high"):
        return [float(x) for x in (low if name == "low" else high)]
    return [1.0] + [0.0] * (scene.dimension - 1)


def _region(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the space, or of where the first group begins."""
    size, group = getattr(scene.space, "size", None), scene.groups[0]
    if size is not None:
        return np.zeros(scene.dimension), np.array(size, float)
    if group.network is not None:
        points = np.asarray(group.network.points(scene.dimension))
        return points.min(axis=0), points.max(axis=0)
    zero = (0.0,) * scene.dimension
    return np.array(group.spawn.low or zero, float), np.array(group.spawn.high or zero, float)


def _fitting(name: str, field: FieldInfo, scene: Scene) -> Any:
    """Return a value in place of a default that this scene could not have; None: the default."""
    if name == "speed" and field.default is None and any(group.max_speed is None for group in scene.groups):
        return 1.0
    if name == "step":
        return scene.dt
    if name == "group" and field.default == 0:  # it acts on a network
        return next((k for k, group in enumerate(scene.groups) if group.network is not None), None)
    if name == "radius" and isinstance(field.default, float):
        widest = min(getattr(scene.space, "size", (np.inf,))) / 2  # a torus shows no agent twice
        return widest if field.default > widest else None
    return None


def _number(metadata: list[Any]) -> float:
    """Return 1, or the nearest number within bounds."""
    low = next((float(each.ge) for each in metadata if isinstance(each, Ge)), None)  # type: ignore[arg-type]
    high = next((float(each.le) for each in metadata if isinstance(each, Le)), None)  # type: ignore[arg-type]
    low = next((float(each.gt) for each in metadata if isinstance(each, Gt)), low)  # type: ignore[arg-type]
    high = next((float(each.lt) for each in metadata if isinstance(each, Lt)), high)  # type: ignore[arg-type]
    return min(max(1.0, low if low is not None else 1.0), high if high is not None else 1.0)
