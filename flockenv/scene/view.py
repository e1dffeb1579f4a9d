"""View: a scene as pictures show it: a snapshot of a state, outlines of obstacles, the region to show, marks."""

from __future__ import annotations

import functools
import itertools
import math
import weakref
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import Shape
from flockenv.geometry.space import Plane
from flockenv.model.appearance import Appearance
from flockenv.model.finite_elements import contents
from flockenv.model.networks import EDGE
from flockenv.model.scene_view import SceneView
from flockenv.model.snapshot import Mark, Snapshot
from flockenv.model.state import Floats, State
from flockenv.model.surface import faces_of
from flockenv.physics.effects import Springs
from flockenv.physics.population import Emitter

__all__ = ["View"]


class View:
    """The content of pictures of a scene."""

    def __init__(self, scene: SceneView) -> None:
        """Keep a reference to the scene; compute nothing yet."""
        self._scene = weakref.ref(scene)  # the scene holds this object: its scratch is freed with its last reference

    @property
    def scene(self) -> SceneView:
        """The scene, which must be alive."""
        scene = self._scene()
        assert scene is not None
        return scene

    def snapshot(self, state: State, world: int = 0, title: str = "") -> Snapshot:
        """Return one world at one instant, for pictures."""
        low, high = self.region(state, world)
        return Snapshot(
            time=float(state.time[world]), pos=state.pos[world], vel=state.vel[world], alive=state.alive[world],
            heading=state.heading[world] if len(state.frame) else None,
            radius=np.asarray(self.scene.body.radius, np.float64), roles=self.scene.roles,
            obstacle_centre=state.obstacles.centre[world], obstacle_radius=state.obstacle_radius[world],
            marks=self.marks,
            low=np.array(low, np.float64), high=np.array(high, np.float64),
            periodic=self.scene.space.periodic, title=title, bonds=self.scene.edges,
            outlines=self.outlines(low, high, float(state.time[world])),
            looks=self.looks, look=self.look if self.looks else None,
            age=state.age[world] if self.scene.population else None,
            identity=state.identity[world] if self.scene.population else None, shown=self.shown_numbers(state, world),
            broken=self.broken(state, world), faces=self.faces, covered=self.covered,
        )  # fmt: skip

    @functools.cached_property
    def faces(self) -> NDArray[np.int32]:
        """The triangles of the surfaces of networks, (F, 3)."""
        return faces_of(self.scene)

    @functools.cached_property
    def covered(self) -> NDArray[np.bool_]:
        """True for agents that are drawn as a surface: those of networks with faces, also inside them, (N,) bool."""
        corner = np.zeros(self.scene.agents, np.bool_)
        corner[self.faces] = True
        starts = self.scene.starts
        parts = [corner[first:end] for first, end in itertools.pairwise(starts)]
        return np.concatenate([np.full(len(part), part.any()) for part in parts])

    def broken(self, state: State, world: int = 0) -> NDArray[np.bool_] | None:
        """Return which edges of networks are broken, (E,) bool; None if no effect breaks springs."""
        kept = state.bonds.shape[1]
        if not kept:
            return None
        springs = self.scene.edge_springs
        return np.asarray((springs < kept) & np.isinf(state.bonds[world, np.minimum(springs, kept - 1)]))

    def strain(self, state: State, world: int = 0) -> NDArray[np.float64]:
        """Return the mean of |l / L - 1| over the edges of networks at each agent, (N,); 0 without one.

        L: the present rest length; edges that are broken, or have none, do not count. Finite for any state: it is the
        largest number where agents are infinitely far apart, and 0 where positions are NaN.
        """
        edges, rest, kept = self.scene.edges, self._rest, state.bonds.shape[1]
        if kept:
            springs = self.scene.edge_springs
            present = state.bonds[world, np.minimum(springs, kept - 1)]
            rest = np.where((springs < kept) & (present > 0), present, rest)
        whole = (rest > 0) & np.isfinite(rest)
        ends, rest = edges[whole].T, rest[whole]
        with np.errstate(over="ignore", invalid="ignore"):  # of runs that diverged
            offset = self.scene.space.displacement(state.pos[world][ends[0]], state.pos[world][ends[1]])
            strain = np.abs(np.linalg.norm(offset, axis=1) / rest - 1.0)
            total, count = (np.bincount(ends.ravel(), w, self.scene.agents) for w in (np.tile(strain, 2), None))
            return np.nan_to_num(total / np.maximum(count, 1))

    @functools.cached_property
    def _rest(self) -> NDArray[np.float64]:
        """The rest lengths of the edges of networks at the start, (E,) m."""
        found = [np.zeros(0)]
        for k, group in enumerate(self.scene.groups):
            if group.network is not None:
                springs = group.network.springs(self.scene.dimension)
                own = (e.rest for e in self.scene.effects if isinstance(e, Springs) and e.group == k)
                found.append(next(own, 1.0) * springs.rest[springs.role == EDGE])
        return np.concatenate(found)

    def volumes(self, state: State, world: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the volume of each element of networks, and that at rest, (E,) m^3 each; areas, m^2, in 2-D.

        Elements are tetrahedra, or triangles in 2-D, in the order of groups; no others have a volume. That of an
        element which is inside out is negative.
        """
        elements, rest = self._solids
        with np.errstate(over="ignore", invalid="ignore"):  # of runs that diverged
            corners = state.pos[world][elements]
            edges = self.scene.space.displacement(corners[:, :1], corners[:, 1:])
            return np.asarray(np.linalg.det(edges) / math.factorial(edges.shape[2])), rest

    @functools.cached_property
    def _solids(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """The elements of networks that have a volume, (E, D + 1), and their volumes at rest, (E,)."""
        d = self.scene.dimension
        found, rest = [np.zeros((0, d + 1), np.int32)], [np.zeros(0)]
        for first, group in zip(self.scene.starts, self.scene.groups, strict=False):
            if group.network is not None and (elements := group.network.elements(d)).shape[1] == d + 1:
                found.append(first + elements)
                rest.append(contents(group.network.rest_points(d), elements))
        return np.concatenate(found), np.concatenate(rest)

    def shown_numbers(self, state: State, world: int = 0) -> NDArray[np.float64] | None:
        """Return the strain or inner number of every agent that its appearance shows, (N,); None without one."""
        if not any(look.reads_scene for look in self.looks):
            return None
        numbers = np.zeros(self.scene.agents)
        strain = self.strain(state, world) if any(look.by == "strain" for look in self.looks) else numbers
        for k, group in enumerate(self.scene.groups):
            if group.appearance is not None and group.appearance.reads_scene:
                slots, name = slice(self.scene.starts[k], self.scene.starts[k + 1]), group.appearance.of
                numbers[slots] = (strain if name is None else self.scene.inner(state, name)[world])[slots]
        return numbers

    @property
    def looks(self) -> tuple[Appearance, ...]:
        """Appearances of the groups that have one."""
        return tuple(group.appearance for group in self.scene.groups if group.appearance is not None)

    @property
    def look(self) -> NDArray[np.int32]:
        """Index into `looks` of every agent, (N,); -1: no appearance."""
        has_appearance = [group.appearance is not None for group in self.scene.groups]
        number = np.where(has_appearance, np.cumsum(has_appearance) - 1, -1)
        return np.repeat(number, [group.size for group in self.scene.groups]).astype(np.int32)

    def outlines(
        self, low: Sequence[float] | NDArray[np.float64], high: Sequence[float] | NDArray[np.float64], time: float = 0.0
    ) -> tuple[NDArray[np.float64], ...]:
        """Return the obstacles of `shapes` as polygons, each (n, 2) m, seen from above in a region at a time, s."""
        region, found = np.array([low, high], np.float64), []
        for shape in self.scene.shapes:
            shift = self._shift(shape, time)
            found += [polygon + shift[:2] for polygon in shape.outline(*(region - shift))]
        return tuple(found)

    def _shift(self, shape: Shape, time: float) -> Floats:
        """Return the displacement of a shape at a time, m; on a torus, to its image in the box."""
        shift = shape.shift(time)
        if not (shape.moves and self.scene.space.periodic):
            return shift
        return np.asarray(self.scene.space.wrap(np.array(shape.anchor) + shift)) - shape.anchor

    def region(self, state: State, world: int) -> tuple[Sequence[float], Sequence[float]]:
        """Return the region to show: the space, or the bounds of all agents and obstacles."""
        if not isinstance(self.scene.space, Plane):
            return (0.0,) * self.scene.dimension, self.scene.space.extent(self.scene.dimension)
        pos, living = state.pos[world], state.alive[world]
        pos = pos[living] if self.scene.population and living.any() else pos  # empty slots have no position
        margin = 1.0 + 0.05 * float(np.ptp(pos, axis=0).max())
        low, high = pos.min(axis=0) - margin, pos.max(axis=0) + margin
        points = np.concatenate([low[None], high[None], *self.extremes(float(state.time[world]))])
        return tuple(points.min(axis=0)), tuple(points.max(axis=0))

    def extremes(self, *times: float) -> list[Floats]:
        """Return points that pictures at some times, s, must show: of shapes, emitters, and paths of behaviours."""
        paths = [np.asarray(track) + side for track, radius in self._paths for side in (-radius, radius)]
        corners = [shape.extremes + shape.shift(time) for shape in self.scene.shapes for time in times]
        places = [member.place.extremes for member in self.scene.population if isinstance(member, Emitter)]
        return [*corners, *places, *paths]

    @functools.cached_property
    def _paths(self) -> tuple[tuple[tuple[tuple[float, ...], ...], float], ...]:
        """The paths of steering behaviours, each once."""
        paths = dict.fromkeys(effect.path_to_draw(self.scene) for effect in self.scene.parts.effects if effect.steering)
        return tuple(path for path in paths if path is not None)

    @property
    def marks(self) -> tuple[Mark, ...]:
        """The paths and targets of steering behaviours."""
        still, size = np.zeros(self.scene.dimension), 2 * max(group.widest for group in self.scene.groups)
        behaviours = [effect for effect in self.scene.parts.effects if effect.steering]
        places = [getattr(each, name) for each in behaviours if each.heads_for for name in each.places]
        return (
            *(Mark("way", np.array(at), still, radius) for track, radius in self._paths for at in track),
            *(Mark("goal", np.array(place), still, size) for place in places if place is not None),
        )
