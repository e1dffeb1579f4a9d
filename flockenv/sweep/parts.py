"""Parts: which laws make up a scene, and what follows from that for its source.

Which effects meet neighbours, in how many different ways they look around (`sights`), what is sorted of each agent
(`fields`: only what some law reads), where each running number lies in the scratch of lanes (`slots`), and the numbers
that the kernel is given (`parameters`). Everything that writes text asks here, and so does whoever allocates scratch.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv import processor
from flockenv.effects.base import Effect, Sight
from flockenv.integrators.base import Integrator
from flockenv.integrators.one_stage import OneStage
from flockenv.kernels import IN_PYTHON, LINE, held, python_of
from flockenv.shapes import packed
from flockenv.shapes.cells import FEWEST_ROWS, MOST_FOUND, cells_of
from flockenv.space import Space
from flockenv.sweep.forms import FormPlan, Surroundings
from flockenv.sweep.numbers import NumberPlan, pack_numbers

__all__ = ["LAWS", "Look", "Parts", "flattened", "view_of"]

MOST_NUMBERS = 2**24
"""Numbers of a form's rows, and of the grid over them, up to which single precision counts them exactly."""

LAWS = (
    "own_law", "medium_law", "flow_law", "far_law", "bond_law", "kick_law", "aim_law", "begin_law", "keep_law",
    "count_law", "pair_start", "pair_law", "apart_law", "finish_law", "obstacle_start", "obstacle_law",
    "obstacle_finish", "obstacle_ray", "obstacle_from", "obstacle_reach",
)  # fmt: skip
"""The slots that an effect may fill with a law."""


class Look(NamedTuple):
    """What is near every agent, for observations and rewards: the nearest few, all around."""

    radius: float  # m
    agents: int = 0  # so many of the nearest agents
    obstacles: int = 0  # so many of the obstacles whose surface is nearest


