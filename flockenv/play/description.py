"""JSON for pages: the fixed parts of a lane, which frames do not have, such as roles, radii, bonds and faces."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import Circle
from flockenv.physics.effects import Gravity
from flockenv.play.lane import Lane
from flockenv.play.scene_lane import SceneLane
from flockenv.play.task_lane import TaskLane
from flockenv.render.replay import look_data, round_digits
from flockenv.scene import Scene

__all__ = ["describe_lane", "json_data"]

FACES = 20_000
"""Most triangles that are sent; larger surfaces are drawn by their bonds."""


def describe_lane(lane: Lane, name: str) -> dict[str, Any]:
    """Return what a page needs of a lane besides its frames; `key` changes if what is drawn without frames does."""
    shot = lane.snapshot()
    scene: Scene = lane.record.scene if isinstance(lane, TaskLane) else lane.record
    fixed = {
        "periodic": shot.periodic, "roles": _runs(shot.roles), "dimension": shot.dimension,
        "radius": _number_runs(shot.radius), "bonds": shot.bonds.ravel().tolist(),
        "faces": shot.faces.ravel().tolist() if len(shot.faces) <= FACES else [],
        "covered": _runs(np.asarray(shot.covered).astype(int).tolist()),
        "looks": [look_data(look) for look in shot.looks],
        "look": _runs(np.asarray(shot.look).tolist()) if shot.looks else None, "has_returns": lane.returns is not None,
    }  # fmt: skip
    return {
        **fixed, "name": name, "key": zlib.crc32(json.dumps(fixed).encode()), "low": shot.low.tolist(),
        "high": shot.high.tolist(), "obstacles": _obstacles(lane, shot.low, shot.high),
        "up": _up(scene), "players": list(lane.players) if isinstance(lane, TaskLane) else None,
    }  # fmt: skip


def _up(scene: Scene) -> list[float] | None:
    """Return the direction against gravity; None without gravity."""
    pull = next((effect.acceleration for effect in scene.effects if isinstance(effect, Gravity)), None)
    return None if pull is None else [-float(x) for x in pull]


def _runs(values: Iterable[Any]) -> list[list[Any]]:
    """Return a list as [value, count] pairs, one per run of equal values."""
    return [[value, len(list(run))] for value, run in itertools.groupby(values)]


def _number_runs(values: NDArray[Any]) -> list[list[Any]]:
    """Return numbers as [value, count] pairs, rounded to six digits."""
    first = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    counts = np.diff([*first, len(values)])
    return [[round_digits(float(values[k]), 6), int(count)] for k, count in zip(first, counts, strict=True)]


def _obstacles(lane: Lane, low: NDArray[Any], high: NDArray[Any]) -> list[dict[str, Any]]:
    """Return where the obstacles are that can be moved: index, and a circle (`at`, `radius`) or an outline, m."""
    if isinstance(lane, TaskLane):
        state = lane.world.state
        rows = zip(state.obstacles.centre[0].tolist(), state.obstacle_radius[0].tolist(), strict=True)
        return [{"index": k, "at": at, "radius": radius} for k, (at, radius) in enumerate(rows) if radius > 0]
    assert isinstance(lane, SceneLane)
    found: list[dict[str, Any]] = []
    for k, shape in enumerate(lane.record.obstacles):
        if isinstance(shape, Circle):
            found.append({"index": k, "at": list(shape.centre), "radius": shape.radius})
        else:
            shift = shape.shift(lane.time)
            outlines = shape.outline(low - shift, high - shift)
            found += [{"index": k, "outline": (each + shift[:2]).tolist()} for each in outlines]
    return found


def json_data(value: Any) -> dict[str, Any]:
    """Return a dataclass, record or mapping as JSON data without numbers that JSON lacks."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        raw = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    else:
        raw = dict(value) if isinstance(value, Mapping) else value.model_dump()
    return {name: _plain(each) for name, each in raw.items()}


def _plain(value: Any) -> Any:
    """Return a value as JSON data; None for NaN and infinity."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int, bytes)):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(each) for each in value]
    return json_data(value)
