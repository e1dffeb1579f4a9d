"""Check of the distance from the origin up to which single precision resolves positions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from flockenv.model.scene_view import SceneView

__all__ = ["FARTHEST", "check_places"]

FARTHEST = 10_000.0
"""m from the origin, along any axis, within which a float32 scene must lie: beyond, positions round to 1 mm or more.

At 32,768 m an agent at 1 m/s does not move at all in steps of 1 ms.
"""


def check_places(scene: SceneView) -> None:
    """Raise ValueError if a float32 scene has a position beyond FARTHEST; later motion is not checked."""
    if scene.dtype != "float32":
        return
    for name, value in _places(scene):
        farthest = np.abs(np.asarray(value, float)).max(initial=0.0)
        if farthest > FARTHEST:
            what = value if isinstance(value, tuple) else f"{farthest:g} m"
            raise ValueError(
                f"{name} = {what}: float32 tells places apart up to {FARTHEST:,.0f} m from the origin; "
                "use dtype = float64"
            )


def _places(scene: SceneView) -> Iterator[tuple[str, Any]]:
    """Yield the key and value of every position in a scene."""
    yield "space.size", getattr(scene.space, "size", ())
    for k, group in enumerate(scene.groups):
        if group.network is not None:
            yield f"groups[{k}].network: its farthest coordinate", group.network.points(scene.dimension)
        else:
            yield f"groups[{k}].spawn.low", group.spawn.low or ()
            yield f"groups[{k}].spawn.high", group.spawn.high or ()
    for k, obstacle in enumerate(scene.obstacles):
        what = "centre" if obstacle.kind == "circle" else "kind = " + obstacle.kind + ": its farthest coordinate"
        yield f"obstacles[{k}].{what}", obstacle.anchor if obstacle.kind == "circle" else obstacle.extremes
    for k, member in enumerate(scene.population):
        place = getattr(member, "place", None)
        yield f"population[{k}].place: its farthest coordinate", () if place is None else place.extremes
    for k, effect in enumerate(scene.effects):
        for name in effect.places:
            yield f"effects[{k}].{name}", getattr(effect, name)
        for j, behaviour in enumerate(effect.components):
            for name in behaviour.places:
                yield f"effects[{k}].behaviours[{j}].{name}", getattr(behaviour, name)