@dataclass(frozen=True)
class Parts:
    """Which laws make up a scene: all that the source depends on."""

    dimension: int
    space: Space
    effects: tuple[Effect, ...]
    """As `flattened` lists them: behaviours whose wishes are reconciled lie before the effect that does it."""
    integrator: Integrator
    dtype: str = "float64"
    sorts: bool = True
    """Are there enough agents to sort them by cell? If not, nothing of that is written."""
    look: Look | None = None
    """What a task shows its agents, found by the same query."""
    crowded: bool = False
    """Are there enough agents for groups of them to be met as one, where they are far away?"""
    oriented: bool = False
    """Does anybody keep a heading (and an up vector) of his own?"""
    turns: bool = False
    """Is anybody's turn rate limited?"""
    leans: bool = False
    """Does anybody lean into his turns?"""
    starts: tuple[int, ...] = ()
    """The first agent of each group, and one more: numbers alone, the source does not depend on them."""
    shapes: tuple[Any, ...] = field(default=(), compare=False)
    """Obstacles that are not in the state: the source depends on their forms, and on whether any of them moves."""
    circles: int = 0
    """How many obstacles come before them."""
    stepped: bool = True
    """Is it steps that are made? Else accelerations are asked for, wherever somebody is, or is not."""
    touching: float = field(default=math.inf, compare=False)
    """m, the radii of the two that are widest, and a little more: who is further away is in nobody's contact."""
    tables: tuple[NDArray[np.float64], ...] = field(default=(), compare=False)
    """What the laws of each tabled effect look up, in order: numbers alone, too."""

    @functools.cached_property
    def width(self) -> int:
        """Lanes of a block: agents that one vector register holds.

        Where laws meet everybody, sixteen on any processor: a tree is made of blocks, so results follow from it.
        """
        return 16 if self.far else processor.REGISTER // self.itemsize

    @property
    def masks(self) -> bool:
        """Is what was compared kept in masks, beside the registers, so that it costs nothing to compare once more?"""
        return processor.REGISTER == LINE

    @property
    def keyed(self) -> bool:
        """Are lists of the nearest kept as keys? See sweep/look."""
        return self.look is not None and self.look.agents > 1 and not self.sorts and self.itemsize == 4

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return int(np.dtype(self.dtype).itemsize)

    @functools.cached_property
    def pairs(self) -> list[tuple[int, Effect]]:
        """The effects with a pair law, and their numbers."""
        return [(k, e) for k, e in enumerate(self.effects) if e.pair_law is not None]

    @functools.cached_property
    def shaped(self) -> tuple[NDArray[np.float64], dict[str, tuple[int, int]]]:
        """The table of shapes that are not in the state, and the forms there are: where each begins, how many."""
        if not self.meets_obstacles:
            return np.zeros(0), {}
        period = np.array(self.space.extent(self.dimension)) if self.space.periodic else None
        return packed(self.shapes, self.dimension, self.circles, period)

    @property
    def moving(self) -> bool:
        """Does any of them move? If not, nothing of that is written."""
        return any(shape.moves for shape in self.shapes)

    @functools.cached_property
    def bounded(self) -> tuple[str, ...]:
        """The forms of shapes that are only looked at where they lie within reach: none if some law asks for all.

        Those whose laws go from edge to edge, or from place to place. Blocks and half-spaces are met by lanes side by
        side, which would go through all of the law anyhow: there it was no faster, with rays or without.
        """
        return tuple(form for form in ("chain", "distance_field") if form in self.shaped[1]) if self.reaches else ()

    @property
    def reaches(self) -> bool:
        """True if all folds over obstacles say how far they reach."""
        folds = [e for e in self.effects if e.obstacle_start is not None]
        return bool(folds) and all(e.obstacle_reach is not None for e in folds)

    @functools.cached_property
    def cells(self) -> dict[str, NDArray[np.float64]]:
        """Grids over the shapes of each form of which there are many, and which have an end: see shapes/cells.py."""
        table, forms = self.shaped
        period = np.array(self.space.extent(self.dimension)) if self.space.periodic else None
        found = {}
        for form, (begin, count) in forms.items():
            if count >= FEWEST_ROWS and form in ("chain", "block", "distance_field"):
                mine = [shape for shape in self.shapes if shape.form == form]
                lengths = [int(table[begin])]
                while len(lengths) < count:
                    lengths.append(int(table[begin + sum(lengths)]))
                rows = np.cumsum([0, *lengths[:-1]]).tolist()
                grid = cells_of(mine, rows, period)
                if max(rows[-1], len(grid)) < MOST_NUMBERS:
                    found[form] = grid
        return found

    @property
    def looked_up(self) -> tuple[str, ...]:
        """The forms of which folds meet only the shapes that may lie within reach, found by a grid."""
        return tuple(self.cells) if self.reaches else ()

    @property
    def only_rays(self) -> bool:
        """True if all folds over obstacles cast rays."""
        return all(e.obstacle_ray is not None for e in self.effects if e.obstacle_start is not None)

    @property
    def folds_obstacles(self) -> bool:
        """True if any effect has a fold over the obstacles."""
        return any(e.obstacle_start is not None for e in self.effects)

    @property
    def surroundings(self) -> Surroundings:
        """What code about obstacles depends on."""
        plans = zip(self.shaped[1], self.number_plan.forms, strict=True)
        forms = tuple(FormPlan(form, *plan) for form, plan in plans)
        return Surroundings(self.dimension, self.space.offset_law, self.moving, forms)

    @property
    def meets_obstacles(self) -> bool:
        """Does any law ask for obstacles, or what is hidden by them?"""
        return any(e.obstacle_law is not None for e in self.effects) or self.occludes

    @property
    def occludes(self) -> bool:
        """Is anybody, or any obstacle, hidden by obstacles?"""
        return any(sight.occluded for sight in self.sights) or any(e.occluded_obstacles for e in self.effects)

    @functools.cached_property
    def bonded(self) -> list[tuple[int, Effect]]:
        """The effects with a law of bonds, and their numbers."""
        return [(k, e) for k, e in enumerate(self.effects) if e.bond_law is not None]

    @functools.cached_property
    def far(self) -> list[tuple[int, Effect]]:
        """The effects with a law about everybody, and their numbers."""
        return [(k, e) for k, e in enumerate(self.effects) if e.far_law is not None]

    @functools.cached_property
    def treed(self) -> list[tuple[int, Effect]]:
        """Those of them that meet groups as one."""
        return [(k, e) for k, e in self.far if self.crowded and e.parameters()["opening"] != 0]

    @property
    def pulls(self) -> bool:
        """Is anything left in `pulled`?"""
        return bool(self.far or self.bonded)

    @property
    def flows(self) -> bool:
        """Does a medium carry anybody?"""
        return any(e.flow_law is not None for e in self.effects)

    @functools.cached_property
    def sights(self) -> list[Sight]:
        """The different ways in which pair laws look around; laws that see the same share the test."""
        return list(dict.fromkeys(self.sight_of(e) for _, e in self.pairs))

    def sight_of(self, effect: Effect) -> Sight:
        """Return whom the pair law of an effect sees: of contacts, who can touch."""
        sight = effect.sight
        assert sight is not None, f"{type(effect).__name__} has a pair law and no sight"
        return sight._replace(radius=min(sight.radius, self.touching)) if effect.contact else sight

    @functools.cached_property
    def parting(self) -> bool:
        """Are those in one place met by themselves, if there are any, and all others without looking at ties?

        Where every law that reads ties has another for those elsewhere, and all that is told is added up.
        """
        readers = [e for _, e in self.pairs if "tie" in _names(e, _OF_PAIRS)]
        sums = not any(e.pair_start or e.contact for _, e in self.pairs)
        others = any("tie" in _names(e, ("apart_law", "finish_law")) for e in readers)
        return sums and bool(readers) and all(e.apart_law for e in readers) and not others

    @property
    def looks_ahead(self) -> bool:
        """Is it worked out how far the next candidate is while one is met, so that more is under way at a time?

        In small scenes, where a block meets all candidates in a row, of several laws, where there are registers enough.
        """
        return self.parting and self.masks and not self.sorts and self.dimension == 2 and len(self.pairs) > 1

    @property
    def trusts(self) -> bool:
        """Is everybody somewhere, at a finite place, whenever forces are asked for, unless a step has failed already?

        Where steps ask once each. Then laws that vanish are not asked whom they are about. 0 times a way that is no
        number is none either, so whoever meets one who is nowhere is nowhere after that step, too: who was first is
        looked for step by step (`step_world`).
        """
        return self.stepped and self.one_stage

    @property
    def spreads(self) -> bool:
        """Does it spread at once to all who meet him that somebody is nowhere?"""
        return self.trusts and any(effect.vanishes for effect in self.effects)

    @functools.cached_property
    def averaged(self) -> list[int]:
        """The sights of which it is counted who is in them (not of contacts: few candidates are asked for those)."""
        if any(effect.averages and effect.contact for effect in self.effects):
            raise TypeError("an effect with `contact` counts nobody: it cannot have `averages`")
        return sorted({self.sights.index(self.sight_of(e)) for _, e in self.pairs if e.averages})

    @property
    def reach(self) -> float:
        """The largest distance at which any law looks for neighbours, m."""
        return max((sight.radius for sight in self.sights), default=0.0)

    @functools.cached_property
    def _numbers(self) -> tuple[list[float], NumberPlan]:
        return pack_numbers(self)

    def parameters(self) -> list[float]:
        """Every number that the kernel is given; tables come behind."""
        return self._numbers[0]

    @property
    def number_plan(self) -> NumberPlan:
        """Where each of them lies."""
        return self._numbers[1]

    @property
    def count(self) -> int:
        """How many numbers the kernel is handed."""
        return len(self.parameters()) + sum(map(len, self.tables))

    def given(self) -> NDArray[Any]:
        """Return `parameters()` and the tables behind them, in the scene's precision: what the kernel is handed."""
        return np.concatenate([self.parameters(), self.shaped[0], *self.cells.values(), *self.tables]).astype(
            self.dtype
        )

    def numbers_of(self, effect: Effect) -> dict[str, Any]:
        """Return the numbers and vectors that the laws of an effect are given, by name."""
        return {**effect.parameters(), **effect.members(self.starts)}

    def names_of(self, effect: Effect) -> list[str]:
        """Return the names under which the laws of an effect find what they are given."""
        more = ["table"] * effect.tabled + ["counted"] * (effect.count_law is not None)
        return [*self.numbers_of(effect), *more]

    @functools.cached_property
    def wishes(self) -> dict[int, int]:
        """Which effects only wish, and the number of the one that reconciles their wishes."""
        found: dict[int, int] = {}
        for k, effect in enumerate(self.effects):
            found |= dict.fromkeys(range(k - len(effect.wishes), k), k)
        return found

    def target(self, k: int) -> str:
        """Write what effect k adds to: a wish of its own, what agents want, or what acts on them."""
        return f"w{k}_" if k in self.wishes else "s" if self.effects[k].steering else "f"

    def pair_target(self, k: int) -> str:
        """Write what the pair law of effect k adds to: the same, or what its fold over the obstacles is told."""
        effect = self.effects[k]
        return f"n{k}_" if effect.obstacle_start is not None or effect.keep_law is not None else self.target(k)

    @functools.cached_property
    def inner(self) -> tuple[str, ...]:
        """Names of what goes on inside every agent: all that some effect keeps."""
        return tuple(dict.fromkeys(name for effect in self.effects for name in effect.keeps))

    @property
    def keeping(self) -> list[tuple[int, Effect]]:
        """The effects that keep some of it, and their numbers."""
        return [(k, e) for k, e in enumerate(self.effects) if e.keeps]

    @property
    def counters(self) -> int:
        """How many counters all effects have; they lie at the end of the scratch `frame`."""
        return sum(effect.counters for effect in self.effects if effect.count_law)

    @property
    def aims(self) -> bool:
        """Does any effect say where agents want to go?"""
        return any(e.aim_law is not None for e in self.effects)

    @functools.cached_property
    def read(self) -> set[str]:
        """Every name in the code of all laws."""
        return set().union(*(_names(e, LAWS) for e in self.effects))

    @property
    def bounces(self) -> bool:
        """Do bodies come back from walls?"""
        return self.space.bounce_law is not None

    @property
    def sweeps(self) -> bool:
        """Does anybody ask who is near whom?"""
        return bool(self.pairs) or (self.look is not None and self.look.agents > 0)

    @functools.cached_property
    def targets(self) -> list[str]:
        """What pair laws add to: what agents want, what acts on them, wishes, what folds over obstacles are told."""
        found = {self.pair_target(k) for k, _ in self.pairs}
        names = ("s", "f", *(f"w{k}_" for k in self.wishes), *(f"n{k}_" for k, _ in self.pairs))
        return [name for name in names if name in found]

    @property
    def one_stage(self) -> bool:
        """Does the method ask once, and then move every coordinate by itself?"""
        return isinstance(self.integrator, OneStage)

    @property
    def aside(self) -> int:
        """Numbers of every agent that are put aside: accelerations, or where it was, and how fast if bodies bounce."""
        return self.dimension * (2 if self.bounces and not self.one_stage else 1)

    @functools.cached_property
    def fields(self) -> list[str]:
        """What is sorted of each agent: what the pair laws read, found from the names in their code."""
        names = set().union(*(_names(e, _OF_PAIRS) for _, e in self.pairs))
        if any(sight.fov < 360 for sight in self.sights):
            names.add("heading")
        if any(sight.group is not None for sight in self.sights):
            names.add("who")
        facing = "heading" in names
        needed = {"x": True, "v": "vel" in names or (facing and not self.oriented)}
        needed |= {"d" if self.oriented else "h": facing, "t": "tie" in names, "a": self.aims and "aim" in names}
        rows = [f"{letter}{k}" for letter, need in needed.items() if need for k in range(self.dimension)]
        rows += [name for name in ("who", "radius", "mass", "max_speed", "max_force", "desired_speed") if name in names]
        return rows + [f"inner{k}" for k in range(len(self.inner)) if "inner" in names]

    @functools.cached_property
    def sorted_fields(self) -> list[str]:
        """Those of them that lie side by side in scratch, or in records: ties that are seldom looked at do not."""
        seldom = self.sorts and self.parting
        return [name for name in self.fields if not (seldom and name[0] == "t")]

    @property
    def seen_fields(self) -> list[str]:
        """What is sorted of each agent to find the nearest."""
        return [f"x{k}" for k in range(self.dimension)]

    @property
    def rows(self) -> int:
        """Rows of numbers of agents that are listed, or are the block's own, that scratch must have."""
        return max(len(self.sorted_fields) if self.pairs else 0, self.dimension if self.look else 0, 1)

    @property
    def numbers(self) -> int:
        """Numbers of a record that scratch must have: a place, and all fields but headings."""
        kinds = [self.sorted_fields] * bool(self.pairs) + [self.seen_fields] * bool(self.look)
        return 1 + max((sum(name[0] != "h" for name in fields) for fields in kinds), default=0)

    @property
    def confines(self) -> bool:
        """Is everybody brought into a periodic box when a call begins, so that no query has to look after it?

        Only where accelerations are asked for at the frozen present: a stage of a method may lie outside.
        """
        return self.space.periodic and self.arranges and self.one_stage

    @property
    def arranges(self) -> bool:
        """May agents of a large world be put in order for a while?

        Not where places matter: bonds know their partners by them, and everybody is met in their order.
        """
        return self.sorts and bool(self.pairs) and not self.pulls

    @property
    def homely(self) -> bool:
        """Is it noted then who has left the place where he began? Only where cells are the same in every step."""
        return self.arranges and self.space.periodic

    @property
    def frame_vectors(self) -> list[str]:
        """The vectors of an agent's frame: where it faces, and in space which way is up."""
        return ["facing", "above"][: self.dimension - 1] if self.oriented else []

    @property
    def frame_numbers(self) -> list[str]:
        """More numbers of an agent's body, by `Body`'s names, of which not every scene knows."""
        wanted = {
            "max_turn_rate": self.turns, "banking": self.leans, "desired_speed": "desired_speed" in self.read,
        }  # fmt: skip
        return [name for name, some in wanted.items() if some]

    @property
    def frame_argument(self) -> str:
        """The state's arrays of frames and inner states among the arguments of an entry point, where there are some."""
        return "frame_, " * self.oriented + "inner_, " * bool(self.inner)

    @property
    def frame_rows(self) -> int:
        """Coordinates of the vectors of a frame: what a state keeps of each agent."""
        return self.dimension * len(self.frame_vectors)

    @property
    def luggage(self) -> list[str]:
        """What an agent carries along then: an array, and the axis of a vector."""
        vectors = ["pos", "vel", "want", *self.frame_vectors, *(["tie"] if "t0" in self.sorted_fields else [])]
        vector = [f"{name} {k}" for name in vectors for k in range(self.dimension)]
        inner = (f"inner{k}" for k in range(len(self.inner)))
        return [*vector, "mass", "radius", "max_speed", "max_force", *self.frame_numbers, *inner, "ident"]

    @property
    def luggage_size(self) -> int:
        """How many numbers that takes, in whole cache lines."""
        one = LINE // self.itemsize
        return -(-len(self.luggage) // one) * one

    @functools.cached_property
    def slots(self) -> dict[str, int]:
        """Where in the scratch of lanes each running number lies."""
        d, look = self.dimension, self.look or Look(0.0)
        runs = [(f"c{k}_", e.sums(d)) for k, e in self.pairs]
        runs += [(f"near{q}_", sight.nearest or 0) for q, sight in enumerate(self.sights)]
        runs += [(f"many{q}_", 1) for q in self.averaged]
        runs += [(f"o{k}_", e.folded(d) if e.obstacle_start else 0) for k, e in enumerate(self.effects)]
        runs += [(f"g{name}", d) for name in self.targets] + [
            ("bond", d * bool(self.bonded)),
            ("far", d * bool(self.far)),
        ]
        edges = [k for k, e in enumerate(self.effects) if e.obstacle_start and e.obstacle_edges]
        runs += [(f"ahead{k}_", 2) for k in edges]
        runs += [("found", -(-MOST_FOUND // self.width) * bool(self.looked_up))]
        runs += [("reach", int(bool(self.bounded or self.looked_up))), ("here", int(self.parting))]
        runs += [("next", (d + 1) * self.looks_ahead)]
        runs += [("square", look.agents + self.keyed), ("place", look.agents)]
        runs += [("gap", look.obstacles), ("which", look.obstacles)]
        if self.sweeps and self.sorts:
            runs += [("inside", d * self.space.periodic), ("home", 1), ("mine", self.rows)]
        names = [f"{name}{j}" for name, many in runs for j in range(many)]
        return {name: place for place, name in enumerate([*names, "bad"])}


def flattened(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return effects with their behaviours, if they have some, before them: each has laws and numbers of its own."""
    return tuple(each for effect in effects for each in (*effect.wishes, effect))


EDGE = 8
"""Rounding errors by which a field of view is wider: as many as a heading, an offset and their product have."""


def view_of(fov: float, dtype: str) -> float:
    """Return c |c|, what `in_view` compares, with c = cos(fov / 2); fov in degrees.

    The edge belongs to the field of view in either precision, since c is less by EDGE machine epsilons: with 180
    degrees a neighbour exactly abeam is in view, whatever the heading is.
    """
    cosine = math.cos(math.radians(fov) / 2.0) - EDGE * float(np.finfo(dtype).eps)
    return cosine * abs(cosine)


_OF_PAIRS = ("pair_start", "pair_law", "apart_law", "finish_law")


def _names(effect: Effect, slots: Sequence[str]) -> set[str]:
    """Return every name in the code of some of an effect's laws and of the laws that they call."""
    laws = [*(getattr(effect, slot) for slot in slots), effect.obstacle_law if effect.joined else None]
    todo: list[Any] = [law for law in laws if law is not None]
    if effect.wishes and slots == LAWS:
        todo.append(effect.steer_law)
    seen: set[int] = set()
    names: set[str] = set()
    while todo:
        python = python_of(todo.pop())
        if id(python) in seen:
            continue
        seen.add(id(python))
        names |= set(python.__code__.co_names)
        called: list[Any] = [python.__globals__.get(name) for name in python.__code__.co_names]
        called += held(python)
        modules = [m for m in called if inspect.ismodule(m)]
        called += [getattr(m, name, None) for m in modules for name in python.__code__.co_names]
        todo += [f for f in called if hasattr(f, "py_func") or (IN_PYTHON and inspect.isfunction(f))]
    return names
