"""Check of the distance from the origin up to which a precision resolves positions, and distances to shapes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np

from flockenv.model.scene_view import SceneView

__all__ = ["FARTHEST", "FARTHEST_PER_RADIUS", "check_places"]

FARTHEST = 10_000.0
"""m from the origin, along any axis, within which a float32 scene must lie: beyond, positions round to 1 mm or more.

At 32,768 m an agent at 1 m/s does not move at all in steps of 1 ms.
"""

FARTHEST_PER_RADIUS = 1e9
"""Largest coordinate of a shape in float64, in radii of the smallest agent; in m if all agents are points.

There it rounds to 2e-7 radii. A disc that falls on a wall, 1e9 radii to each side, and slides for 3 s, ends within 1e-4
radii of the right place (`tests/test_float_range.py`). With 1e15 radii it would slide back, with 1e17 fall through.
"""


def check_places(scene: SceneView) -> None:
    """Raise ValueError if a position in float32, or a shape in float64, is too far away; motion is not checked."""
    if scene.dtype == "float32":
        reason = f"float32 tells places apart up to {FARTHEST:,.0f} m from the origin; use dtype = float64"
        _check_distances(chain(_places(scene), _surfaces(scene)), FARTHEST, reason)
        return
    radius = min((group.narrowest for group in scene.groups if group.narrowest > 0), default=0.0)
    most = FARTHEST_PER_RADIUS * (radius or 1.0)
    whose = f"{FARTHEST_PER_RADIUS:g} times the smallest radius, {radius:g} m" if radius else "for agents of radius 0"
    reason = (
        f"float64 computes accurate distances to shapes up to {most:g} m from the origin ({whose}); use nearer points, "
        "or a half_space for an endless wall"
    )
    _check_distances(_surfaces(scene), most, reason)


def _check_distances(places: Iterator[tuple[str, Any]], most: float, reason: str) -> None:
    """Raise ValueError, which ends with the reason, if a coordinate is larger than `most`, m."""
    for name, value in places:
        farthest = np.abs(np.asarray(value, float)).max(initial=0.0)
        if farthest > most:
            what = value if isinstance(value, tuple) else f"{farthest:g} m"
            raise ValueError(f"{name} = {what}: {reason}")


def _surfaces(scene: SceneView) -> Iterator[tuple[str, Any]]:
    """Yield the key and the reference points of each obstacle and of each shape in which agents die."""
    shapes = [(f"obstacles[{k}]", obstacle) for k, obstacle in enumerate(scene.obstacles)]
    for k, member in enumerate(scene.population):
        if (shape := getattr(member, "shape", None)) is not None:
            shapes.append((f"population[{k}].shape", shape))
    for key, shape in shapes:
        yield f"{key}.centre", getattr(shape, "centre", ())
        yield f"{key}.kind = {shape.kind}: its farthest coordinate", shape.reference_points


def _places(scene: SceneView) -> Iterator[tuple[str, Any]]:
    """Yield the key and value of every other position in a scene."""
    yield "space.size", getattr(scene.space, "size", ())
    for k, group in enumerate(scene.groups):
        if group.network is not None:
            yield f"groups[{k}].network: its farthest coordinate", group.network.points(scene.dimension)
        else:
            yield f"groups[{k}].spawn.low", group.spawn.low or ()
            yield f"groups[{k}].spawn.high", group.spawn.high or ()
    for k, member in enumerate(scene.population):
        place = getattr(member, "place", None)
        yield f"population[{k}].place: its farthest coordinate", () if place is None else place.extremes
    for k, effect in enumerate(scene.effects):
        for name in effect.places:
            yield f"effects[{k}].{name}", getattr(effect, name)
        for j, behaviour in enumerate(effect.components):
            for name in behaviour.places:
                yield f"effects[{k}].behaviours[{j}].{name}", getattr(behaviour, name)
